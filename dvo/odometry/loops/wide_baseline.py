"""Pose of a keyframe relative to keyframes that saw the same from far away: from corners, without the network.

Matching features of the network are those of a camera that moves a little; half a metre and fifteen degrees aside,
hardly any of them is found. SIFT (Lowe, "Distinctive image features from scale-invariant keypoints", 2004) is made for
such views. Corners of the later keyframe are matched with those of each earlier one; the essential matrix in RANSAC
(Nister, "An efficient solution to the five-point relative pose problem", 2004) gives rotation and direction, and the
depths that the patches of both segments have near the corners give the distance, and how long the unit of the later
segment is in that of the earlier.

This is a place to start from. Whether the two show the same is decided by the network, as for every loop.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3, so3
from dvo.map.archive import ArchivedKeyframe
from dvo.odometry.loops.guess import points_of
from dvo.odometry.loops.joint_window import Group

AGREEING = 15
"""Least number of corners that agree on a pose."""
_CORNERS, _CONTRAST = 800, 0.02  # of an image, at most, and least contrast: working images are small
_RATIO = 0.8  # of the distances to the best and the next best corner (Lowe)
_REACH = 2.0  # largest distance of an inlier from its epipolar line, pixels of the working image
_SURE = 0.999  # probability of RANSAC
_PARALLAX = np.deg2rad(1.0)  # least angle of the rays of a corner with a depth
_NEAR = 12.0  # largest distance of a patch from a corner that takes its depth, pixels of the working image
_SCALED = 6  # least number of corners with the depth of a patch


@dataclass(frozen=True)
class WidePose:
    """Pose from corners.

    Attributes:
        pose_cw: ``(7,)`` float64 ``T_cw`` of the later keyframe in the world of the older group.
        scale: of the lengths of the newer group in the unit of the older.
        inliers: number of corners that agree with the pose.
    """

    pose_cw: Tensor
    scale: float
    inliers: int


@dataclass(frozen=True)
class Corners:
    """Corners of an image.

    Attributes:
        rays: ``(N, 2)`` on the plane at depth 1 of the camera.
        descriptors: ``(N, 128)`` float32, root of the L1-normalised SIFT (Arandjelovic and Zisserman, 2012).
        pixel: size of a pixel of the working image on that plane.
    """

    rays: np.ndarray
    descriptors: np.ndarray
    pixel: float


def corners_of(frame: ArchivedKeyframe, stride: int) -> Corners | None:
    """Find the corners of a keyframe.

    Args:
        frame: with its image.
        stride: pixels of the working image to a pixel of the feature map.

    Returns:
        The corners; None if its image cannot be read or has none.
    """
    image = frame.image()
    if image is None:
        return None
    sift = cv2.SIFT.create(nfeatures=_CORNERS, contrastThreshold=_CONTRAST)
    points, found = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if found is None or not len(points):
        return None
    fx, fy, cx, cy = (frame.intrinsics.astype(float) * stride).tolist()
    rays = (np.array([point.pt for point in points]) - (cx, cy)) / (fx, fy)
    return Corners(rays, np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1e-9)), 1.0 / fx)


def find_pose(
    old: Group, old_cw: Tensor, new: Group, moved: Tensor, later: int, stride: int
) -> Generator[None, None, WidePose | None]:
    """Find the pose of a keyframe of a segment in the world of another one, in steps: an image is looked at.

    Args:
        old: keyframes of the earlier segment.
        old_cw: ``(n, 7)`` their poses ``T_cw``.
        new: keyframes of the later segment.
        moved: ``(m, 7)`` transforms from the camera of the later keyframe to theirs, in their own unit.
        later: its place among them.
        stride: pixels of the working image to a pixel of the feature map.

    Returns:
        The pose with the most inliers; None if there are too few for any, or for its distance and scale.
    """
    target, best = corners_of(new[later], stride), None
    if target is None:
        return None
    for frame, pose_cw in zip(old, old_cw, strict=True):
        yield
        corners = corners_of(frame, stride)
        found = None if corners is None else _relative(corners, target)
        if found is None or (best is not None and len(found.here) <= best.inliers):
            continue
        far = _ratio(found.here, found.depth_here, _seen(old, old_cw, pose_cw), target.pixel)
        near = _ratio(found.there, found.depth_there, _seen(new, moved, moved[later]), target.pixel)
        if far is not None and near is not None:
            relative = torch.cat([far * found.relative[:3], found.relative[3:]])
            best = WidePose(se3.compose(relative, pose_cw), far / near, len(found.here))
    return best


@dataclass(frozen=True)
class _Relative:
    """Relative pose of two views up to the distance, which is 1, with the rays and the depths of its inliers."""

    relative: Tensor
    here: np.ndarray
    there: np.ndarray
    depth_here: np.ndarray
    depth_there: np.ndarray


def _relative(first: Corners, second: Corners) -> _Relative | None:
    """Relative pose of two views from their corners; None if too few agree. Depths without parallax are nan."""
    rows, columns = _matches(first, second)
    if len(rows) < AGREEING:
        return None
    here, there, camera = first.rays[rows], second.rays[columns], np.eye(3)
    essential, inside = cv2.findEssentialMat(here, there, camera, cv2.USAC_ACCURATE, _SURE, _REACH * second.pixel)
    if essential is None or essential.shape != (3, 3):
        return None
    count, rotation, shift, inside = cv2.recoverPose(essential, here, there, camera, mask=inside)
    if count < AGREEING:
        return None
    kept = inside.ravel() > 0
    here, there, direction = here[kept], there[kept], shift.ravel()
    one, two = _rays(here) @ rotation.T, _rays(there)
    # one * depth_here + direction = two * depth_there, by least squares
    a, b, c = (one * one).sum(1), (one * two).sum(1), (two * two).sum(1)
    wide = np.arccos(np.clip(b / np.sqrt(a * c), -1, 1)) > _PARALLAX
    across = np.where(wide, a * c - b * b, np.nan)
    depth_here = (b * (two @ direction) - c * (one @ direction)) / across
    depth_there = (a * (two @ direction) - b * (one @ direction)) / across
    pose = torch.cat([torch.from_numpy(direction), so3.from_matrix(torch.from_numpy(rotation))])
    return _Relative(pose, here, there, depth_here, depth_there)


def _seen(group: Group, poses_cw: Tensor, pose_cw: Tensor) -> np.ndarray:
    """Patches ``(M, 3)`` of a group in a camera."""
    moved = se3.relative(poses_cw, pose_cw.expand(len(poses_cw), 7))
    return torch.cat([se3.act(one, points_of(frame)) for frame, one in zip(group, moved, strict=True)]).numpy()


def _ratio(rays: np.ndarray, depths: np.ndarray, patches: np.ndarray, pixel: float) -> float | None:
    """Median ratio of the depths of the patches near corners to those of the corners; None if there are too few."""
    patches = patches[patches[:, 2] > 0]
    if not len(patches):
        return None
    apart = np.linalg.norm(rays[:, None] - patches[:, :2] / patches[:, 2:], axis=-1)
    nearest = apart.argmin(1)
    ratio = patches[nearest, 2] / depths
    ratio = ratio[(apart.min(1) < _NEAR * pixel) & np.isfinite(ratio) & (ratio > 0)]
    return float(np.median(ratio)) if len(ratio) >= _SCALED else None


def _rays(rays: np.ndarray) -> np.ndarray:
    return np.column_stack([rays, np.ones(len(rays))])


def _matches(first: Corners, second: Corners) -> tuple[np.ndarray, np.ndarray]:
    """Rows of corners that are each other's best match, and clearly better than the next one."""
    if len(first.rays) < 2 or len(second.rays) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    alike = first.descriptors @ second.descriptors.T
    best, rows = alike.argmax(1), np.arange(len(alike))
    least = np.sqrt(np.maximum(2 - 2 * np.partition(alike, -2, axis=1)[:, -2:], 0))
    kept = (least[:, 1] < _RATIO * least[:, 0]) & (alike.argmax(0)[best] == rows)
    return rows[kept], best[kept]
