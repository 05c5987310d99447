"""Edges of a frame graph: distances between frames by their flow, and choice of edges (DROID-SLAM 3.4)."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dvo.ba.layer.dense import dense_patches
from dvo.geometry import se3
from dvo.geometry.projection import reproject

FAR_DISTANCE = 1e3
"""Distance of frames that hardly see each other, feature pixels."""
_SHARE = 0.75  # of the pixels that must be in front of the other frame
_STEP = 2  # every second pixel of a row and of a column is enough for a mean

Edge = tuple[int, int]


def flow_distances(
    poses_cw: Float[Tensor, "N 7"],
    inverse_depth: Float[Tensor, "N h w"],
    intrinsics: Float[Tensor, "N 4"],
    translation_share: float,
    pairs: list[Edge] | None = None,
) -> np.ndarray:
    """Mean flow between frames, in part that of the translation alone, which shows another side of the scene.

    Args:
        poses_cw: world to camera.
        inverse_depth: of each frame.
        intrinsics: ``fx fy cx cy`` in pixels of the maps.
        translation_share: weight of the flow without the rotation, in [0, 1].
        pairs: ordered pairs of frames; None for all of them.

    Returns:
        ``(N, N)`` feature pixels, or ``(P,)`` for pairs; the mean of both directions, :data:`FAR_DISTANCE` for frames
        of which one sees less than three quarters of the other's points in front of it.
    """
    n = len(poses_cw)
    wanted = [(i, j) for i in range(n) for j in range(n)] if pairs is None else pairs
    both = torch.tensor([*wanted, *((j, i) for i, j in wanted)], device=poses_cw.device).view(-1, 2)
    ii, jj = both.unbind(1)
    patches = dense_patches(inverse_depth[None])[..., ::_STEP, ::_STEP]
    start = patches[:, ii, :2].permute(0, 1, 3, 4, 2)
    motion = se3.relative(poses_cw[ii], poses_cw[jj])
    straight = torch.cat([motion[:, :3], se3.identity(len(motion), device=motion.device)[:, 3:]], -1)
    total = torch.zeros(len(both), device=poses_cw.device)
    seen = torch.ones(len(both), dtype=torch.bool, device=poses_cw.device)
    for share, moves in ((1 - translation_share, motion), (translation_share, straight)):
        # Each pair is a problem of two poses: the identity and the motion.
        poses = torch.cat([se3.identity(len(both), device=motion.device), moves])[None]
        camera = torch.cat([intrinsics[ii], intrinsics[jj]])[None]
        first = torch.arange(len(both), device=ii.device)
        second = first + len(both)
        there = reproject(poses, patches, camera, first, second, ii)
        length = (there.coords - start).norm(dim=-1)[0].clamp(max=FAR_DISTANCE)
        valid = there.valid[0]
        count = valid.flatten(1).sum(1)
        total += share * torch.where(valid, length, 0.0).flatten(1).sum(1) / count.clamp(min=1)
        seen &= count >= _SHARE * valid[0].numel()
    found = torch.where(seen, total, FAR_DISTANCE).view(2, -1)
    distance = found.mean(0).clamp(max=FAR_DISTANCE).double().cpu().numpy()
    return distance.reshape(n, n) if pairs is None else distance


def neighbours_of(frame: int, radius: int) -> list[Edge]:
    """Edges between a frame and those before it, in both directions, the nearest first.

    Args:
        frame: position.
        radius: number of frames before it.

    Returns:
        The edges.
    """
    near = range(frame - 1, max(-1, frame - 1 - radius), -1)
    return [edge for j in near for edge in ((frame, j), (j, frame))]


def proximity_edges(
    distances: np.ndarray,
    existing: Collection[Edge],
    *,
    first: int,
    radius: int,
    separation: int,
    threshold: float,
    limit: int,
) -> list[Edge]:
    """Edges between frames farther apart in time that see the same, the closest first.

    Args:
        distances: ``(N, N)`` of :func:`flow_distances`.
        existing: edges that are there, active or held.
        first: the later frame of an edge is this one or a newer one.
        radius: frames at most so far apart in time are joined elsewhere.
        separation: an edge suppresses others whose ends are nearer to its own than this, in sum (non-maximum
            suppression; less for edges of little reach).
        threshold: largest distance.
        limit: number of edges, both directions counted.

    Returns:
        Edges in both directions.
    """
    n = len(distances)
    open_ = np.full((n, n), np.inf)
    for i in range(first, n):
        for j in range(i - radius):
            open_[i, j] = distances[i, j]

    def suppress(i: int, j: int) -> None:
        reach = max(min(abs(i - j) - 2, separation), 0)
        for di in range(-reach, reach + 1):
            for dj in range(abs(di) - reach, reach - abs(di) + 1):
                if 0 <= i + di < n and 0 <= j + dj < n:
                    open_[i + di, j + dj] = np.inf

    for i, j in existing:
        suppress(i, j)
    found: list[Edge] = []
    while len(found) + 2 <= limit:
        i, j = (int(x) for x in np.unravel_index(np.argmin(open_), open_.shape))
        if not open_[i, j] <= threshold:
            break
        found += [(i, j), (j, i)]
        suppress(i, j)
    return found
