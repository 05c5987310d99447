"""Global bundle adjustment of a world while its sequence goes on: after a loop, and on request.

The pose graph of a loop distributes the error over the poses, and leaves depths and the agreement with the measurements
as they are. The adjustment solves for all archived keyframes and inverse depths of the world, dropped keyframes and the
measurements of loops included, with the code of the final adjustment (:mod:`dvo.odometry.global_ba.final_adjustment`):
sparse Schur complement, robust kernels, first keyframe or map held. It works on a copy, beside tracking. Keyframes that
are archived meanwhile, and the window, are moved along with the last keyframe before them. A solution that does not
lower the robust cost of the measurements is not taken.

Beside tracking the work is bounded (:class:`AdjustmentLimits`); earlier keyframes are held.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3, sim3
from dvo.map.correction import Moved, apply_similarities, carry
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.map import Map
from dvo.map.recordings import increasing_times
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions, adjust_segment
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter

Cause = Literal["loop", "request"]

_MIN_KEYFRAMES = 3  # keyframes below which nothing is adjusted


@dataclass(frozen=True)
class AdjustmentLimits:
    """Bounds of a global adjustment beside tracking.

    Attributes:
        iterations: steps with each kernel, at most.
        frames, edges: newest keyframes of a world, and measurements between them, that are solved for, at most.
        delay: frames between its beginning and the frame that takes the solution.
    """

    iterations: int = 5
    frames: int = 600
    edges: int = 300_000
    delay: int = 40


@dataclass(frozen=True)
class AdjustmentRecord:
    """Global adjustment of a world, as run.json lists it.

    Attributes:
        begun, applied: times of the frames that it was begun with and applied after, seconds.
        cause: ``loop`` or ``request``.
        keyframes: number of those that were solved for, dropped ones included.
        edges: number of measurements.
        cost_before, cost: half the sum of robust squared residuals, feature pixels squared times the confidence.
        accepted: the cost has decreased; otherwise nothing was changed.
        seconds: wall time of the solution.
    """

    begun: float
    applied: float
    cause: Cause
    keyframes: int
    edges: int
    cost_before: float
    cost: float
    accepted: bool
    seconds: float


@dataclass(frozen=True)
class Adjusted:
    """Solution of a global adjustment.

    Attributes:
        identifiers: ``(N,)`` of the keyframes that were solved for, increasing, dropped ones included.
        similarities: ``(N, 8)`` world to camera; their scales are the new units of the keyframes
            (:func:`dvo.map.correction.apply_similarities`).
        inverse_depths: ``(N, M)`` float32 of the patches.
        edges, cost_before, cost, seconds: see :class:`AdjustmentRecord`.
    """

    identifiers: np.ndarray
    similarities: Tensor
    inverse_depths: np.ndarray
    edges: int
    cost_before: float
    cost: float
    seconds: float

    @property
    def better(self) -> bool:
        """True if the robust cost has decreased."""
        return self.cost < self.cost_before

    def record(self, begun: float, applied: float, cause: Cause) -> AdjustmentRecord:
        """Entry of run.json; see :class:`AdjustmentRecord`."""
        costs = self.cost_before, self.cost, self.better
        return AdjustmentRecord(begun, applied, cause, len(self.identifiers), self.edges, *costs, self.seconds)


@dataclass(frozen=True)
class Adjustment:
    """Global adjustment to be done.

    Attributes:
        graph: copy of the archive as it was, to be corrected at will.
        world: number of the world.
        options: kernels, iterations and size of the blocks.
        shutter: timing of the rows.
        frames, edges: bounds of the newest keyframes and measurements that are solved for; None for all.
    """

    graph: Map
    world: int
    options: AdjustmentOptions
    shutter: Shutter
    frames: int | None = None
    edges: int | None = None

    def solve(self) -> Adjusted:
        """Solution, once. The graph that the copy was taken of is neither read nor changed."""
        started, graph = time.perf_counter(), self.graph
        members = graph.members(self.world)
        identifiers = np.array([frame.identifier for frame in members], dtype=np.int64)
        since = self._since(graph, identifiers)
        before = {frame.identifier: frame for frame in members if frame.identifier >= since}
        if len(before) < _MIN_KEYFRAMES:
            return _nothing(started)
        part, cost_before = self._cost(graph, since)
        adjust_segment(graph, self.world, self.options, self.shutter, since)
        found, cost = self._cost(graph, since)
        if not np.isfinite([cost_before, cost]).all():
            return _nothing(started)
        changed = [k for k, frame in before.items() if graph.archive[k] is not frame]  # the others were held
        rows = np.array(changed, dtype=np.int64)
        depths = np.array([graph.archive[int(k)].inverse_depth for k in rows], dtype=np.float32)
        depths = depths.reshape(len(rows), graph.per_frame)
        scales = [float(np.median(new / before[int(k)].inverse_depth)) for k, new in zip(rows, depths, strict=True)]
        poses_cw, unit = graph.poses_cw(rows), torch.tensor(scales, dtype=torch.float64)
        similarities = sim3.from_se3(torch.cat([poses_cw[:, :3] * unit[:, None], poses_cw[:, 3:]], 1), unit)
        costs = len(part.kk), cost_before, cost
        return Adjusted(rows, sim3.normalise(similarities), depths, *costs, time.perf_counter() - started)

    def _since(self, graph: Map, identifiers: np.ndarray) -> int:
        """Identifier of the first keyframe within the bounds; 0 if all are."""
        first = 0 if self.frames is None else max(0, len(identifiers) - self.frames)
        if self.edges is not None and len(identifiers):
            edges = graph.archive.edges()
            known = np.isin(edges.source, identifiers) & np.isin(edges.target, identifiers)
            newest = np.maximum(edges.source, edges.target)[known]
            at = np.searchsorted(identifiers, newest)
            later = np.bincount(at, minlength=len(identifiers))[::-1].cumsum()[::-1]  # edges from each keyframe on
            first = max(first, int((later > self.edges).sum()))
        return int(identifiers[min(first, len(identifiers) - 1)]) if first else 0

    def _cost(self, graph: Map, since: int) -> tuple[PatchProblem, float]:
        """Measurements that are solved for, and their cost under the poses and depths of a graph."""
        part = graph.problem(True, self.world, since)
        if not len(part.kk):
            return part, 0.0
        seen = part
        if self.shutter.readout > 0:
            frames = graph.members(self.world)
            identifiers = np.array([frame.identifier for frame in frames])
            track = PoseTrack.through(increasing_times(graph, frames), graph.poses_cw(identifiers), self.shutter)
            rows = torch.from_numpy(np.searchsorted(identifiers, part.identifiers.numpy()))
            depths = part.patches[:, 2, 0, 0].reshape(len(rows), -1)
            seen = as_global_shutter(part, part.poses_cw, depths, rows, track, self.shutter)
        mean = seen.robust_cost(self.options.kernels[-1], self.options.max_residual)
        return part, float(mean * seen.weights.sum())


def _nothing(started: float) -> Adjusted:
    none = np.zeros(0, np.int64), torch.zeros(0, 8, dtype=torch.float64), np.zeros((0, 0), np.float32)
    return Adjusted(*none, 0, 0.0, 0.0, time.perf_counter() - started)


def prepare(
    graph: Map,
    world: int,
    shutter: Shutter,
    options: AdjustmentOptions,
    limits: AdjustmentLimits | None = None,
) -> Adjustment:
    """Global adjustment of a world from its present state.

    Args:
        graph: of a tracker; it is not changed.
        world: number of the world.
        shutter: timing of the rows of the camera.
        options: of the final adjustment, whose kernels and iterations serve here. Nothing is started anew.
        limits: bounds of the work beside tracking; None for those of the final adjustment.
    """
    options = replace(options, restart_frames=0)
    if limits is None:
        return Adjustment(graph.archived(), world, options, shutter)
    options = replace(options, iterations=limits.iterations)
    return Adjustment(graph.archived(), world, options, shutter, limits.frames, limits.edges)


def apply(graph: KeyframeGraph, world: int, adjusted: Adjusted) -> Moved:
    """Correct the keyframes of a world by a solution, and the window if it is in this world.

    Args:
        graph: corrected in place; keyframes may have been archived, and patches released, since the solution was begun.
        world: number of the world.
        adjusted: the solution.

    Returns:
        What has moved: kept keyframes.
    """
    position = {int(k): row for row, k in enumerate(adjusted.identifiers)}
    anchored = [f.identifier for f in graph.archive if f.anchor is None and graph.segment_of(f.identifier) >= 0]
    kept = [k for k in anchored if graph.world_of(graph.segment_of(k)) == world]
    solved = [k for k in kept if k in position]
    if not solved:
        return Moved({})
    moving = np.array([k for k in kept if k in position or k > solved[-1]], dtype=np.int64)
    before = graph.poses_cw(moving)
    base_cw, base = before[len(solved) - 1], adjusted.similarities[position[solved[-1]]]
    carried = sim3.compose(sim3.from_se3(se3.relative(base_cw.expand_as(before), before)), base)
    own = torch.tensor([position.get(int(k), -1) for k in moving])
    found = torch.where((own >= 0)[:, None], adjusted.similarities[own], carried)
    apply_similarities(graph, moving, found)
    _set_exactly(graph, adjusted)
    units = dict(zip(moving.tolist(), found[:, 7].tolist(), strict=True))
    return Moved(units, carry(graph, moving, before, found))


def _set_exactly(graph: Map, adjusted: Adjusted) -> None:
    """Give keyframes the solved poses and depths; those with a unit of its own have moved all depths by one factor."""
    s = adjusted.similarities
    poses_cw = torch.cat([s[:, :3] / s[:, 7:], s[:, 3:7]], 1).numpy()
    for k, pose_cw, depth in zip(adjusted.identifiers.tolist(), poses_cw, adjusted.inverse_depths, strict=True):
        released = not len(graph.archive[k].inverse_depth)
        graph.correct(k, pose_cw, None if released else depth)
