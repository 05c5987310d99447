"""Trials of a tracker on interrupted sequences: `python -m eval.benchmarks.interruptions`."""
