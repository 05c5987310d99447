"""Depth maps of keyframes: reliability by confidence and by agreement between keyframes; their fused point cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dvo.geometry import se3
from dvo.odometry.protocol import DepthMap, SparseMap

NEIGHBOURS = (-2, -1, 1, 2)
"""Keyframes, relative to each, with which its depths are compared."""
_MIN_SHARE = 0.25  # of the mean inverse depth of a map, below which a point is too far away for a map


@dataclass(frozen=True)
class StoredDepth:
    """Inverse depth map that has left the window.

    Attributes:
        number: of the keyframe in the log.
        segment: number of its segment.
        timestamp: seconds.
        intrinsics: ``(4,)`` float32 of the map.
        inverse_depth: ``(h, w)`` float32.
        confidence: ``(h, w)`` float32 in [0, 1].
        colors: ``(h, w, 3)`` uint8 RGB.
    """

    number: int
    segment: int
    timestamp: float
    intrinsics: np.ndarray
    inverse_depth: np.ndarray
    confidence: np.ndarray
    colors: np.ndarray


def agreeing_views(
    poses_cw: Float[Tensor, "N 7"],
    inverse_depth: Float[Tensor, "N h w"],
    intrinsics: Float[Tensor, "N 4"],
    tolerance: float,
) -> Int[Tensor, "N h w"]:
    """Number of neighbouring maps that agree with the depth of each pixel (``depth_filter`` of DROID-SLAM).

    A point is moved into the neighbour; one of the four pixels around it there, or their interpolation, which is exact
    on a plane, must have its depth, up to the tolerance, which is relative, since depths are up to scale.

    Args:
        poses_cw: world to camera.
        inverse_depth: of each frame.
        intrinsics: ``fx fy cx cy`` in pixels of the maps.
        tolerance: relative difference of depths.

    Returns:
        From 0 to 4: the two frames before and the two after it count.
    """
    n, h, w = inverse_depth.shape
    count = torch.zeros(n, h, w, dtype=torch.int64, device=inverse_depth.device)
    points = backproject(inverse_depth, intrinsics)
    for step in NEIGHBOURS:
        here = torch.arange(max(0, -step), min(n, n - step), device=count.device)
        if not len(here):
            continue
        there = here + step
        moved = se3.act(se3.relative(poses_cw[here], poses_cw[there])[:, None, None], points[here])
        fx, fy, cx, cy = (value[:, None, None] for value in intrinsics[there].unbind(-1))
        z = moved[..., 2]
        ahead = z > 1e-6
        divisor = torch.where(ahead, z, 1.0)
        x, y = moved[..., 0] / divisor * fx + cx, moved[..., 1] / divisor * fy + cy
        inside = ahead & (x >= 0) & (y >= 0) & (x < w - 1) & (y < h - 1)
        column, row = (torch.where(inside, value, 0.0).floor().long() for value in (x, y))
        maps = inverse_depth[there].flatten(1)
        right, down = x - column, y - row
        blended, agrees = torch.zeros_like(z), torch.zeros_like(inside)
        for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
            index = (row + dy).clamp(max=h - 1) * w + (column + dx).clamp(max=w - 1)
            other = maps.gather(1, index.flatten(1)).view_as(z)
            blended += other * (right if dx else 1 - right) * (down if dy else 1 - down)
            agrees |= (z * other - 1).abs() < tolerance
        agrees |= (z * blended - 1).abs() < tolerance
        count[here] += (inside & agrees).long()
    return count


def backproject(inverse_depth: Float[Tensor, "N h w"], intrinsics: Float[Tensor, "N 4"]) -> Float[Tensor, "N h w 3"]:
    """Points of the pixels of maps in the coordinates of their cameras.

    Args:
        inverse_depth: of each frame, positive.
        intrinsics: ``fx fy cx cy`` in pixels of the maps.

    Returns:
        Points.
    """
    h, w = inverse_depth.shape[-2:]
    fx, fy, cx, cy = (value[:, None, None] for value in intrinsics.unbind(-1))
    x = torch.arange(w, device=inverse_depth.device)
    y = torch.arange(h, device=inverse_depth.device)[:, None]
    z = 1.0 / inverse_depth
    return torch.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], -1)


def reliable_pixels(
    confidence: Float[Tensor, "N h w"], inverse_depth: Float[Tensor, "N h w"], views: Int[Tensor, "N h w"],
    least_confidence: float, least_views: int,
) -> Bool[Tensor, "N h w"]:  # fmt: skip
    """Pixels whose depth is confident, agrees with other maps, and is not far beyond the depths of its map.

    Args:
        confidence: in [0, 1].
        inverse_depth: of each frame.
        views: of :func:`agreeing_views`.
        least_confidence: threshold.
        least_views: maps that must agree; fewer where a sequence has fewer.

    Returns:
        Mask.
    """
    n = len(inverse_depth)
    possible = torch.tensor([sum(0 <= k + step < n for step in NEIGHBOURS) for k in range(n)], device=views.device)
    enough = views >= possible.clamp(max=least_views)[:, None, None]
    near = inverse_depth > _MIN_SHARE * inverse_depth.mean((1, 2), keepdim=True)
    return enough & near & (confidence >= least_confidence)


def depth_maps(
    stored: list[StoredDepth],
    poses_cw: dict[int, np.ndarray],
    *,
    confidence: float,
    tolerance: float,
    views: int,
) -> tuple[list[DepthMap], list[SparseMap]]:
    """Depth maps of keyframes, filtered, and their points in the world.

    Args:
        stored: in order of time, of any number of segments; maps of one size.
        poses_cw: ``T_cw`` by keyframe; a map without a pose is left out.
        confidence, tolerance, views: thresholds, see :class:`dvo.odometry.droid.config.DenseConfig`.

    Returns:
        The maps, and the reliable points of each.
    """
    maps: list[DepthMap] = []
    clouds: list[SparseMap] = []
    known = [item for item in stored if item.number in poses_cw]
    for segment in sorted({item.segment for item in known}):
        items = [item for item in known if item.segment == segment]
        poses = torch.from_numpy(np.stack([poses_cw[item.number] for item in items]))
        inverse = torch.from_numpy(np.stack([item.inverse_depth for item in items])).double()
        intrinsics = torch.from_numpy(np.stack([item.intrinsics for item in items])).double()
        sure = torch.from_numpy(np.stack([item.confidence for item in items]))
        reliable = reliable_pixels(
            sure, inverse, agreeing_views(poses, inverse, intrinsics, tolerance), confidence, views
        )
        poses_wc = se3.normalise(se3.inverse(poses))
        world = se3.act(poses_wc[:, None, None], backproject(inverse, intrinsics))
        for k, item in enumerate(items):
            mask = reliable[k].numpy()
            depth = (1.0 / inverse[k]).float().numpy()
            maps.append(
                DepthMap(item.timestamp, segment, poses_wc[k].numpy(), item.intrinsics, depth, item.confidence, mask)
            )
            clouds.append(SparseMap(world[k].float().numpy()[mask], item.colors[mask]))
    return maps, clouds


def fused(clouds: list[SparseMap]) -> SparseMap:
    """Point cloud of several maps in one world.

    Args:
        clouds: points of each map.

    Returns:
        All points.
    """
    if not clouds:
        return SparseMap()
    return SparseMap(np.concatenate([c.points for c in clouds]), np.concatenate([c.colors for c in clouds]))
