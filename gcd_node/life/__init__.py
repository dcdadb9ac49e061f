"""The node's life: states and commands, and one activation from an open source to its end."""
