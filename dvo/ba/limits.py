"""Limits of the numbers of a problem."""

LARGEST = 1e8
"""Largest magnitude of a coordinate (scene units or pixels), inverse depth or focal length, and of a step: products of
a few of them are numbers of float32."""
HEAVIEST = 1e16
"""Largest weight of a measurement of a graph: its product with the square of a residual is a number of float32."""
SHORTEST_FOCAL = 1e-3
"""Least focal length, pixels (1 in normalised coordinates)."""
RETRIES = 6
"""Attempts after a failed factorisation, each with ten times the damping."""
LARGEST_TURN = 10.0
"""Largest step of the logarithm of a focal length, or of a principal point in focal lengths."""
