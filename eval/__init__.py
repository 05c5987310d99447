"""Evaluation of visual odometries: systems on suites of sequences, scored alike; ``python -m eval --help``."""
