"""What a run says of itself while it goes on: figures, pictures, memory, and when a loss is no number any more."""
