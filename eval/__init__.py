"""Evaluation of visual odometries: systems on suites of sequences, scored alike; ``python -m eval --help``."""

import dvo  # noqa: F401, decides how threads wait, before a module imports torch
