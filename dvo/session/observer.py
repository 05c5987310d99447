"""Observers of a run: they see every frame and what the tracker knows between two frames, and change nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from dvo.data.frame import Frame
from dvo.geometry.poses import invert_poses, quaternion_to_matrix
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.map import MIN_NEARNESS
from dvo.map.window import Window
from dvo.odometry.protocol import Estimate, Odometry
from dvo.session.session import Run


class Observer(Protocol):
    """Interface of an observer of a run. The methods are called in this order."""

    def begin(self, odometry: Odometry) -> None:
        """Prepare for a run.

        Args:
            odometry: newly built.
        """
        ...

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """Take note of a frame, after it was tracked.

        Args:
            frame: the frame.
            estimate: of the frame; None if it was skipped.
        """
        ...

    def finish(self, run: Run) -> None:
        """Take note of the result.

        Args:
            run: record of the session.
        """
        ...

    def close(self) -> None:
        """Release files and connections; also after a run that failed."""
        ...


@runtime_checkable
class HasGraph(Protocol):
    """Interface of an odometry whose keyframe graph can be read between two frames."""

    graph: KeyframeGraph


def graph_of(odometry: Odometry) -> KeyframeGraph | None:
    """Keyframe graph of an odometry.

    Args:
        odometry: any.

    Returns:
        The graph; None if it has none.
    """
    if isinstance(odometry, HasGraph) and isinstance(odometry.graph, KeyframeGraph):
        return odometry.graph
    return None


def _none(*shape: int) -> np.ndarray:
    return np.zeros(shape)


@dataclass(frozen=True)
class WindowView:
    """Content of the active window between two frames, in numpy.

    Attributes:
        timestamp: of the newest frame, seconds.
        poses_wc: ``(n, 7)`` camera to world of its frames, oldest first.
        patches: ``(M, 2)`` centres of the newest frame's own patches, on the plane at depth 1 of its camera.
        matches: ``(E, 2)`` positions at which patches of the other frames were measured in the newest frame, likewise.
        confidence: ``(E,)`` of the network in these measurements, in (0, 1).
        pairs: ``(P, 2)`` frames of the window that share an edge, by their position in it.
        pair_confidence: ``(P,)`` mean confidence of the edges of each pair.
        points: ``(K, 3)`` patches of the window, in the world.
        colors: ``(K, 3)`` uint8 RGB of the points.
    """

    timestamp: float
    poses_wc: np.ndarray
    patches: np.ndarray = field(default_factory=lambda: _none(0, 2))
    matches: np.ndarray = field(default_factory=lambda: _none(0, 2))
    confidence: np.ndarray = field(default_factory=lambda: _none(0))
    pairs: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))
    pair_confidence: np.ndarray = field(default_factory=lambda: _none(0))
    points: np.ndarray = field(default_factory=lambda: _none(0, 3))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))


def window_view(graph: KeyframeGraph) -> WindowView | None:
    """Read the active window.

    Args:
        graph: of a tracker, between two frames.

    Returns:
        Copies of its content; None for an empty window.
    """
    window = graph.window
    if not len(window):
        return None
    with torch.inference_mode():
        poses_wc = invert_poses(window.poses_cw.double().cpu().numpy())
        newest, m = len(window) - 1, window.per_frame
        known = (window.confidence > 0).any(-1)
        centre = window.patches.shape[-1] // 2
        centres = window.patches[:, :, centre, centre]
        intrinsics = window.intrinsics[newest]
        into = known & (window.jj == newest) & (window.ii != newest)
        points, colors = _points(window, centres, poses_wc)
        pairs, means = _pairs(window, known)
        return WindowView(
            window.frames[-1].timestamp,
            poses_wc,
            _rays(centres[newest * m :, :2], intrinsics),
            _rays(window.targets[into], intrinsics),
            window.confidence[into].mean(-1).double().cpu().numpy(),
            pairs,
            means,
            points,
            colors,
        )


def archived_lines(graph: KeyframeGraph, segment: int = 0, limit: int = 4000) -> np.ndarray:
    """Pairs of archived keyframes that share measurements.

    Args:
        graph: of a tracker.
        segment: number of a segment; only keyframes that share its world.
        limit: largest number of pairs; the newest are kept.

    Returns:
        ``(P, 2, 3)`` camera centres in the world, of pairs of kept keyframes.
    """
    poses = graph.log.poses
    edges = graph.archive.edges()
    pairs = np.unique(np.column_stack([edges.source, edges.target]), axis=0)
    world = graph.world_of(segment)
    inside = {identifier for identifier in poses if graph.world_of(graph.segment_of(identifier)) == world}
    wanted = [(int(a), int(b)) for a, b in pairs if a != b and int(a) in inside and int(b) in inside][-limit:]
    if not wanted:
        return np.zeros((0, 2, 3))
    poses_cw = np.array([poses[identifier] for pair in wanted for identifier in pair])
    return invert_poses(poses_cw)[:, :3].reshape(-1, 2, 3)


def _rays(pixels: Tensor, intrinsics: Tensor) -> np.ndarray:
    """Positions on the plane at depth 1 from pixels of the feature map."""
    return ((pixels - intrinsics[2:]) / intrinsics[:2]).double().cpu().numpy()


def _points(window: Window, centres: Tensor, poses_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    frames = torch.arange(len(centres), device=centres.device) // window.per_frame
    focal = window.intrinsics[frames]
    inverse_depth = centres[:, 2].double().cpu().numpy()
    rays = ((centres[:, :2] - focal[:, 2:]) / focal[:, :2]).double().cpu().numpy()
    near = inverse_depth > MIN_NEARNESS * max(float(np.median(inverse_depth)), 1e-9)
    local = np.column_stack([rays, np.ones(len(rays))])[near] / inverse_depth[near, None]
    owner = frames.cpu().numpy()[near]
    rotations = quaternion_to_matrix(poses_wc[:, 3:])
    points = np.einsum("nij,nj->ni", rotations[owner], local) + poses_wc[owner, :3]
    colors = torch.cat([frame.colors for frame in window.frames]).cpu().numpy()
    return points, colors[near]


def _pairs(window: Window, known: Tensor) -> tuple[np.ndarray, np.ndarray]:
    both = torch.stack([window.ii[known], window.jj[known]], dim=-1).cpu().numpy()
    confidence = window.confidence[known].mean(-1).double().cpu().numpy()
    ends = np.sort(both, axis=1)
    other = ends[:, 0] != ends[:, 1]
    pairs, group = np.unique(ends[other], axis=0, return_inverse=True)
    counts = np.bincount(group.ravel(), minlength=len(pairs))
    means = np.bincount(group.ravel(), confidence[other], minlength=len(pairs)) / np.maximum(counts, 1)
    return pairs.reshape(-1, 2), means
