"""Final poses of frames that were aligned with the keyframes: each from its own measurements, the keyframes held.

Such a frame has no patches (:meth:`dvo.map.keyframe_graph.KeyframeGraph.attach`), so that nothing else depends on it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.geometry import se3
from dvo.map.archive import ArchivedKeyframe
from dvo.map.map import Map
from dvo.map.problem import archive_problem
from dvo.map.recordings import increasing_times
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter

FRAMES = 1000
"""Frames that are solved for at a time."""


def place_attached(
    graph: Map,
    segment: int,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
    shutter: Shutter | None = None,
) -> int:
    """Solve for the poses of the frames of a world that have measurements, but no patches.

    Args:
        graph: the world is archived and adjusted; the poses of these frames are replaced.
        segment: number of any of its segments.
        options: the last kernel, the longest residual, and when the solution has converged.
        shutter: timing of the rows; None, or a readout time of 0, for a global shutter.

    Returns:
        Their number.
    """
    members = graph.members(segment)
    if not members:
        return 0
    targets = set(np.unique(graph.archive.edges().target).tolist())
    attached = [frame for frame in graph.attached(segment) if frame.identifier in targets]
    for start in range(0, len(attached), FRAMES):
        _place(graph, members, attached[start : start + FRAMES], options, shutter)
    return len(attached)


def _place(
    graph: Map,
    members: list[ArchivedKeyframe],
    attached: list[ArchivedKeyframe],
    options: AdjustmentOptions,
    shutter: Shutter | None,
) -> None:
    m = graph.per_frame
    centres, depths = np.zeros((m, 2), np.float32), np.ones(m, np.float32)  # no edge begins there
    with_patches = (replace(frame, centres=centres, inverse_depth=depths) for frame in attached)
    frames = sorted([*members, *with_patches], key=lambda frame: frame.identifier)
    part = archive_problem(graph.archive, frames, graph.poses_cw, m)
    moving = torch.isin(part.identifiers, torch.tensor([f.identifier for f in attached]))
    part = part.edges(moving[part.jj])
    if shutter is not None and shutter.readout > 0:
        track = PoseTrack.through(increasing_times(graph, frames), part.poses_cw)
        found, rows = part.inverse_depths.reshape(len(frames), m), torch.arange(len(frames))
        part = as_global_shutter(part, part.poses_cw, found, rows, track, shutter)
    solver = LMOptions(max_iterations=options.iterations, tolerance=options.tolerance)
    settings = GlobalBAOptions(~moving, options.kernels[-1], options.max_residual, move_depths=False, solver=solver)
    poses = se3.normalise(solve(part, settings).poses_cw)
    for row in moving.nonzero()[:, 0].tolist():
        graph.correct(int(part.identifiers[row]), poses[row].numpy())
