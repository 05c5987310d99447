"""Sensors: the camera's response to a clean rendering, and inertial measurements. Begin with ``sensor.py``."""
