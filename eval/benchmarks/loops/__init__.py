"""Loop closure on long sequences and after darkness: `python -m eval.benchmarks.loops`."""
