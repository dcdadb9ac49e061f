"""The live model: geometry first, what was never seen is painted, and every pixel says which."""
