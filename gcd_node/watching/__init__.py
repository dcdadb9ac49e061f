"""The reader's side of a terminal: live tables of views and of a node's status."""
