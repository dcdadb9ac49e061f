"""A node under load: stand-ins for camera and model, processes that read, stall and attack. For `gcd-node soak` and
`gcd-node bench node`; nothing of it runs in a node at work."""
