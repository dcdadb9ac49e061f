"""Training data: readers of data sets, samples and batches of them, what encoders made of them."""
