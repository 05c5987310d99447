"""Evaluation of visual odometries: systems on suites of sequences, scored alike; ``python -m eval --help``."""

from dvo.threads import wait_passively

wait_passively()  # before a module imports torch
