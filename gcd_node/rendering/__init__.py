"""The model at work: windows in, views out, and what is given up when it cannot."""
