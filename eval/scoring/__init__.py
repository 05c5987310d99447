"""Errors of stored trajectories, and their summary over runs. Start in ``score.py``."""
