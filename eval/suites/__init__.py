"""Suites of sequences with their protocol. Start in ``suite.py``."""
