"""Benchmarks of speed, each a program of its own: ``python -m eval.benchmarks.NAME``."""
