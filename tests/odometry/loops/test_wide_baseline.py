"""Pose of a keyframe from corners, across half a metre and more, and the scale of its segment."""

import cv2
import numpy as np
import pytest
import torch

from dvo.geometry import se3, so3
from dvo.map.archive import ArchivedKeyframe, encode_jpeg
from dvo.odometry.loops.wide_baseline import find_pose
from dvo.odometry.maintenance.background import all_steps

STRIDE, WIDTH, HEIGHT = 4, 320, 240
CAMERA = np.array([260.0, 260.0, 159.5, 119.5])
MATRIX = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])
WALLS = ((3.5, -6.0), (2.2, 0.3))  # distance of a wall, and where it begins to the left


def texture(seed):
    """Blobs of many sizes."""
    rng = np.random.default_rng(seed)
    parts = [cv2.resize(rng.normal(size=(n, n)), (900, 900), interpolation=cv2.INTER_CUBIC) for n in (30, 90, 225)]
    mixed = sum(parts)
    return np.clip(128 + 45 * mixed, 0, 255).astype(np.uint8)


def view(pose_cw, seed):
    """Image of two walls across z, the nearer one to the right, and the distance along z at each pixel."""
    rotation, shift = so3.matrix(pose_cw[3:]).numpy(), pose_cw[:3].numpy()
    image, depth = np.zeros((HEIGHT, WIDTH), np.uint8), np.full((HEIGHT, WIDTH), np.inf)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - CAMERA[2]) / CAMERA[0], (v - CAMERA[3]) / CAMERA[1], np.ones_like(u, float)], -1)
    for number, (far, left) in enumerate(WALLS):
        # texture pixel (a, b) lies at (a - 450, b - 450) / 110 on the wall
        place = np.array([[1 / 110, 0, -450 / 110], [0, 1 / 110, -450 / 110], [0, 0, far]])
        homography = MATRIX @ (rotation @ place + np.outer(shift, [0, 0, 1]))
        painted = cv2.warpPerspective(texture(seed + number), homography, (WIDTH, HEIGHT))
        centre = -rotation.T @ shift
        world = rays @ rotation  # R^T ray
        z = (far - centre[2]) / world[..., 2]
        seen = (z > 0) & (centre[0] + z * world[..., 0] > left)
        image, depth = np.where(seen, painted, image), np.where(seen, z, depth)
    return np.repeat(image[..., None], 3, 2), depth


def keyframe(identifier, pose_cw, seed, unit=1.0):
    """Archived keyframe whose patches have the true depths, in a unit of so many metres."""
    image, depth = view(pose_cw, seed)
    x, y = np.meshgrid(np.arange(4, 76, 6.0), np.arange(4, 56, 6.0))
    centres = np.stack([x.ravel(), y.ravel()], -1).astype(np.float32)
    z = depth[(centres[:, 1] * STRIDE).astype(int), (centres[:, 0] * STRIDE).astype(int)]
    centres, z = centres[np.isfinite(z)], z[np.isfinite(z)]
    colors = np.zeros((len(z), 3), np.uint8)
    return ArchivedKeyframe(
        identifier, 0.1 * identifier, (CAMERA / STRIDE).astype(np.float32), pose_cw.numpy(), None, centres,
        (unit / z).astype(np.float32), colors, jpeg=encode_jpeg(image, 95),
    )  # fmt: skip


def pose(x, y, z, yaw):
    turn = so3.exp(torch.tensor([0.0, np.deg2rad(yaw), 0.0], dtype=torch.float64))
    return torch.cat([torch.tensor([x, y, z], dtype=torch.float64), turn])


def found(jump, seed=0, other=0, unit=1.6):
    """What is found of two groups of three keyframes; the newer one in a unit of its own."""
    old_cw = torch.stack([pose(0.05 * k, 0, 0, 0) for k in range(3)])
    new_cw = torch.stack([se3.compose(pose(0.05 * k, 0, 0, 0), jump) for k in range(3)])
    old = tuple(keyframe(k, one, seed) for k, one in enumerate(old_cw))
    new = tuple(keyframe(10 + k, one, other or seed, unit) for k, one in enumerate(new_cw))
    moved = se3.relative(new_cw[1].expand(3, 7), new_cw)
    moved[:, :3] /= unit
    return all_steps(find_pose(old, old_cw, new, moved, 1, STRIDE)), new_cw[1]


@pytest.mark.parametrize("jump", [(0.5, 0.05, 0.0, 10.0), (-0.5, 0.0, -0.2, -14.0)])
def test_across_half_a_metre(jump):
    wide, new_cw = found(pose(*jump))
    assert wide is not None
    error = se3.relative(new_cw, wide.pose_cw)
    assert error[:3].norm() < 0.15 and so3.angle(error[3:]).rad2deg() < 2
    assert wide.scale == pytest.approx(1.6, rel=0.1)


def test_another_place_has_no_pose():
    assert found(pose(0.5, 0, 0, 10.0), other=40)[0] is None
