"""Pictures as files and side by side."""
