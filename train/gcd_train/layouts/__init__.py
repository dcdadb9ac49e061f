"""Published data layouts on disk: names, metadata, encodings, and folders that appear whole."""
