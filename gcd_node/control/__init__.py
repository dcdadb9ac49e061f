"""The control socket: verbs, commands, limits (wire protocol, section 5). Its client: gcd_client.control."""
