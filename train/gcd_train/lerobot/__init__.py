"""LeRobot data sets: read as pairs of calibrated cameras, written from tabletop episodes."""
