"""What the node says of itself: reports, events, metrics, log lines, and a word to systemd."""
