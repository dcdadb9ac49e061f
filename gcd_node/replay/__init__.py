"""Replays of recordings that can be compared: a run on disk, the difference of two, and goldens."""
