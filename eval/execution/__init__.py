"""Runs of systems on sequences, each in its own process and stored by key. Start in ``runner.py``."""
