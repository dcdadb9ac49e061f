"""The command line, one file a group of commands. The only room here that prints."""
