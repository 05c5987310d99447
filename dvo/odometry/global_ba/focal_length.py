"""Focal length, distortion and principal point of a camera, from the measurements of a segment.

As with the readout time (:mod:`dvo.odometry.global_ba.self_calibration`), the focal length is the one under which the
measurements agree best: for a value of it poses and inverse depths are solved for, and the value with the lowest robust
cost is wanted. Rotation and nearby structure tell it; for a camera that drives straight ahead a wrong focal length is
nearly made up for by other depths, and the cost stays flat. The principal point is found in the same way, each of its
coordinates on its own, at the focal length of least cost.

Barrel distortion is one number, the ``alpha`` of the unified camera model (:mod:`dvo.geometry.lenses`), here called
the bend: 0 is a pinhole camera, 0.5 about k1 = -0.25, and two thirds about an equidistant fisheye. It and the focal
length make up for each other in part, so that for each bend the focal length of least cost is looked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import distort, undistorted_camera
from dvo.map.map import Map
from dvo.map.recordings import increasing_times
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions, extrapolated, solve_part, thinned
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter
from dvo.odometry.global_ba.self_calibration import Minimum, profile_minimum

MIN_KEYFRAMES = 20
"""Frames of a segment below which nothing is concluded."""
FARTHEST = 1.2
"""Largest distance of the values that are tried from the first one, in logarithms."""
ASIDE = 0.08
"""Largest distance of a principal point that is tried from that of the graph, focal lengths."""

MIN_CONTRAST = 0.005
"""Contrast of the coarse minimum below which no finer one is looked for."""

QUICK_FRAMES = 40
"""Frames of a quick look, if there are fewer keyframes."""

_STEPS = 0.08, 0.02  # distance of the values that are tried, in logarithms: coarse, then fine
_BEND_STEPS = 0.15, 0.03  # coarse, then fine
_BENDS = -0.3, 0.9  # below 0, pincushion, a minimum is only told from one at 0
_BEND_INFLATION, _BEND_FLOOR = 3.0, 0.02  # of its deviation: measurements share errors, and what is not modelled
_MOST_UNSURE, _SURE = 0.1, 3.0  # largest deviation that is believed, and deviations that a bend is above 0
_WIDEST = math.radians(75)  # angle from the axis beyond which no measurement may lie
_ASIDE_STEP = 0.01  # distance of the principal points that are tried, focal lengths
_ITERATIONS = 6
_FAR = 4.0  # extrapolation, times the distance that is known
_SHUTTER_ROUNDS = 2  # solutions with corrected measurements, each from the motion of the last


_UNKNOWN = Minimum(0.0, np.inf, 0.0)


@dataclass(frozen=True)
class FocalProfile:
    """Cost of the measurements over the focal length.

    Attributes:
        minimum: value and deviation are logarithms of the factor to the focal length of the graph.
        contrast: relative increase of the cost from its minimum to a focal length that is longer, and to one that is
            shorter, by a fifth, the lesser of the two; 0 for too few frames.
        aside: value and deviation, in focal lengths, of the way from the principal point of the graph to that of least
            cost, to the right and down; with infinite deviations if they were not looked for.
        bend: of the lens; its gain is that from no bend, each with the focal length of least cost. With an infinite
            deviation if it was not looked for.
    """

    minimum: Minimum
    contrast: float
    aside: tuple[Minimum, Minimum] = field(default_factory=lambda: (_UNKNOWN, _UNKNOWN))
    bend: Minimum = _UNKNOWN


def find_focal(
    graph: Map,
    segment: int,
    shutter: Shutter,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
    *,
    beyond: float | None = None,
    lens: Camera | None = None,
) -> FocalProfile:
    """Estimate the focal length, one factor of fx and fy, and if wanted the bend of the lens and the principal point.

    Args:
        graph: the segment is archived and adjusted; it is not changed.
        segment: its number.
        shutter: timing of the rows; a rolling shutter that is not corrected is taken for another focal length.
        options: of the adjustment; its last kernel counts.
        beyond: logarithm of a factor; a profile whose minimum is nearer to the first value is of no interest. This is a
            quick look, without the principal point, and at bends above 0 alone: at the keyframes, with dropped ones up
            to :data:`QUICK_FRAMES`, and with measurements that are corrected for a rolling shutter once.
        lens: camera of the images as recorded, with the distortion that was taken from them before they were tracked;
            None if they were tracked as they are. What is found is that of this camera.

    Returns:
        The profile; that of the coarse steps alone where it is flat (:data:`MIN_CONTRAST`), or of no interest, then
        with a contrast of 0. An infinite deviation if the cost still falls at the end of the range, or for fewer than
        :data:`MIN_KEYFRAMES` frames.
    """
    frames = graph.members(segment)
    if len(frames) < MIN_KEYFRAMES:
        return FocalProfile(_UNKNOWN, 0.0)
    part, times = graph.problem(True, segment), increasing_times(graph, frames)
    if beyond is not None:
        part, shutter = _corrected(part, times, shutter), replace(shutter, readout=0.0)
        kept = torch.tensor([frame.anchor is None for frame in frames])
        if not part.factors:
            part = part.select(thinned(kept, max(QUICK_FRAMES, int(kept.sum()))))
    solve = _Solver(
        part.planned(), times, shutter,
        replace(options, kernels=options.kernels[-1:], iterations=_ITERATIONS),
        lens,
    )  # fmt: skip
    freedom = len(part.patches)
    coarse = solve.focal_minimum(0.0, _STEPS[0], solve.bend)
    bend, coarse, slope = _find_bend(solve, coarse, freedom, 0.0 if beyond is not None else _BENDS[0])
    # The minimum of a single valley is less than a step away from the lowest point that was tried.
    if (
        not np.isfinite(coarse.deviation)
        or beyond is not None
        and abs(coarse.value) <= min(_STEPS[0] / 2, beyond - _STEPS[0])
    ):
        return FocalProfile(coarse, 0.0, bend=bend)

    def contrast_at(value: float) -> float:
        sides = [solve(value + side * float(np.log(1.2)), bend=bend.value) for side in (-1, 1)]
        return min(sides) / here - 1 if (here := solve(value, bend=bend.value)) > 0 else 0.0

    flat = contrast_at(coarse.value)
    if flat < MIN_CONTRAST:
        return FocalProfile(coarse, flat, bend=bend)
    fine = solve.focal_minimum(coarse.value, _STEPS[1], bend.value)
    spread = math.hypot(fine.deviation, slope * bend.deviation) if bend.value else fine.deviation
    found = FocalProfile(Minimum(fine.value, spread, coarse.gain), contrast_at(fine.value), bend=bend)
    if beyond is not None:
        return found

    def aside(cost: Callable[[float], float]) -> Minimum:
        return profile_minimum(cost, 0.0, _ASIDE_STEP, -ASIDE, ASIDE, freedom)

    right = aside(lambda x: solve(fine.value, x, bend=bend.value))
    at = right.value if np.isfinite(right.deviation) else 0.0
    down = aside(lambda y: solve(fine.value, at, y, bend=bend.value))
    return replace(found, aside=(right, down))


def _find_bend(solve: _Solver, coarse: Minimum, freedom: int, least: float) -> tuple[Minimum, Minimum, float]:
    """Bend of the lens, the minimum of the focal length there, and how much that changes with the bend.

    Args:
        solve: at the bend that the images were tracked with.
        coarse: minimum of the focal length at this bend.
        freedom: as for :func:`profile_minimum`.
        least: bend that is tried.

    Returns:
        A bend of 0 where it is not surely above it.
    """
    found: dict[float, Minimum] = {}

    def cost(bend: float, step: float = _STEPS[0]) -> float:
        near = sorted(found, key=lambda known: abs(known - bend))[:2]
        start = found[near[0]].value if near else coarse.value
        if len(near) == 2:
            start += (start - found[near[1]].value) * (bend - near[0]) / (near[0] - near[1])
        found[bend] = solve.focal_minimum(start, step, bend)
        return solve(found[bend].value, bend=bend)

    best = profile_minimum(cost, solve.bend, _BEND_STEPS[0], least, _BENDS[1], freedom)
    sure = _BEND_INFLATION * best.deviation
    if not (sure <= _MOST_UNSURE and best.value > _SURE * math.hypot(sure, _BEND_FLOOR)):
        if 0.0 not in found:
            cost(0.0)
        return replace(best, value=0.0), found[0.0], 0.0
    best = profile_minimum(partial(cost, step=_STEPS[1]), best.value, _BEND_STEPS[1], *_BENDS, freedom)
    near, next_one = sorted(found, key=lambda known: abs(known - best.value))[:2]
    slope = (found[next_one].value - found[near].value) / (next_one - near)
    at = found[near].value + slope * (best.value - near)
    return best, solve.focal_minimum(at, _STEPS[1], best.value), slope


def _corrected(part: PatchProblem, times: Tensor, shutter: Shutter) -> PatchProblem:
    """Measurements as a global shutter would have made them, by the present poses."""
    if shutter.readout <= 0:
        return part
    index, track = torch.arange(len(part.poses_cw)), PoseTrack.through(times, part.poses_cw)
    depths = part.inverse_depths.reshape(len(index), -1)
    return as_global_shutter(part, part.poses_cw, depths, index, track, shutter)


def _along(first: tuple[float, ...], second: tuple[float, ...], third: tuple[float, ...]) -> float | None:
    """Way from the second value to the third over that from the first to the second; None if they are on no line."""
    a, b = np.subtract(second, first), np.subtract(third, second)
    ratio = float(a @ b / (a @ a))
    return ratio if abs(ratio) <= _FAR and np.linalg.norm(b - ratio * a) < 1e-9 else None


def undistorted(points: Tensor, bend: float) -> Tensor:
    """Inverse of the unified camera model (as Usenko, Demmel, Cremers write it, 3DV 2018).

    Args:
        points: ``(..., 2)`` normalised coordinates of a lens with distortion.
        bend: ``alpha`` of the model; below 0 it is pincushion distortion.

    Returns:
        ``(..., 2)`` normalised coordinates of a pinhole camera; those far beyond the range of the model stay finite.
    """
    xi = bend / (1 - bend)
    plane = points * (1 - bend)
    r2 = (plane * plane).sum(-1, keepdim=True)
    length = (xi + (1 + (1 - xi * xi) * r2).clamp(min=1e-3).sqrt()) / (1 + r2)
    return length * plane / (length - xi).clamp(min=0.05)


def _stretch(points: Tensor, bend: float) -> Tensor:
    """Factor ``(..., 1)`` by which :func:`undistorted` changes small lengths around points, mean of the directions."""
    r = points.norm(dim=-1, keepdim=True).clamp(min=1e-4)
    radii = torch.stack([r, 1.0001 * r], -1)
    near, far = undistorted(torch.cat([radii, 0 * radii], -2).mT, bend)[..., 0].split(1, -1)
    return (near / r * (far - near) / (1e-4 * r)).clamp(min=1e-6).sqrt()


def _as_recorded(part: PatchProblem, lens: Camera) -> PatchProblem:
    """Measurements in pixels of images as recorded, from those of images that were undistorted before."""
    zoom = undistorted_camera(lens).fx / lens.fx
    focal, centre = part.intrinsics.split(2, 1)

    def recorded(xy: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
        seen = torch.from_numpy(distort(((xy - centre[frames]) / focal[frames]).numpy(), lens)).to(xy)
        return seen * focal[frames] / zoom + centre[frames], seen

    source = torch.arange(len(part.poses_cw)).repeat_interleave(part.per_frame)
    xy, _ = recorded(part.centres, source)
    targets, seen = recorded(part.targets, part.jj)
    return part.with_values(
        patches=torch.cat([xy[:, :, None, None], part.patches[:, 2:]], 1),
        targets=targets, weights=part.weights * (zoom * _stretch(seen, lens.coefficients[0])) ** 2,
        intrinsics=torch.cat([focal / zoom, centre], 1),
    )  # fmt: skip


class _Solver:
    """Cost of the best poses and depths for a camera; begins from those of the nearest one.

    Attributes:
        bend: that the images were tracked with.
    """

    def __init__(
        self, part: PatchProblem, times: Tensor, shutter: Shutter, options: AdjustmentOptions, lens: Camera | None
    ) -> None:
        self.times, self.shutter, self.options = times, shutter, options
        self.index = torch.arange(len(part.poses_cw))
        self.bend = 0.0 if lens is None else lens.coefficients[0]
        self.part = part if lens is None else _as_recorded(part, lens)
        depths = part.patches[:, 2, 0, 0].reshape(len(part.poses_cw), -1)
        present = part.poses_cw, depths
        self.known: dict[tuple[float, ...], tuple[Tensor, Tensor]] = {(0.0, 0.0, 0.0, self.bend): present}
        focal, centre = self.part.intrinsics[0].split(2)
        self.radius = float(((self.part.centres - centre) / focal).norm(dim=1).max()) if len(part.patches) else 0.0

    def focal_minimum(self, start: float, step: float, bend: float) -> Minimum:
        """Minimum of the cost over the logarithm of the factor of the focal length, at a bend."""
        low = -FARTHEST
        if bend > 0:  # measurements stay within the range of the lens
            reach = math.sin(_WIDEST) / (bend + (1 - bend) * math.cos(_WIDEST))
            low = max(low, math.log(max(self.radius, 1e-6) / reach))
        start = min(max(start, low), FARTHEST)
        return profile_minimum(lambda value: self(value, bend=bend), start, step, low, FARTHEST, len(self.part.patches))

    def __call__(self, log_factor: float, right: float = 0.0, down: float = 0.0, bend: float = 0.0) -> float:
        wanted = log_factor, right, down, bend
        part = self._seen(*wanted)
        nearest = sorted(self.known, key=lambda known: (math.dist(known, wanted), known))
        poses, depths = self.known[nearest[0]]
        if len(nearest) > 1 and (ratio := _along(nearest[1], nearest[0], wanted)) is not None:
            poses, depths = extrapolated(poses, depths, *self.known[nearest[1]], ratio)
        cost, fixed = 0.0, self.index < 1
        for _ in range(_SHUTTER_ROUNDS if self.shutter.readout > 0 else 1):
            seen = part
            if self.shutter.readout > 0:
                track = PoseTrack.through(self.times, poses)
                seen = as_global_shutter(part, poses, depths, self.index, track, self.shutter)
            poses, depths, cost = solve_part(seen, poses, depths, fixed, self.options)
        self.known[wanted] = se3.normalise(poses), depths
        return cost

    def _seen(self, log_factor: float, right: float, down: float, bend: float) -> PatchProblem:
        """Measurements as a pinhole camera of the same focal length would have made them."""
        old, middle = self.part.intrinsics.split(2, 1)
        centre = middle + old * torch.tensor([[right, down]], dtype=old.dtype)
        focal = old * float(np.exp(log_factor))
        part = self.part.with_values(intrinsics=torch.cat([focal, centre], 1))
        if bend == 0:
            return part
        source = self.index.repeat_interleave(part.per_frame)
        xy, at = ((x - centre[k]) / focal[k] for x, k in ((part.centres, source), (part.targets, part.jj)))
        patches = undistorted(xy, bend) * focal[source] + centre[source]
        return part.with_values(
            patches=torch.cat([patches[:, :, None, None], part.patches[:, 2:]], 1),
            targets=undistorted(at, bend) * focal[part.jj] + centre[part.jj],
            weights=part.weights / _stretch(at, bend) ** 2,
        )
