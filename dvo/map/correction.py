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


def set_solution(
    graph: KeyframeGraph, world: int, identifiers: np.ndarray, poses_cw: Tensor, inverse_depths: np.ndarray
) -> Moved:
    """Give keyframes of a world the poses and depths of a solution, those in the window included.

    Keyframes that were not solved for keep their place relative to the last solved one before them, or to the first.

    Args:
        graph: its keyframes and window are changed; keyframes may have been archived, or added, since the solution was
            begun.
        world: number of the world.
        identifiers: ``(N,)`` increasing, of the keyframes that were solved for, dropped ones included.
        poses_cw: ``(N, 7)`` float64 world to camera.
        inverse_depths: ``(N, M)`` of their patches.

    Returns:
        What has moved: kept keyframes.
    """
    window, m, here = graph.window, graph.per_frame, graph.world_of(graph.segment) == world
    places = {frame.identifier: p for p, frame in enumerate(window.frames) if here and not frame.guest}
    archived = keyframes_of(graph, world)
    kept = np.concatenate([archived, np.array(list(places), int)])
    rows = {int(k): row for row, k in enumerate(identifiers)}
    solved = np.array([k for k, identifier in enumerate(kept.tolist()) if identifier in rows], int)
    if not len(solved):
        return Moved({})
    centre = window.patches.shape[-1] // 2
    known = window.patches[:, 2, centre, centre].double().cpu().numpy().reshape(-1, m)
    before = torch.cat([graph.poses_cw(archived), window.poses_cw[list(places.values())].double().cpu()])
    similarities = torch.zeros(len(kept), 8, dtype=torch.float64)
    for k in solved.tolist():
        identifier = int(kept[k])
        old = known[places[identifier]] if identifier in places else graph.archive[identifier].inverse_depth
        unit = float(np.median(inverse_depths[rows[identifier]] / old)) if len(old) else 1.0
        similarities[k] = sim3.from_se3(_in_unit(poses_cw[rows[identifier]], unit), unit)
    carriers = solved[(np.searchsorted(solved, np.arange(len(kept)), "right") - 1).clip(min=0)]
    rest = np.setdiff1d(np.arange(len(kept)), solved)
    relative = se3.relative(before[carriers[rest]], before[rest])
    similarities[rest] = sim3.compose(sim3.from_se3(relative), similarities[carriers[rest]])
    apply_similarities(graph, archived, similarities[: len(archived)])
    units = dict(zip(kept.tolist(), similarities[:, 7].tolist(), strict=True))
    _set_window(graph, places, similarities[len(archived) :], {k: inverse_depths[rows[k]] for k in places if k in rows})
    placed = dict(zip(kept.tolist(), (similarities[:, :7] / _unit_of(similarities)), strict=True))
    for identifier, row in sorted(rows.items()):  # the keyframe that a dropped one is relative to comes first
        if identifier not in places and identifier in graph.archive:
            _set_archived(graph, identifier, poses_cw[row], inverse_depths[row], placed)
    if not here:
        return Moved(units)
    change = sim3.compose(sim3.inverse(similarities[-1]), sim3.from_se3(before[-1]))
    newest = int(kept[solved[-1]])
    time = window.frames[places[newest]].timestamp if newest in places else graph.archive[newest].timestamp
    return Moved(units, (Carried(world, change, time, window=True),))


def _in_unit(pose_cw: Tensor, unit: float) -> Tensor:
    return torch.cat([pose_cw[:3] * unit, pose_cw[3:]])


def _unit_of(similarities: Tensor) -> Tensor:
    """Divisors ``(N, 7)`` that make poses of similarities."""
    return torch.cat([similarities[:, 7:].expand(-1, 3), torch.ones(len(similarities), 4, dtype=torch.float64)], 1)


def _set_window(
    graph: KeyframeGraph, places: Mapping[int, int], similarities: Tensor, solved: Mapping[int, np.ndarray]
) -> None:
    """Move keyframes of the window, and what is relative to them; those that were solved for take their depths."""
    window, m, centre = graph.window, graph.per_frame, graph.window.patches.shape[-1] // 2
    poses, patches = window.poses_cw.clone(), window.patches.clone()
    units = similarities[:, 7]
    for (identifier, place), similarity in zip(places.items(), similarities, strict=True):
        own, unit = patches[place * m : (place + 1) * m, 2], float(similarity[7])
        pose = torch.cat([similarity[:3] / unit, similarity[3:7]])
        poses[place] = se3.normalise(pose).to(poses)
        if identifier in solved:
            own *= (torch.from_numpy(solved[identifier]).to(own) / own[:, centre, centre])[:, None, None]
        else:
            own *= unit
    window.poses_cw, window.patches = poses, patches
    _rescale_relative(graph, dict(zip(places, units.tolist(), strict=True)))


def _set_archived(
    graph: Map, identifier: int, pose_cw: Tensor, inverse_depth: np.ndarray, placed: dict[int, Tensor]
) -> None:
    """Set pose and depths of an archived keyframe; ``placed``: poses of the kept ones, and those that are set."""
    frame = graph.archive[identifier]
    depths = inverse_depth.astype(np.float32) if len(frame.inverse_depth) else frame.inverse_depth
    placed[identifier] = pose_cw
    if frame.anchor is None:
        graph.correct(identifier, pose_cw.numpy(), depths)
        return
    anchor_cw = _placed(graph, frame.anchor, placed)
    relative = se3.relative(anchor_cw, pose_cw).numpy()
    graph.archive.set_pose(identifier, relative, depths, frame.anchor)
    graph.log.reanchor(identifier, frame.anchor, relative)


def _placed(graph: Map, identifier: int, placed: Mapping[int, Tensor]) -> Tensor:
    """Pose ``(7,)`` of a keyframe whose chain of keyframes that it is relative to may end in the window."""
    if identifier in placed:
        return placed[identifier]
    frame = graph.archive[identifier]
    own = torch.from_numpy(frame.pose_cw)
    return own if frame.anchor is None else se3.compose(own, _placed(graph, frame.anchor, placed))


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
