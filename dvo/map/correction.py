"""Corrections of a keyframe graph that change poses and scale: of a loop, or of a segment that joins another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3, sim3
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.map import Map


@dataclass(frozen=True)
class Carried:
    """How the newest poses of a world have moved, which are those after its last keyframe.

    Attributes:
        world: its number before; :meth:`Map.world_of` tells the one that it belongs to after.
        change: ``(8,)`` similarity from that world before to the one after.
        time: of the last keyframe, seconds.
        window: the window has moved along, as it is in this world.
    """

    world: int
    change: Tensor
    time: float
    window: bool


@dataclass(frozen=True)
class Moved:
    """What a correction has moved.

    Attributes:
        units: new unit of each keyframe, in old ones: the scale of its similarity.
        worlds: the newest poses of each world, that of the window last.
    """

    units: Mapping[int, float]
    worlds: tuple[Carried, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.units)


def apply_similarities(graph: Map, identifiers: np.ndarray, similarities: Tensor) -> None:
    """Set poses and scales of archived keyframes; the dropped keyframes and the frames relative to them follow.

    A similarity ``S`` maps points of the world to the frame of the camera, in the unit that the keyframe had so far.
    With its scale ``s`` the pose becomes that of ``S / s``, and the inverse depths are multiplied by ``s``.

    Args:
        graph: keyframes, corrected in place.
        identifiers: ``(N,)`` of keyframes that were kept (not dropped).
        similarities: ``(N, 8)`` float64 world to camera.

    Example:
        >>> keyframes = np.array([keyframe.identifier for keyframe in graph.archive if keyframe.anchor is None])
        >>> twice = sim3.from_se3(graph.poses_cw(keyframes), 0.5)  # camera to world lengths double
        >>> apply_similarities(graph, keyframes, twice)
    """
    scales = dict(zip(identifiers.tolist(), similarities[:, 7].tolist(), strict=True))
    poses_cw = torch.cat([similarities[:, :3] / similarities[:, 7:], similarities[:, 3:7]], 1).numpy()
    for identifier, pose_cw in zip(identifiers.tolist(), poses_cw, strict=True):
        inverse_depth = graph.archive[identifier].inverse_depth * scales[identifier]
        graph.correct(identifier, pose_cw, inverse_depth.astype(np.float32))
    _rescale_relative(graph, scales)


def _rescale_relative(graph: Map, scales: dict[int, float]) -> None:
    """Divide the lengths of dropped keyframes and frames that are relative to keyframes with a new scale."""
    for frame in list(graph.archive):  # by increasing identifier: the keyframe that it is relative to comes first
        if frame.anchor is None or frame.anchor not in scales:
            continue
        scale = scales[frame.anchor]
        scales[frame.identifier] = scale
        relative = frame.pose_cw.copy()
        relative[:3] /= scale
        graph.archive.set_pose(frame.identifier, relative, frame.inverse_depth * np.float32(scale), frame.anchor)
        graph.log.reanchor(frame.identifier, frame.anchor, relative)
    graph.log.rescale(scales)


def rescale(graph: Map, segment: int, factor: float) -> dict[int, float]:
    """Multiply all lengths of the world of a segment, from its origin.

    Args:
        graph: all keyframes of the world are archived; corrected in place.
        segment: number of any segment with this world.
        factor: of lengths, new over old.

    Returns:
        Scale of the similarity of each kept keyframe, see :func:`apply_similarities`: ``1 / factor``.
    """
    mine = keyframes_of(graph, segment)
    if not len(mine):
        return {}
    apply_similarities(graph, mine, sim3.from_se3(graph.poses_cw(mine), 1 / factor))
    return dict.fromkeys(mine.tolist(), 1 / factor)


def keyframes_of(graph: Map, segment: int) -> np.ndarray:
    """Kept keyframes of a world that are archived, those without patches included.

    Args:
        graph: any.
        segment: number of any segment with this world.

    Returns:
        ``(N,)`` increasing identifiers.
    """
    world = graph.world_of(segment)
    kept = [f.identifier for f in graph.archive if f.anchor is None]
    return np.array([k for k in kept if graph.segment_of(k) >= 0 and graph.world_of(graph.segment_of(k)) == world], int)


def move_window(graph: KeyframeGraph, before_cw: Tensor, similarity: Tensor) -> None:
    """Move the window along with a keyframe outside of it, and the keyframes that were dropped from it.

    Args:
        graph: its window is changed.
        before_cw: ``(7,)`` float64 pose of that keyframe before.
        similarity: ``(8,)`` float64 world to camera of the keyframe now, see :func:`apply_similarities`.
    """
    window, scale = graph.window, float(similarity[7])
    if not len(window):
        return
    now = torch.cat([similarity[:3] / scale, similarity[3:7]])
    poses = window.poses_cw.double().cpu()
    relative = se3.relative(before_cw.expand_as(poses), poses)
    relative = torch.cat([relative[:, :3] / scale, relative[:, 3:]], 1)
    window.poses_cw = se3.normalise(se3.compose(relative, now.expand_as(poses))).to(window.poses_cw)
    patches = window.patches.clone()
    patches[:, 2] *= scale
    window.patches = patches
    _rescale_relative(graph, {frame.identifier: scale for frame in window.frames if not frame.guest})


def carry(
    graph: KeyframeGraph, identifiers: np.ndarray, before_cw: Tensor, similarities: Tensor
) -> tuple[Carried, ...]:
    """Move the window along with keyframes that have moved, if it is in one of their worlds.

    Args:
        graph: its window is changed.
        identifiers: ``(N,)`` increasing.
        before_cw: ``(N, 7)`` float64 poses of the keyframes before.
        similarities: ``(N, 8)`` of the keyframes now, see :func:`apply_similarities`.

    Returns:
        How the newest poses of the worlds have moved, see :attr:`Moved.worlds`.
    """
    last = {graph.world_of(graph.segment_of(k)): row for row, k in enumerate(identifiers.tolist())}
    carriers, present, carrier = dict(last), graph.world_of(graph.segment), window_carrier(graph, identifiers)
    carriers.pop(present, None)
    if carrier is not None:
        move_window(graph, before_cw[carrier], similarities[carrier])
        carriers[present] = carrier
    return tuple(
        Carried(
            world, sim3.compose(sim3.inverse(similarities[row]), sim3.from_se3(before_cw[row])),
            graph.archive[int(identifiers[last.get(world, row)])].timestamp, world == present,
        )
        for world, row in carriers.items()
    )  # fmt: skip


def window_carrier(graph: KeyframeGraph, identifiers: np.ndarray) -> int | None:
    """Keyframe outside of the window that the window moves along with: the last of its segment, or the one by which its
    segment was located.

    Args:
        graph: with a window.
        identifiers: ``(N,)`` increasing, of the keyframes that move.

    Returns:
        Its row in ``identifiers``; None if it is not among them.
    """
    own = [row for row, k in enumerate(identifiers) if graph.segment_of(int(k)) == graph.segment]
    found = np.flatnonzero(identifiers == graph.located) if graph.located is not None else own
    return own[-1] if own else int(found[0]) if len(found) else None


def similarity_between(poses_cw: Tensor, found_cw: Tensor, scale: float) -> Tensor:
    """Similarity from the world of poses to another world in which they were found.

    Args:
        poses_cw: ``(7,)`` float64 ``T_cw`` of a keyframe in its world.
        found_cw: ``(7,)`` ``T_cw`` of the same keyframe in the other world.
        scale: of lengths, in the other world over its own.

    Returns:
        ``(8,)`` similarity of points.
    """
    return sim3.compose(sim3.inverse(sim3.from_se3(found_cw)), sim3.from_se3(_scaled(poses_cw, scale), scale))


def _scaled(pose_cw: Tensor, scale: float) -> Tensor:
    return torch.cat([pose_cw[:3] * scale, pose_cw[3:]])
