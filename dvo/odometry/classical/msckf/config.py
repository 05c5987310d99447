"""Settings of the inertial filter."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MsckfConfig:
    """Settings; pixels are those of the images given.

    Attributes:
        corners: number of tracks kept alive.
        refill: new corners are looked for when fewer than this part of ``corners`` is alive.
        quality, window, levels, closed: corner strength, patch side, pyramid levels and forward-backward tolerance.
        pixel: standard deviation of a tracked pixel, for the gate.
        drift: factor on it in updates: errors of a track in successive images are alike, as its patch drifts.
        clones: largest number of poses in the window.
        interval: seconds between two of them.
        flow: median displacement of the tracks, as part of the focal length, that calls for one earlier.
        views: fewest observations of a point.
        offset_sigma: standard deviation of the time offset at the start, seconds; 0 holds it fixed.
        position_sigma, rotation_sigma: of the calibrated camera in the body, metres and rad; 0 holds it fixed.
        still: seconds without motion that start the filter.
        moving: seconds of motion that start it where there is no such stretch.
        start_scale: largest relative standard deviation of the distance moved, for a start from motion.
        patience: seconds without an image after which the filter begins anew.
    """

    corners: int = 250
    refill: float = 0.85
    quality: float = 0.001
    window: int = 15
    levels: int = 4
    closed: float = 0.5
    pixel: float = 0.25
    drift: float = 3.0
    clones: int = 16
    interval: float = 0.1
    flow: float = 0.08
    views: int = 3
    offset_sigma: float = 0.01
    position_sigma: float = 0.003
    rotation_sigma: float = 0.003
    still: float = 1.0
    moving: float = 2.0
    start_scale: float = 0.1
    patience: float = 10.0
