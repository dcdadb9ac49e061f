"""Lenses and pictures on their way to the network: calibration, undistortion, crop, resize, mount."""
