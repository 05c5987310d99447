"""Height of the camera over the ground, in the unit of a map: local planes of its points below the camera.

Around each keyframe, the points of it and its neighbours that the camera looks down on are searched for a plane whose
normal is the vertical of the image up to a tilt: by planes through three random points, of which the one with most
points near it is fitted again. It is the ground if hardly any point lies below it. Points near the horizon are left
out: they are far away, so that their depth is not sure, and few of them are on the ground. The estimate of a trajectory
is the median over its keyframes: a monocular map drifts in scale, and one plane for all of it would not be flat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dvo.geometry.poses import invert_poses, quaternion_to_matrix
from dvo.map.archive import ArchivedKeyframe
from dvo.map.map import MIN_NEARNESS

_NEIGHBOURS = 8  # keyframes before and after whose points take part
_STEEP = 0.07  # least slope of the view of a point, 4 degrees below the axis of the camera
_MIN_POINTS = 12  # points of a plane
_SHARE = 0.25  # of the points below the camera that a plane needs
_BELOW = 0.1  # share of these points that may lie below it
_NEAR_PLANE = 0.08  # distance of a point from its plane, of the height: a smooth road is measured to about a tenth
_SAMPLES = 200
_KEYFRAMES = 400  # that are looked at, at most


@dataclass(frozen=True)
class GroundHeight:
    """Height of the camera over the ground in the unit of the map.

    Attributes:
        height: median over the keyframes with a ground plane; nan if there are too few.
        spread: standard deviation of the heights of single keyframes relative to it (1.4826 times the median absolute
            deviation of their logarithm).
        keyframes: number of keyframes with a ground plane.
        looked_at: number of keyframes that were looked at.
    """

    height: float
    spread: float
    keyframes: int
    looked_at: int

    @property
    def deviation(self) -> float:
        """Standard deviation of ``height`` relative to it; neighbours that share points count as one observation."""
        return self.spread / math.sqrt(max(1.0, self.keyframes / (2 * _NEIGHBOURS + 1)))


def ground_height(frames: list[ArchivedKeyframe], poses_cw: np.ndarray, tilt: float, seed: int = 0) -> GroundHeight:
    """Estimate the height of the camera over the ground.

    Args:
        frames: kept keyframes of one world, in order of time, with patches.
        poses_cw: ``(N, 7)`` their poses, world to camera.
        tilt: largest angle between the normal of the ground and the vertical of the image, degrees.
        seed: of the samples.

    Returns:
        The estimate. Its height is nan where less than a quarter of the keyframes, or fewer than three, have a plane.
    """
    rng = np.random.default_rng(seed)
    rotations, shifts = quaternion_to_matrix(poses_cw[:, 3:]), poses_cw[:, :3]
    poses_wc = invert_poses(poses_cw)
    turned = quaternion_to_matrix(poses_wc[:, 3:])
    points = [_points(f) @ turned[k].T + poses_wc[k, :3] for k, f in enumerate(frames)]
    step = max(1, -(-len(frames) // _KEYFRAMES))
    found, looked_at = [], 0
    for k in range(0, len(frames), step):
        near = np.concatenate(points[max(0, k - _NEIGHBOURS) : k + _NEIGHBOURS + 1])
        height = plane_below(near @ rotations[k].T + shifts[k], tilt, rng)
        looked_at += 1
        if height is not None:
            found.append(height)
    if len(found) < max(3, looked_at / 4):
        return GroundHeight(math.nan, math.nan, len(found), looked_at)
    heights = np.array(found)
    median = float(np.median(heights))
    spread = 1.4826 * float(np.median(np.abs(np.log(heights / median))))
    return GroundHeight(median, spread, len(found), looked_at)


def plane_below(points: np.ndarray, tilt: float, rng: np.random.Generator) -> float | None:
    """Find the ground plane among points in the frame of a camera.

    Args:
        points: ``(P, 3)`` x right, y down, z forward.
        tilt: largest angle between the normal and the y axis, degrees.
        rng: of the samples.

    Returns:
        Distance of the camera from the plane; None if there is no ground plane.
    """
    below = points[points[:, 1] > 0]
    if len(below) < _MIN_POINTS:
        return None
    triples = below[np.array([rng.choice(len(below), 3, replace=False) for _ in range(_SAMPLES)])]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    upright = np.abs(normals[:, 1]) >= math.cos(math.radians(tilt)) * length
    valid = (length > 1e-12) & upright
    if not valid.any():
        return None
    normals = normals[valid] * (np.sign(normals[valid, 1:2]) / length[valid, None])
    heights = (normals * triples[valid, 0]).sum(1)
    off = normals @ below.T - heights[:, None]  # positive: farther down than the plane
    inside = (np.abs(off) < _NEAR_PLANE * heights[:, None]) & (heights[:, None] > 0)
    best = int(inside.sum(1).argmax())
    chosen = inside[best]
    for _ in range(3):
        if chosen.sum() < max(_MIN_POINTS, _SHARE * len(below)):
            return None
        normal, height = _fit(below[chosen])
        distance = below @ normal - height
        chosen = np.abs(distance) < _NEAR_PLANE * height
    steep = normal[1] < math.cos(math.radians(tilt))
    deeper = (distance > 2 * _NEAR_PLANE * height).mean() > _BELOW
    return None if height <= 0 or steep or deeper else height


def _fit(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Least-squares plane: its normal, pointing down, and its distance along it."""
    centre = points.mean(0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    normal = normal if normal[1] > 0 else -normal
    return normal, float(normal @ centre)


def _points(frame: ArchivedKeyframe) -> np.ndarray:
    """``(P, 3)`` points of a keyframe in its camera, without those near the horizon or too far away."""
    depth = frame.inverse_depth.astype(np.float64)
    fx, fy, cx, cy = frame.intrinsics.astype(np.float64)
    x, y = frame.centres.astype(np.float64).T
    rays = np.column_stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)])
    used = (depth > MIN_NEARNESS * np.median(depth)) & (rays[:, 1] > _STEEP)
    return rays[used] / depth[used, None]
