"""Adjustment of images and inertial samples of a tracker: at the end of a recording, and beside tracking.

Beside tracking it makes sure of the scale where the smoother alone does not, and later keeps the unit of map and window
where samples are too noisy to lead the window for long: all of the last seconds is solved for, and map and window take
the solution, but for the place and the heading of the newest keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry import se3
from dvo.geometry.poses import matrix_to_quaternion, pose_from, quaternion_to_matrix, slerp, so3_exp, split
from dvo.map.correction import Moved, keyframes_of, set_solution
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.map import Map
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.global_ba.inertial_adjustment import (
    MOST_FRAMES,
    TOLERANCE,
    VisualInertialSolution,
    adjust_with_samples,
)
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.inertial.estimator import AGREEMENT, MAX_ERROR, Similarity
from dvo.odometry.inertial.smoother import Smoothed, VisualNodes

LEAST_EDGES = 12
"""Measurements of a frame that takes part."""


@dataclass(frozen=True)
class MetricPath:
    """Similarities from the world of visual poses to the metric one, that change over time.

    Attributes:
        times: ``(N,)`` increasing, seconds.
        log_scale: ``(N,)`` of metres in a unit.
        rotation: ``(N, 4)`` quaternions.
        translation: ``(N, 3)`` metres.
    """

    times: np.ndarray
    log_scale: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def constant(cls, similarity: Similarity) -> MetricPath:
        """The same similarity at all times."""
        quaternion = pose_from(similarity.rotation, np.zeros(3))[3:]
        return cls(np.zeros(1), np.log([similarity.scale]), quaternion[None], similarity.translation[None])

    def moved(self, times: np.ndarray, poses_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses ``(K, 7)`` at times between the nodes, in metres, and the scale of each."""
        after = np.searchsorted(self.times, times).clip(0, len(self.times) - 1)
        before = (after - 1).clip(0)
        span = np.maximum(self.times[after] - self.times[before], 1e-9)
        share = np.clip((times - self.times[before]) / span, 0, 1)
        scale = np.exp((1 - share) * self.log_scale[before] + share * self.log_scale[after])
        turn = slerp(self.rotation[before], self.rotation[after], share)
        rotation, position = split(poses_wc)

        def placed(k: np.ndarray) -> np.ndarray:
            turned = (quaternion_to_matrix(self.rotation[k]) @ position[..., None])[..., 0]
            return np.exp(self.log_scale[k])[:, None] * turned + self.translation[k]

        where = (1 - share)[:, None] * placed(before) + share[:, None] * placed(after)
        return pose_from(quaternion_to_matrix(turn) @ rotation, where), scale


def metric_path(smoothed: Smoothed, nodes: VisualNodes, mine: np.ndarray) -> MetricPath | None:
    """Similarity at each node of a segment; None without nodes."""
    shared = np.flatnonzero(np.isin(np.round(nodes.times, 6), np.round(smoothed.times, 6)) & mine)
    if not len(shared):
        return None
    at = np.searchsorted(smoothed.times, nodes.times[shared] - 1e-6)
    rotation = smoothed.rotation[at] @ np.swapaxes(nodes.rotation[shared] @ smoothed.rotation_camera_imu, -1, -2)
    camera = smoothed.position[at] + smoothed.rotation[at] @ smoothed.lever
    scale = np.exp(smoothed.log_scale[at])[:, None]
    translation = camera - scale * (rotation @ nodes.position[shared][..., None])[..., 0]
    return MetricPath(nodes.times[shared], smoothed.log_scale[at], matrix_to_quaternion(rotation), translation)


@dataclass(frozen=True)
class InertialAdjustment:
    """Images and samples of a world that are to be adjusted together.

    Attributes:
        graph: map of the world; not changed.
        world: its number.
        start: estimate to start from.
        path: to metres; None for a world that is in metres.
        samples, noise: of the sensor.
        variance: of a visual measurement of weight 1, feature pixels squared.
        spacing: of the nodes, seconds.
        options: of the final adjustment.
        shutter: timing of the rows; None for a global shutter.
        since: time of the first frame that is solved for, seconds.
        tolerance: see :func:`adjust_with_samples`.
    """

    graph: Map
    world: int
    start: Smoothed
    path: MetricPath | None
    samples: InertialSamples
    noise: ImuNoise
    variance: float
    spacing: float
    options: AdjustmentOptions
    shutter: Shutter | None = None
    since: float = -np.inf
    tolerance: float = TOLERANCE

    def solve(self) -> VisualInertialSolution | None:
        """Solution; None where there is none that agrees with both."""
        frames = [frame for frame in self.graph.members(self.world) if frame.timestamp >= self.since]
        dropped = len(frames) <= MOST_FRAMES
        frames = frames if dropped else [frame for frame in frames if frame.anchor is None]
        if not 3 <= len(frames) <= MOST_FRAMES:
            return None
        first = 0 if np.isneginf(self.since) else frames[0].identifier
        part = self.graph.problem(dropped, self.world, first).with_values(factors=())
        times = np.array([self.graph.archive[k].timestamp for k in part.identifiers.tolist()])
        if not (np.diff(times) > 0).all():
            return None
        # Frames whose measurements have been released to save memory stay.
        counts = torch.bincount(torch.cat([part.ii, part.jj]), minlength=len(times))
        linked = (counts >= LEAST_EDGES) & torch.from_numpy(times >= self.since)
        if int(linked.sum()) < 3:
            return None
        part, times = part.select(linked).planned(), times[linked.numpy()]
        if not len(part.kk):
            return None
        if self.path is not None:
            moved, scales = self.path.moved(times, se3.inverse(part.poses_cw).numpy())
            depths = part.inverse_depths.view(len(times), -1) / torch.from_numpy(scales)[:, None]
            part = part.with_values(poses_cw=se3.inverse(torch.from_numpy(moved)), inverse_depths=depths.flatten())
        found = adjust_with_samples(
            part, times, self.start, self.samples, self.noise, variance=self.variance, spacing=self.spacing,
            options=self.options, shutter=self.shutter, tolerance=self.tolerance,
        )  # fmt: skip
        # Where the two contradict each other, one of them is not what it seems.
        if found is None or not found.inertial_error <= MAX_ERROR or not np.isfinite(found.scale_sigma):
            return None
        return found if abs(found.change) <= AGREEMENT + 3 * self.start.scale_sigma else None


@dataclass(frozen=True)
class Applied:
    """A solution that map and window have taken.

    Attributes:
        moved: what has moved.
        states: of the nodes, in the metric world.
        similarity: from the world of visual poses to that.
    """

    moved: Moved
    states: Smoothed
    similarity: Similarity


def apply_solution(
    graph: KeyframeGraph, world: int, solution: VisualInertialSolution, known: Similarity | None
) -> Applied | None:
    """Let map and window take a solution; the newest keyframe that was solved for keeps place and heading.

    Args:
        graph: changed in place; it has grown since the solution was begun, and nothing else.
        world: number of the world.
        solution: in metres.
        known: from the world of visual poses to the metric one; None: not known so far, and the newest keyframe keeps
            its pose and unit in the world of visual poses.

    Returns:
        None if no keyframe of it is left, and nothing is changed.
    """
    newest = _newest_kept(graph, world, solution)
    if newest is None:
        return None
    row, old_wc, own_depths = newest
    rotation, position = split(se3.inverse(solution.poses_cw).numpy())
    states, depths = solution.states, solution.depths.numpy()
    own_rotation, own_position = split(old_wc.numpy())
    if known is None:
        scale = float(np.median(own_depths / depths[row]))
        turn = rotation[row] @ own_rotation.T
        known = Similarity(scale, turn, position[row] - scale * turn @ own_position)
    else:
        there, missing = known.points(own_position), known.rotation @ own_rotation @ rotation[row].T
        heading = float(np.arctan2(missing[1, 0] - missing[0, 1], missing[0, 0] + missing[1, 1]))
        turn = so3_exp(np.array([0.0, 0.0, heading]))
        shift = there - turn @ position[row]
        rotation, position = turn @ rotation, position @ turn.T + shift
        states = replace(
            states, rotation=turn @ states.rotation, position=states.position @ turn.T + shift,
            velocity=states.velocity @ turn.T,
        )  # fmt: skip
    visual = pose_from(known.rotation.T @ rotation, known.inverse_points(position))
    poses_cw = se3.inverse(torch.from_numpy(visual))
    moved = set_solution(graph, world, solution.identifiers.numpy(), poses_cw, depths * known.scale)
    return Applied(moved, states, known)


def metres_per_unit(graph: KeyframeGraph, world: int, solution: VisualInertialSolution) -> float | None:
    """Scale of the newest keyframe of a solution, metres in a unit that it has in the graph.

    Args:
        graph: as it is before it takes the solution.
        world: number of the world.
        solution: in metres.

    Returns:
        None if no keyframe of it is left.
    """
    newest = _newest_kept(graph, world, solution)
    return None if newest is None else float(np.median(newest[2] / solution.depths[newest[0]].numpy()))


def _newest_kept(
    graph: KeyframeGraph, world: int, solution: VisualInertialSolution
) -> tuple[int, Tensor, np.ndarray] | None:
    """Row, pose ``T_wc`` and inverse depths of the newest keyframe that has not been dropped since."""
    window, m, centre = graph.window, graph.per_frame, graph.window.patches.shape[-1] // 2
    here = graph.world_of(graph.segment) == world
    places = {frame.identifier: place for place, frame in enumerate(window.frames) if here and not frame.guest}
    archived = set(keyframes_of(graph, world).tolist())
    for row, identifier in reversed(list(enumerate(solution.identifiers.tolist()))):
        if identifier in places:
            place = places[identifier]
            depths = window.patches[place * m : (place + 1) * m, 2, centre, centre].double().cpu().numpy()
            return row, se3.inverse(window.poses_cw[place].double().cpu()), depths
        if identifier in archived and len(graph.archive[identifier].inverse_depth):
            frame = graph.archive[identifier]
            return row, se3.inverse(torch.from_numpy(frame.pose_cw)), frame.inverse_depth
    return None
