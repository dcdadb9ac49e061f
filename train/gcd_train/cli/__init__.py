"""`gcd-train`, the command line: one file a command."""
