"""Videos without ground truth: `python -m eval.benchmarks.wild DIR`."""
