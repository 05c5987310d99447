"""Correction of the poses of a world by its loops: a pose graph in Sim(3).

It is applied between two frames, and prepared and solved beside tracking, from references to the keyframes. Those that
are archived meanwhile, and the window, are moved along with the last keyframe before them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.pose_graph import LOOP_OPTIONS, optimise_pose_graph
from dvo.geometry import se3, sim3
from dvo.map.correction import Moved, apply_similarities, carry, similarity_between
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.map import Map
from dvo.odometry.loops.check import median_inverse_depth
from dvo.odometry.loops.finder import Loop

# Standard deviations of the edges of the pose graph: translation in median depths, rotation in rad, log scale.
_STEP = (0.01, 0.002, 0.01)
_LOOP = (0.01, 0.002, 0.01)  # of a loop with the share _SURE of inliers or more; larger with fewer
_SURE = 0.5


@dataclass(frozen=True)
class Correction:
    """Pose graph of consecutive keyframes and loops.

    Attributes:
        identifiers: ``(N,)`` of the keyframes, increasing.
        held: ``(N,)`` poses that stay; if there are none, the first one does.
        start: ``(N, 8)`` similarities world to camera to start from.
        ii, jj: ``(E,)`` keyframes of the edges.
        measured: ``(E, 8)`` similarities between them.
        weight: ``(E, 7)`` inverse variances.
    """

    identifiers: np.ndarray
    held: np.ndarray
    start: Tensor
    ii: Tensor
    jj: Tensor
    measured: Tensor
    weight: Tensor

    def solve(self) -> Tensor:
        """Similarities ``(N, 8)`` world to camera at the minimum; their scales are the new units of the keyframes."""
        options = replace(LOOP_OPTIONS, fixed=torch.from_numpy(self.held)) if self.held.any() else LOOP_OPTIONS
        result = optimise_pose_graph(self.start, self.ii, self.jj, self.measured, self.weight, options)
        return sim3.normalise(result.poses_cw)


def worlds_of_loop(graph: Map, loop: Loop) -> tuple[int, int]:
    """Worlds of the earlier and the later visit."""
    old, new = (graph.world_of(graph.segment_of(k)) for k in (loop.old, loop.new))
    return old, new


def members(graph: Map, kept: Sequence[int], loop: Loop) -> np.ndarray:
    """Identifiers ``(N,)`` of the kept keyframes in the worlds of a loop, increasing."""
    worlds = worlds_of_loop(graph, loop)
    return np.array([k for k in kept if graph.world_of(graph.segment_of(k)) in worlds], dtype=np.int64)


def prepare(graph: Map, kept: Sequence[int], loops: Sequence[Loop], loop: Loop) -> Correction:
    """Pose graph of the worlds of a loop.

    Errors are weighted relative to the depth of the scene. Keyframes whose patches were released, which do not tell it,
    take that of the nearest keyframe with patches.

    Args:
        graph: holds the keyframes.
        kept: identifiers of the kept keyframes, increasing.
        loops: confirmed ones, those of other worlds included.
        loop: the last of them. If it joins two worlds, the later one is moved into the earlier to start from.
    """
    identifiers = members(graph, kept, loop)
    poses_cw = graph.poses_cw(identifiers)
    segments = np.array([graph.segment_of(int(k)) for k in identifiers])
    depth = torch.from_numpy(_depths(graph, identifiers, segments))
    ii = torch.from_numpy(np.flatnonzero(segments[1:] == segments[:-1]))
    jj = ii + 1
    steps = sim3.from_se3(poses_cw)
    measured = sim3.compose(steps[jj], sim3.inverse(steps[ii]))
    position = {int(k): row for row, k in enumerate(identifiers)}
    inside = [other for other in loops if other.old in position and other.new in position]
    old = torch.tensor([position[other.old] for other in inside])
    new = torch.tensor([position[other.new] for other in inside])
    doubt = [(_SURE / min(max(other.inliers, 0.01), _SURE)) ** 2 for other in inside]
    deviation = torch.tensor([_STEP] * len(ii) + [tuple(d * x for x in _LOOP) for d in doubt]).double()
    ends = torch.cat([jj, new])
    shape = deviation[:, [0, 0, 0, 1, 1, 1, 2]].clone()
    shape[:, :3] *= depth[ends, None]
    return Correction(
        identifiers, held_keyframes(graph, identifiers), _start(graph, identifiers, poses_cw, loop),
        torch.cat([ii, old]), ends, torch.cat([measured, *(other.measurement[None] for other in inside)]),
        shape.square().reciprocal(),
    )  # fmt: skip


def solve(graph: Map, kept: Sequence[int], loops: Sequence[Loop], loop: Loop) -> tuple[np.ndarray, Tensor]:
    """Solve the pose graph of the worlds of a loop.

    Args:
        graph, kept, loops, loop: see :func:`prepare`; none of them changes meanwhile.

    Returns:
        Its keyframes ``(N,)`` and their similarities ``(N, 8)``.
    """
    correction = prepare(graph, kept, loops, loop)
    return correction.identifiers, correction.solve()


def apply(
    graph: KeyframeGraph, kept: Sequence[int], loop: Loop, identifiers: np.ndarray, found: Tensor
) -> Moved:  # fmt: skip
    """Correct the keyframes of the worlds of a loop, and the window if it is in one of them; join its worlds.

    Args:
        graph: corrected in place.
        kept: identifiers of the kept keyframes now, increasing.
        loop: the loop.
        identifiers: ``(N,)`` of the keyframes of the pose graph.
        found: ``(N, 8)`` its solution.

    Returns:
        What has moved: keyframes of these worlds.
    """
    now = members(graph, kept, loop)
    found = _carried(graph, identifiers, found, now)
    before, held = graph.poses_cw(now), held_keyframes(graph, now)
    apply_similarities(graph, now[~held], found[torch.from_numpy(~held)])
    carried = carry(graph, now, before, found)
    if loop.joins:
        graph.join(graph.segment_of(loop.new), graph.segment_of(loop.old))
    return Moved(dict(zip(now.tolist(), found[:, 7].tolist(), strict=True)), carried)


def held_keyframes(graph: Map, identifiers: np.ndarray) -> np.ndarray:
    """Mask ``(N,)`` of the keyframes of the map, in the world that stays; none without a map."""
    worlds = np.array([graph.world_of(graph.segment_of(int(k))) for k in identifiers])
    return (identifiers < graph.recording.keyframe) & (worlds == worlds.min())


def _depths(graph: Map, identifiers: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Median depth ``(N,)`` at keyframes, that of the nearest one of the segment for those without patches.

    A segment without any patches has the depth of the nearest keyframe of another one, and 1 if no patches are left.
    """
    depth = 1.0 / np.array([median_inverse_depth(graph.archive[int(k)]) for k in identifiers])
    known = np.flatnonzero(np.isfinite(depth))
    for row in np.flatnonzero(~np.isfinite(depth)):
        own = known[segments[known] == segments[row]]
        near = own if len(own) else known
        depth[row] = depth[near[np.abs(near - row).argmin()]] if len(near) else 1.0
    return depth


def _carried(graph: Map, identifiers: np.ndarray, found: Tensor, now: np.ndarray) -> Tensor:
    """Similarities ``(M, 8)`` of all keyframes; one that was not solved for moves with the last one of its segment."""
    position = {int(k): row for row, k in enumerate(identifiers)}
    last = {graph.segment_of(int(k)): int(k) for k in identifiers}
    carried = found[[position.get(k, 0) for k in now.tolist()]]
    for row, k in enumerate(now.tolist()):
        if k not in position:  # a few: there may be thousands that were solved for
            anchor = last.get(graph.segment_of(k), int(identifiers[-1]))
            base_cw, pose_cw = graph.poses_cw(np.array([anchor, k]))
            step = sim3.from_se3(se3.relative(base_cw, pose_cw))
            carried[row] = sim3.compose(step, found[position[anchor]])
    return carried


def _start(graph: Map, identifiers: np.ndarray, poses_cw: Tensor, loop: Loop) -> Tensor:
    """Similarities ``(N, 8)`` world to camera to start from; a joining segment is moved into the older world.

    In a map the later of the two worlds is moved, whichever keyframe is the older one.
    """
    start = sim3.from_se3(poses_cw)
    if not loop.joins:
        return start
    worlds = worlds_of_loop(graph, loop)
    old, new = graph.poses_cw(np.array([loop.old, loop.new]))
    there = sim3.compose(loop.measurement, sim3.from_se3(old))  # older world to the newer camera, in its unit
    found_cw, scale = torch.cat([there[:3] / there[7], there[3:7]]), float(1 / there[7])
    change = sim3.inverse(similarity_between(new, found_cw, scale))
    newer = worlds[1]
    if graph.recording.keyframe and worlds[0] > worlds[1]:
        newer, change = worlds[0], sim3.inverse(change)
    moving = torch.tensor([graph.world_of(graph.segment_of(int(k))) == newer for k in identifiers])
    return torch.where(moving[:, None], sim3.compose(start, change), start)
