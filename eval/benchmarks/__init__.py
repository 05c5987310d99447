"""Benchmarks of speed and of malformed input, each a program of its own: ``python -m eval.benchmarks.NAME``."""
