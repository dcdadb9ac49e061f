"""The live model's own data, trainings and measures."""
