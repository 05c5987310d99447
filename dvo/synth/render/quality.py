"""Sampling of colours: how many rays and texture samples make up a pixel."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Quality:
    """Sampling of colours. Depth, surfaces and texture coordinates are those of pixel centres in any case.

    Args:
        supersample: rays per pixel edge.
        taps: texture samples along the longer axis of a pixel's footprint (anisotropic filter).
        antialias: smooth outlines by coverage where there is one ray per pixel.
    """

    supersample: int = 1
    taps: int = 2
    antialias: bool = True


STANDARD = Quality()
