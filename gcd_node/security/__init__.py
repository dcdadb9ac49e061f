"""Who may connect, and with which role: keys, allow-list, and the gate in front of the sockets."""
