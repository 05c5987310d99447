"""Benchmarks of speed, accuracy and memory, each a program of its own: ``python -m eval.benchmarks.NAME``."""
