"""Settings of the use of inertial samples."""

from __future__ import annotations

from dataclasses import dataclass

from dvo.core.settings import check_settings

_RANGES = {
    "interval": (0.02, 2.0),
    "window": (2.0, 1e4),
    "first": (1.0, 1e3),
    "min_excitation": (0.0, 100.0),
    "max_scale_sigma": (1e-4, 1.0),
    "longest": (0.0, 60.0),
}


@dataclass(frozen=True)
class InertialOptions:
    """How inertial samples of the frames are used.

    Attributes:
        use: frames with inertial samples; otherwise these are ignored.
        interval: between the nodes of the smoother, seconds.
        window: length of time that it looks back, seconds.
        first: of visual poses before an alignment is tried, seconds.
        min_excitation: standard deviation of the acceleration that an alignment needs, m/s^2.
        max_scale_sigma: standard deviation of the scale that it needs, relative.
        longest: time without a pose by images that is bridged, seconds; 0: none.
    """

    use: bool = True
    interval: float = 0.2
    window: float = 20.0
    first: float = 2.0
    min_excitation: float = 0.25
    max_scale_sigma: float = 0.04
    longest: float = 10.0

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)
