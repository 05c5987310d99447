"""Recognition of places on rendered loops and walks: `python -m eval.benchmarks.place_recognition`."""
