"""Fields of view of cameras, and what undistortion cuts of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dvo.geometry.camera import Camera
from dvo.geometry.lenses import undistort_to_rays, widest_angle
from dvo.geometry.undistort import undistort

_SAMPLES = 96  # of the longer side of an image, to measure areas
_WORTH_TELLING = 0.1  # share of the pixels


def viewing_angle(camera: Camera) -> tuple[float, float]:
    """Horizontal and vertical field of view through the principal point.

    Args:
        camera: with its model and coefficients; fisheyes of more than 180 degrees too.

    Returns:
        Degrees between the rays of the outer edges of the first and the last pixel of a row, and of a column; of a
        fisheye whose image ends inside, those of the largest angle that its model reaches.
    """
    sides = (
        (camera.fx, camera.cx, camera.width, 0),
        (camera.fy, camera.cy, camera.height, 1),
    )
    angles = []
    for focal, centre, size, axis in sides:
        ends = ((-0.5 - centre) / focal, (size - 0.5 - centre) / focal)
        angles.append(math.degrees(sum(_angle(camera, abs(end), axis if end > 0 else axis + 2) for end in ends)))
    return angles[0], angles[1]


@dataclass(frozen=True)
class Cut:
    """Part of a lens's image that undistortion to a pinhole camera leaves out.

    Attributes:
        before, after: horizontal and vertical field of view, degrees.
        share: of the pixels of the recorded image that show nothing of the undistorted one.
        zoom: focal length of the pinhole camera over that of the lens.
    """

    before: tuple[float, float]
    after: tuple[float, float]
    share: float
    zoom: float

    def __str__(self) -> str:
        lens, pinhole = (f"{angles[0]:.0f} x {angles[1]:.0f}" for angles in (self.before, self.after))
        return (
            f"{pinhole} degrees of {lens} degrees of view are kept (focal length times {self.zoom:.2f}), "
            f"{100 * self.share:.0f} % of the pixels are cut"
        )


def measure_cut(camera: Camera, pinhole: Camera) -> Cut:
    """Compare the image of a lens with the undistorted one.

    Args:
        camera: of the recorded images.
        pinhole: of the undistorted ones, see :func:`dvo.geometry.undistort.undistorted_camera`.

    Returns:
        Fields of view, and the share of the pixels that is cut, to about a percent.
    """
    step = max(camera.width, camera.height) / _SAMPLES
    u, v = np.meshgrid(np.arange(step / 2, camera.width, step) - 0.5, np.arange(step / 2, camera.height, step) - 0.5)
    recorded = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)
    ideal = undistort(recorded, camera)
    x, y = pinhole.fx * ideal[..., 0] + pinhole.cx, pinhole.fy * ideal[..., 1] + pinhole.cy
    kept = (np.abs(x - (pinhole.width - 1) / 2) <= pinhole.width / 2) & (  # NaN fails too
        np.abs(y - (pinhole.height - 1) / 2) <= pinhole.height / 2
    )
    return Cut(
        viewing_angle(camera), viewing_angle(pinhole), 1 - float(kept.mean()), pinhole.fx / camera.focal_lengths[0]
    )


def notice_of_cut(camera: Camera, pinhole: Camera) -> list[str]:
    """Sentence for the user about what undistortion cuts.

    Args:
        camera: of the recorded images.
        pinhole: of the undistorted ones.

    Returns:
        One sentence; none for a lens that is no fisheye and loses less than a tenth of its pixels.
    """
    cut = measure_cut(camera, pinhole)
    is_fisheye = camera.model not in ("none", "radtan")
    if not is_fisheye and cut.share < _WORTH_TELLING:
        return []
    lens = "a fisheye" if is_fisheye else "a wide lens"
    return [f"images of {lens} are undistorted to a pinhole camera: {cut}"]


def _angle(camera: Camera, radius: float, direction: int) -> float:
    """Angle in radians from the axis at a distorted normalised radius, rightwards, downwards, leftwards or upwards."""
    point = np.zeros(2)
    point[direction % 2] = radius if direction < 2 else -radius
    ray = undistort_to_rays(point, camera.model, camera.coefficients)
    if np.isfinite(ray).all():
        return math.atan2(float(np.linalg.norm(ray[:2])), float(ray[2]))
    return widest_angle(camera.model, camera.coefficients)
