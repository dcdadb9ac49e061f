"""Clips as the trainer and the evaluation read them."""
