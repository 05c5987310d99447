"""Calibration of a camera with a board of known geometry: a checkerboard or a ChArUco board."""
