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
DEPTH_RANGE = (1e-3, 10.0)
"""Inverse depths in bundle adjustment, where the median of a scene is about 1."""
NEARER = 2.5
"""Factor of the median of nearer scenes up to which they may be."""


def depth_range_of(median: float, usual: tuple[float, float] = DEPTH_RANGE) -> tuple[float, float]:
    """Range of inverse depths: the usual one, or wider where a scene has come nearer.

    The unit of a trajectory is set by its first images. Where a camera goes on from a hall to a wall at arm's length,
    nearly all inverse depths would meet the usual bound, and nothing would fit any more.

    Args:
        median: of the inverse depths of a scene.
        usual: smallest and largest.
    """
    low, high = usual
    return low, max(high, NEARER * median)
