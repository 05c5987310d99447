"""Poses as numpy arrays, for files, ground truth and rendering (:mod:`dvo.geometry.se3` has those of the optimiser).

A pose is ``tx ty tz qx qy qz qw``; all functions take any leading shape and work in float64. A pose ``T_ab`` takes
points from frame ``b`` to frame ``a``: ``x_a = R x_b + t``.
"""

from __future__ import annotations

import numpy as np

# Columns: where the axes of a camera (x right, y down, z forward) point in a body that looks along x, with y to the
# right and z down (the camera frame of TartanAir and AirSim).
NED_FROM_CAMERA = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def pose_matrices(poses: np.ndarray) -> np.ndarray:
    """Convert poses to homogeneous matrices.

    Args:
        poses: ``(..., 7)``, quaternions of any positive length.

    Returns:
        ``(..., 4, 4)`` float64.
    """
    poses = np.asarray(poses, dtype=np.float64)
    q = poses[..., 3:] / np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    matrices = np.zeros((*poses.shape[:-1], 4, 4))
    matrices[..., 0, 0] = 1 - 2 * (y * y + z * z)
    matrices[..., 0, 1] = 2 * (x * y - z * w)
    matrices[..., 0, 2] = 2 * (x * z + y * w)
    matrices[..., 1, 0] = 2 * (x * y + z * w)
    matrices[..., 1, 1] = 1 - 2 * (x * x + z * z)
    matrices[..., 1, 2] = 2 * (y * z - x * w)
    matrices[..., 2, 0] = 2 * (x * z - y * w)
    matrices[..., 2, 1] = 2 * (y * z + x * w)
    matrices[..., 2, 2] = 1 - 2 * (x * x + y * y)
    matrices[..., :3, 3] = poses[..., :3]
    matrices[..., 3, 3] = 1
    return matrices


def poses_from_matrices(matrices: np.ndarray) -> np.ndarray:
    """Convert rigid matrices to poses.

    The quaternion is the column of largest norm of ``4 q q^T``, which never divides by something small
    (Shepperd 1978), and which tolerates rotations that are orthonormal only to the digits of a text file.

    Args:
        matrices: ``(..., 4, 4)`` or ``(..., 3, 4)``.

    Returns:
        ``(..., 7)`` float64, unit quaternions with ``qw >= 0``.
    """
    m = np.asarray(matrices, dtype=np.float64)
    r00, r01, r02 = np.moveaxis(m[..., 0, :3], -1, 0)
    r10, r11, r12 = np.moveaxis(m[..., 1, :3], -1, 0)
    r20, r21, r22 = np.moveaxis(m[..., 2, :3], -1, 0)
    outer = np.stack(
        [
            np.stack([1 + r00 - r11 - r22, r01 + r10, r02 + r20, r21 - r12], -1),
            np.stack([r01 + r10, 1 - r00 + r11 - r22, r12 + r21, r02 - r20], -1),
            np.stack([r02 + r20, r12 + r21, 1 - r00 - r11 + r22, r10 - r01], -1),
            np.stack([r21 - r12, r02 - r20, r10 - r01, 1 + r00 + r11 + r22], -1),
        ],
        -2,
    )
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., 3:] < 0, -q, q)
    return np.concatenate([m[..., :3, 3], q], axis=-1)


def compose_poses(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compose poses: ``T_ac = T_ab T_bc``.

    Args:
        a, b: ``(..., 7)``, broadcast against each other.

    Returns:
        ``(..., 7)`` float64, ``qw >= 0``.
    """
    return poses_from_matrices(pose_matrices(a) @ pose_matrices(b))


def invert_poses(poses: np.ndarray) -> np.ndarray:
    """Invert poses: ``T_ba`` of ``T_ab``.

    Args:
        poses: ``(..., 7)``.

    Returns:
        ``(..., 7)`` float64, ``qw >= 0``.
    """
    matrices = pose_matrices(poses)
    rotation = np.swapaxes(matrices[..., :3, :3], -1, -2).copy()
    position = rotation @ matrices[..., :3, 3:]
    matrices[..., :3, :3] = rotation
    matrices[..., :3, 3:] = -position
    return poses_from_matrices(matrices)


def ned_to_camera(poses: np.ndarray) -> np.ndarray:
    """Convert TartanAir's NED camera-to-world poses to those of a camera with x right, y down, z forward.

    Only the camera's axes are renamed; the world stays TartanAir's (z down), so that positions do not change.

    Args:
        poses: ``(..., 7)`` camera-to-world, camera x forward, y right, z down.

    Returns:
        ``(..., 7)`` camera-to-world, camera x right, y down, z forward.
    """
    matrices = pose_matrices(poses)
    matrices[..., :3, :3] = matrices[..., :3, :3] @ NED_FROM_CAMERA
    return poses_from_matrices(matrices)


def slerp(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Interpolate rotations spherically, along the shorter arc (Shoemake 1985).

    Args:
        a, b: ``(..., 4)`` unit quaternions ``qx qy qz qw``.
        weight: ``(...)`` of ``b``, 0 to 1.

    Returns:
        ``(..., 4)`` float64 unit quaternions.
    """
    cosine = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(cosine < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0, 1))
    weight = np.asarray(weight, dtype=np.float64)[..., None]
    # below 1e-4 rad the chord equals the arc to 1e-9 and the sines would divide 0 by 0
    small = angle < 1e-4
    sine = np.where(small, 1.0, np.sin(angle))
    wa = np.where(small, 1 - weight, np.sin((1 - weight) * angle) / sine)
    wb = np.where(small, weight, np.sin(weight * angle) / sine)
    q = wa * a + wb * b
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
