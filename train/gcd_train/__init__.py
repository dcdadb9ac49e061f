"""Data, training and evaluation for the models of `gcd_model`."""
