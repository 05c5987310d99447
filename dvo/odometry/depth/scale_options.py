"""Options of the metric scale: the observation that it comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings

ScaleSource = Literal["none", "depth", "stereo", "height", "distance"]
"""Observation that lengths in metres come from; ``none``: trajectories are up to scale."""

_RANGES = {
    "depth_error": (1e-4, 1),
    "depth_base": (0, 1),
    "depth_quadratic": (0, 1),
    "stereo_error": (1e-4, 10),
    "height": (0, 1e6),
    "tilt": (1, 80),
}


@dataclass(frozen=True)
class ScaleOptions:
    """Source of the metric scale of :class:`dvo.odometry.patch.tracker.PatchOdometry`, at most one.

    Attributes:
        depth: use ``Frame.depth``, in every bundle adjustment (:mod:`dvo.odometry.depth.patch_depth`).
        depth_error: standard deviation of the depth of a patch relative to it, beside the noise of the camera. Edges of
            a patch share errors and count one by one, so that parallax counts for more than it tells; a larger value
            leaves its noise to the scale (docs/metric_scale.md).
        depth_base, depth_quadratic: ``a`` and ``b`` of the noise of the depth camera, whose standard deviation is ``a +
            b (Z - 0.4)^2`` metres at depth ``Z``. The defaults are those of a Kinect (Nguyen, Izadi and Lovell,
            "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012, axial noise).
        stereo: use the right images of ``Frame.right`` in the same way (:mod:`dvo.odometry.depth.stereo_depth`).
        stereo_error: standard deviation of a disparity, feature pixels (a quarter of those of the working image).
        height: of the camera over the ground, metres; 0 if it is not known (:mod:`dvo.odometry.scale.ground_plane`).
        tilt: largest angle between the vertical of the image and that of the ground, degrees, for ``height``.
        distances: ``(from, to, metres)``: straight distance between the camera centres at two times, seconds.

    Raises:
        DvoError: several sources; a value of another type or out of range; a distance that is not positive, or whose
            times do not increase.

    Example:
        >>> odometry = dvo.load("small", scale=ScaleOptions(depth=True))
    """

    depth: bool = False
    depth_error: float = 0.01
    depth_base: float = 0.0012
    depth_quadratic: float = 0.0019
    stereo: bool = False
    stereo_error: float = 0.01
    height: float = 0.0
    tilt: float = 30.0
    distances: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)
        if self.depth + self.stereo + (self.height > 0) + bool(self.distances) > 1:
            message = "the scale is to come from several sources"
            raise DvoError(message, field="scale", remedy="give one of depth, stereo, height and distances")
        for first, last, metres in self.distances:
            if not (first < last and 0 < metres < 1e7):
                message = f"no distance: {metres:g} m from {first:g} s to {last:g} s"
                raise DvoError(message, field="distances", remedy="give T0 before T1, and a distance above 0")

    @property
    def measures(self) -> bool:
        """True if depths of patches are measured, and take part in every bundle adjustment."""
        return self.depth or self.stereo

    @property
    def source(self) -> ScaleSource:
        """Observation that the scale comes from."""
        if self.measures:
            return "depth" if self.depth else "stereo"
        return "height" if self.height > 0 else "distance" if self.distances else "none"
