"""Numbers that kernels share with their twins; without torch, so that kernels can be compiled without it."""

MIN_Z_DIVISION = 0.1
"""The projection divides by ``max(Z, this)``."""
MIN_Z_VALID = 0.2
"""A point is valid only where ``Z`` is greater: in front of the camera by a fifth of its depth in frame i."""
SMALL = 1e-3
"""Below this squared angle the closed forms lose digits in their derivatives and a series of four terms is exact."""
