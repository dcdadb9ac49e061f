"""The control socket and its client: verbs, messages, limits (wire protocol, section 5)."""
