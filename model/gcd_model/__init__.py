"""Generative Camera Dolly (being assembled)."""
