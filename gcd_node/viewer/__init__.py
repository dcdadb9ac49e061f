"""A page to look at a running node in a browser: served on loopback, and a client of the node like any other."""
