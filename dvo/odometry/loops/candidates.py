"""Candidates for loops: earlier keyframes that may show what a new one shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.map.map import Map
from dvo.map.places import PlaceIndex
from dvo.odometry.loops.place_descriptors import PlaceDescriptor

LIKENESS = 0.3
"""Smallest similarity of the descriptors of a candidate by retrieval, in [-1, 1]."""
RETRIEVED = 8
"""Candidates by retrieval, at most."""
MIN_DISTANCE = 6
"""Identifiers of two such candidates differ by more than this."""
OVERLAP = 0.3
"""Smallest share of the patches in view of a candidate by proximity."""
NEAREST = 2
"""Candidates by proximity, at most; as far apart in time as two visits."""


@dataclass(frozen=True)
class Candidate:
    """Pair of keyframes to verify.

    Attributes:
        old, new: identifiers of the earlier and the later keyframe.
        kind: ``"retrieval"`` by the likeness of the images, ``"proximity"`` by the poses, ``"break"`` for the last
            keyframe before a break in which the world of the later one began.
        pose_cw: ``(7,)`` pose ``T_cw`` of the later one to start from, in the world of the earlier.
    """

    old: int
    new: int
    kind: str
    pose_cw: Tensor


def by_likeness(
    graph: Map,
    places: PlaceIndex,
    descriptor: PlaceDescriptor | None,
    new: int,
    earlier: np.ndarray,
) -> Iterator[Candidate]:
    """Candidates whose descriptors are like that of a keyframe, the most alike first.

    Args:
        graph: holds the keyframes.
        places: their descriptors.
        descriptor: that made them; None for none.
        new: identifier of the keyframe.
        earlier: ``(N,)`` identifiers of the keyframes to choose from, increasing.
    """
    row = places.descriptor(new)
    if row is None or descriptor is None:
        return
    found = places.query(descriptor.views(row), RETRIEVED, before=int(earlier[-1]) + 1, apart=MIN_DISTANCE)
    for old, score in zip(found.identifiers.tolist(), found.scores.tolist(), strict=True):
        if score >= LIKENESS and graph.segment_of(old) >= 0:
            yield Candidate(old, new, "retrieval", graph.poses_cw(np.array([old]))[0])


def by_proximity(
    graph: Map, new: int, similarity: Tensor, earlier: np.ndarray, seconds: float, count: int = NEAREST
) -> Iterator[Candidate]:
    """Candidates that have the patches of a keyframe in view, as far as the poses tell: the best of different visits.

    The earliest visit comes first, since a loop with it corrects the most drift.

    Args:
        graph: holds the keyframes.
        new: identifier of the keyframe.
        similarity: ``(8,)`` from the world of the earlier keyframes to its camera, in the unit of its segment.
        earlier: ``(N,)`` identifiers of the keyframes to choose from, of one world.
        seconds: smallest time between two candidates.
        count: candidates, at most.
    """
    if not len(earlier):
        return
    scale = similarity[7]
    pose_cw = torch.cat([similarity[:3] / scale, similarity[3:7]])
    shares = overlap(graph, new, pose_cw, float(1 / scale), earlier)
    times = np.array([graph.archive[int(k)].timestamp for k in earlier])
    chosen: list[int] = []
    for row in np.lexsort((earlier, -shares)):
        if shares[row] < OVERLAP or len(chosen) >= count:
            break
        if all(abs(times[row] - times[other]) >= seconds for other in chosen):
            chosen.append(int(row))
    for row in sorted(chosen):
        yield Candidate(int(earlier[row]), new, "proximity", pose_cw)


def overlap(graph: Map, new: int, pose_cw: Tensor, scale: float, others: np.ndarray) -> np.ndarray:
    """Share ``(N,)`` of the patches of a keyframe that lie in the view of others at a similar depth.

    Args:
        graph: holds the keyframes.
        new: identifier of the keyframe.
        pose_cw: ``(7,)`` its pose ``T_cw`` in the world of the others.
        scale: of its lengths in that world.
        others: ``(N,)`` identifiers of the others.
    """
    frame = graph.archive[new]
    centres, depth = (torch.from_numpy(x).double() for x in (frame.centres, frame.inverse_depth))
    rays = rays_of(centres, torch.from_numpy(frame.intrinsics).double())
    return share_in_view(graph, rays * (scale / depth.clamp(min=1e-6))[:, None], pose_cw, others)


def rays_of(centres: Tensor, intrinsics: Tensor) -> Tensor:
    """Rays ``(M, 3)`` with z = 1 through the pixels ``(M, 2)`` of a camera with ``(4,)`` fx fy cx cy."""
    fx, fy, cx, cy = intrinsics
    x, y = centres.unbind(-1)
    return torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], -1)


def share_in_view(graph: Map, points: Tensor, pose_cw: Tensor, others: np.ndarray) -> np.ndarray:
    """Share ``(N,)`` of the points that a camera sees that lie in the view of keyframes at a similar depth.

    Args:
        graph: holds the keyframes.
        points: ``(M, 3)`` float64 in the camera, in the unit of the world of the keyframes.
        pose_cw: ``(7,)`` float64 of the camera in this world.
        others: ``(N,)`` identifiers of the keyframes.
    """
    depth, poses_cw = points[:, 2], graph.poses_cw(others)
    cameras = np.stack([graph.archive[int(k)].intrinsics for k in others])  # a map may be of another camera
    fu, fv, cu, cv = torch.from_numpy(cameras).double().T[:, :, None]
    world = se3.act(se3.inverse(pose_cw), points)
    seen = se3.act(poses_cw[:, None], world[None])
    z = seen[..., 2].clamp(min=1e-9)
    u, v = fu * seen[..., 0] / z + cu, fv * seen[..., 1] / z + cv
    inside = (u >= 0) & (u <= 2 * cu) & (v >= 0) & (v <= 2 * cv) & (seen[..., 2] > 0)
    alike = (z / depth > 0.5) & (z / depth < 2.0)
    return (inside & alike).double().mean(-1).numpy()
