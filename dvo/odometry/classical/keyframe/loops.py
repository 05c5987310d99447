"""Loop closure of the keyframe system: likeness of images, ORB matches with PnP, and a pose graph in Sim(3).

The pose graph is that of :mod:`dvo.ba.pose_graph`, the index of images that of :mod:`dvo.map.places`; its
descriptors are PTAM's small blurred images. Points move with the first keyframe that sees them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from dvo.ba.pose_graph import LOOP_OPTIONS, optimise_pose_graph
from dvo.geometry import se3, sim3, so3
from dvo.geometry.poses import pose_matrices, poses_from_matrices
from dvo.map.keyframe_log import KeyframeLog
from dvo.map.places import PlaceIndex
from dvo.odometry.classical import two_view
from dvo.odometry.classical.keyframe.config import KeyframeConfig
from dvo.odometry.classical.keyframe.map import Keyframe, Map
from dvo.odometry.classical.keyframe.relocalise import OCTAVES, describe, feature, match

CANDIDATES = 3
APART = 20  # frames between candidates
ALIKE = 0.4  # smallest correlation of small images
SHARE = 0.5  # smallest share of the matches that are inliers
FOUND = 0.15  # smallest share of the points in view that are inliers; a repeated pattern gives fewer
CONNECTED = 15  # common points from which two keyframes need no loop
SCALED = 10  # inliers with a depth in both keyframes
SPREAD = 0.15  # relative difference of depths that half of them have at most
PATIENCE = 4  # searches after a loop within which a second one has to ask for the same correction, within
AGREE = (0.2, 3.0, 0.1)  # median depths, degrees, and ratio of scales less one
# Standard deviations of the edges: translation in median depths, rotation in rad, log scale.
DEVIATION = (0.01, 0.002, 0.01)


@dataclass(frozen=True)
class Loop:
    """Two visits of a place.

    Attributes:
        old, new: frames of the keyframes.
        measurement: ``(8,)`` similarity from the camera of the earlier to that of the later one.
        inliers: share of the matches.
        count: number of inliers.
    """

    old: int
    new: int
    measurement: torch.Tensor
    inliers: float
    count: int


@dataclass
class LoopCloser:
    """Search for loops, and correction of the map.

    Args:
        config: of the system.
        seed: of RANSAC.

    Attributes:
        loops: found so far, in all maps.
    """

    config: KeyframeConfig
    seed: int = 0
    loops: list[Loop] = field(default_factory=list)
    _map: Map | None = None
    _places: PlaceIndex = field(default_factory=lambda: PlaceIndex(30 * 40))
    _edges: list[Loop] = field(default_factory=list)  # of the map in use
    _pending: Loop | None = None  # not confirmed yet
    _searches: int = 0  # since then
    _wait: int = 0

    def visit(self, world: Map, newest: Keyframe, log: KeyframeLog, intrinsics: np.ndarray) -> float | None:
        """Take a new keyframe, and close a loop if it and one before it show an earlier place again.

        Args:
            world: map in use, corrected in place with its frames.
            newest: keyframe, the last of the map.
            log: of the frames.
            intrinsics: ``(4,)`` fx fy cx cy, pixels.

        Returns:
            Scale of the newest keyframe, by which lengths in its surroundings have been divided; None without a loop.
        """
        if world is not self._map:
            self._map, self._places, self._edges, self._wait = world, PlaceIndex(30 * 40), [], 0
            self._pending = None
        small = feature(newest, "thumbnail").ravel()
        self._wait -= 1
        loop = self._find(world, newest, small, log, intrinsics) if self._wait <= 0 else None
        self._places.add(newest.frame, small)
        pending, self._searches = self._pending, self._searches + 1
        if loop is None:
            self._pending = pending if self._searches < PATIENCE else None
            return None
        if pending is None or not agree(world, pending, loop):
            self._pending, self._searches = loop, 0
            return None
        self._pending, self._wait = None, self.config.loop_every
        self.loops += [pending, loop]
        self._edges += [pending, loop]
        return self._correct(world, log)

    def information(self, log: KeyframeLog) -> dict[str, Any]:
        """Loops as the results of a run tell them.

        Args:
            log: of the frames.
        """
        return {
            "loops": [
                {
                    "from": log.frames[loop.new].timestamp, "to": log.frames[loop.old].timestamp, "kind": "retrieval",
                    "inliers": round(loop.inliers, 3), "edges": loop.count, "joins_segments": False,
                }
                for loop in self.loops
            ]
        }  # fmt: skip

    def _find(
        self, world: Map, newest: Keyframe, small: np.ndarray, log: KeyframeLog, intrinsics: np.ndarray
    ) -> Loop | None:
        keyframes = {keyframe.frame: keyframe for keyframe in world.keyframes}
        for gone in set(self._places.identifiers.tolist()) - set(keyframes):
            self._places.remove(gone)
        limit = log.frames[newest.frame].timestamp - self.config.loop_seconds
        old = [frame for frame in keyframes if log.frames[frame].timestamp <= limit]
        if not old or not small.any():
            return None
        found = self._places.query(small, CANDIDATES, before=max(old) + 1, apart=APART)
        common = dict(zip(keyframes, world.shared(newest).tolist(), strict=True))
        for frame, score in zip(found.identifiers.tolist(), found.scores.tolist(), strict=True):
            if score >= ALIKE and common[frame] < CONNECTED:
                loop = verify(world, keyframes[frame], newest, intrinsics, self.config, self.seed + newest.frame)
                if loop is not None:
                    return loop
        return None

    def _correct(self, world: Map, log: KeyframeLog) -> float:
        """Solve the pose graph of the map, and move everything along."""
        before = _similarities(world)
        rows = {keyframe.frame: row for row, keyframe in enumerate(world.keyframes)}
        self._edges = [loop for loop in self._edges if loop.old in rows and loop.new in rows]
        ii = torch.arange(len(before) - 1)
        steps = sim3.compose(before[1:], sim3.inverse(before[:-1]))
        old = torch.tensor([rows[loop.old] for loop in self._edges])
        new = torch.tensor([rows[loop.new] for loop in self._edges])
        ends = torch.cat([ii + 1, new])
        depth = torch.tensor([median_depth(world, keyframe) for keyframe in world.keyframes]).double()
        deviation = torch.tensor(DEVIATION).double()[[0, 0, 0, 1, 1, 1, 2]].repeat(len(ends), 1)
        deviation[:, :3] *= depth[ends, None]
        measured = torch.cat([steps, *(loop.measurement[None] for loop in self._edges)])
        solved = optimise_pose_graph(
            before, torch.cat([ii, old]), ends, measured, deviation.square().reciprocal(), LOOP_OPTIONS
        ).poses_cw
        after = sim3.normalise(solved)
        move(world, log, after)
        for row, loop in enumerate(self._edges):  # in the new units of the keyframes
            one, two = float(after[rows[loop.old], 7]), float(after[rows[loop.new], 7])
            t, q, scale = loop.measurement[:3] / two, loop.measurement[3:7], loop.measurement[7:] * one / two
            self._edges[row] = Loop(loop.old, loop.new, torch.cat([t, q, scale]), loop.inliers, loop.count)
        return float(after[-1, 7])


def verify(
    world: Map, old: Keyframe, new: Keyframe, intrinsics: np.ndarray, config: KeyframeConfig, seed: int
) -> Loop | None:
    """Match two keyframes by descriptors, and find the pose of the later one from points of the earlier one.

    The scale is that of depths of points that both have triangulated on their own.

    Args:
        world: map of both.
        old, new: keyframes.
        intrinsics: ``(4,)`` fx fy cx cy, pixels.
        config: of the system.
        seed: of RANSAC.

    Returns:
        The loop, or None where too few points agree.
    """
    for octave in OCTAVES:
        rows, descriptors = describe(new.grey, new.uv, octave)
        pairs = match(feature(old, "descriptors"), descriptors)
        first, second = feature(old, "rows")[pairs[:, 0]], rows[pairs[:, 1]]
        known = world.known(old.ids[first])
        first, second = first[known], second[known]
        if len(first) < config.loop_points:
            continue
        points = world.xyz[old.ids[first]]
        found = two_view.pose_from_points(points, new.uv[second], intrinsics, 4.0, seed)
        if found is None or found[1].sum() < max(config.loop_points, SHARE * len(first)):
            continue
        T, inliers = found
        if inliers.sum() < FOUND * _in_view(world.xyz[old.ids[world.known(old.ids)]], T, intrinsics, new.grey):
            continue
        there = (points @ T[:3, :3].T + T[:3, 3])[:, 2]
        own = world.xyz[new.ids[second]] @ new.T_cw[2, :3] + new.T_cw[2, 3]
        both = inliers & ~np.isnan(own) & (there > 0) & (own > 0)
        if both.sum() < SCALED:
            continue
        ratio = own[both] / there[both]
        scale = float(np.median(ratio))
        if np.median(np.abs(ratio / scale - 1)) > SPREAD:
            continue
        pose = torch.from_numpy(poses_from_matrices(T)).double()
        here = sim3.from_se3(torch.cat([pose[:3] * scale, pose[3:]]), scale)
        before = sim3.from_se3(torch.from_numpy(poses_from_matrices(old.T_cw)).double())
        measurement = sim3.compose(here, sim3.inverse(before))
        return Loop(old.frame, new.frame, measurement, float(inliers.mean()), int(inliers.sum()))
    return None


def _in_view(points: np.ndarray, T_cw: np.ndarray, intrinsics: np.ndarray, grey: np.ndarray) -> int:
    """Number of points that project into an image."""
    uv, depth = two_view.project(points, T_cw, intrinsics)
    with np.errstate(invalid="ignore"):
        return int(((depth > 0) & (uv > 0).all(1) & (uv < np.array(grey.shape[::-1]) - 1).all(1)).sum())


def agree(world: Map, first: Loop, second: Loop) -> bool:
    """Find out if two loops ask for the same correction of the pose of the later keyframe.

    Args:
        world: map of both.
        first, second: loops.
    """
    keyframes = {keyframe.frame: keyframe for keyframe in world.keyframes}
    if not {first.old, first.new, second.old, second.new} <= set(keyframes):
        return False

    def similarity(frame: int) -> torch.Tensor:
        return sim3.from_se3(torch.from_numpy(poses_from_matrices(keyframes[frame].T_cw)).double())

    def asked(loop: Loop) -> torch.Tensor:
        """World of the earlier visit to the camera of the second loop's later visit."""
        there = sim3.compose(loop.measurement, similarity(loop.old))
        return sim3.compose(sim3.compose(similarity(second.new), sim3.inverse(similarity(loop.new))), there)

    difference = sim3.compose(asked(first), sim3.inverse(asked(second)))
    far = float(difference[:3].norm()) / median_depth(world, keyframes[second.new])
    angle = float(so3.log(difference[3:7]).norm().rad2deg())
    scale = float(difference[7])
    return far <= AGREE[0] and angle <= AGREE[1] and max(scale, 1 / scale) - 1 <= AGREE[2]


def move(world: Map, log: KeyframeLog, similarities: torch.Tensor) -> None:
    """Give the keyframes of a map new poses and scales; points, frames and removed keyframes follow.

    Args:
        world: changed in place.
        log: of the frames, changed in place.
        similarities: ``(K, 8)`` world to camera, in the units that the cameras had so far.
    """
    anchor = np.full(len(world.xyz), -1)
    for row in reversed(range(len(world.keyframes))):
        anchor[world.keyframes[row].ids] = row
    moving = np.flatnonzero((anchor >= 0) & ~np.isnan(world.xyz[:, 0]))
    at = torch.from_numpy(anchor[moving])
    local = sim3.act(_similarities(world)[at], torch.from_numpy(world.xyz[moving]))
    world.xyz[moving] = sim3.act(sim3.inverse(similarities[at]), local).numpy()
    scales = similarities[:, 7:]
    poses = pose_matrices(se3.normalise(torch.cat([similarities[:, :3] / scales, similarities[:, 3:7]], 1)).numpy())
    changed = {keyframe.frame: float(s) for keyframe, s in zip(world.keyframes, scales[:, 0], strict=True)}
    for keyframe, T in zip(world.keyframes, poses, strict=True):
        keyframe.T_cw = T
        log.set_pose(keyframe.frame, T)
    for gone, (above, relative) in sorted(log.removed.items()):  # the keyframe that it is relative to comes first
        if above in changed:
            changed[gone] = changed[above]
            relative = relative.copy()
            relative[:3, 3] /= changed[above]
            log.reanchor(gone, above, relative)
    log.rescale(changed)


def median_depth(world: Map, keyframe: Keyframe) -> float:
    """Median depth of the points that a keyframe sees; 1 without any.

    Args:
        world: map.
        keyframe: of it.
    """
    points = world.xyz[keyframe.ids[world.known(keyframe.ids)]]
    depth = points @ keyframe.T_cw[2, :3] + keyframe.T_cw[2, 3]
    return float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0


def _similarities(world: Map) -> torch.Tensor:
    """Poses ``(K, 8)`` world to camera of all keyframes, of scale 1."""
    poses = poses_from_matrices(np.array([keyframe.T_cw for keyframe in world.keyframes]))
    return sim3.from_se3(torch.from_numpy(poses).double())
