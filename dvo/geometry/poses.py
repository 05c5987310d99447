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
    return np.concatenate([m[..., :3, 3], matrix_to_quaternion(m[..., :3, :3])], axis=-1)


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


# Rotations as matrices and as rotation vectors, for laying out scenes and camera paths (dvo.synth).
#
# ``compose_rodrigues`` and ``invert_rodrigues`` are the operations of ``compose_poses`` and ``invert_poses``, and
# ``quaternion_to_matrix`` that of ``pose_matrices``, with another order of the same sums. They differ in the last bit.
# Both stay, because the bytes of rendered suites and training clips depend on the one, those of ground truth read from
# data sets on the other.


def skew(v: np.ndarray) -> np.ndarray:
    """Cross-product matrix.

    Args:
        v: ``(..., 3)``.

    Returns:
        ``(..., 3, 3)`` with ``skew(v) @ w = v x w``.
    """
    out = np.zeros((*v.shape[:-1], 3, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def so3_exp(phi: np.ndarray) -> np.ndarray:
    """Exponential map of SO(3) (Rodrigues' formula).

    Args:
        phi: ``(..., 3)`` rotation vector, rad.

    Returns:
        ``(..., 3, 3)`` rotation matrix.
    """
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    s = np.sinc(angle / np.pi)
    c = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    k = skew(phi)
    return np.eye(3) + s * k + c * (k @ k)


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Logarithm of rotations of angles well below pi, accurate for tiny ones.

    Args:
        rotation: ``(..., 3, 3)``.

    Returns:
        ``(..., 3)`` rad.
    """
    twist = 0.5 * np.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )  # sin(angle) * axis
    sine = np.linalg.norm(twist, axis=-1, keepdims=True)
    cosine = (np.trace(rotation, axis1=-2, axis2=-1)[..., None] - 1) / 2
    return twist * np.where(sine > 1e-12, np.arctan2(sine, cosine) / np.maximum(sine, 1e-300), 1.0)


def se3_exp(xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exponential map of SE(3).

    Args:
        xi: ``(..., 6)`` twist ``[tau, phi]``, translation first.

    Returns:
        Rotation ``(..., 3, 3)`` and translation ``(..., 3)``.
    """
    tau, phi = xi[..., :3], xi[..., 3:]
    angle2 = (phi**2).sum(-1)[..., None, None]
    angle = np.sqrt(angle2)
    c = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    # Below 1e-3 rad the series, because the quotient loses its digits.
    safe = np.where(angle2 < 1e-6, 1.0, angle2)
    d = np.where(angle2 < 1e-6, 1.0 / 6 - angle2 / 120, (1 - np.sinc(angle / np.pi)) / safe)
    k = skew(phi)
    v = np.eye(3) + c * k + d * (k @ k)
    return so3_exp(phi), (v @ tau[..., None])[..., 0]


def quaternion_to_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices of quaternions (Rodrigues' formula).

    Args:
        q: ``(..., 4)`` ``qx qy qz qw`` of any positive length.

    Returns:
        ``(..., 3, 3)``.
    """
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3][..., None, None]
    k = skew(v)
    return np.eye(3) + 2 * w * k + 2 * (k @ k)


def matrix_to_quaternion(m: np.ndarray) -> np.ndarray:
    """Unit quaternions of rotation matrices, from the column of largest norm of ``4 q q^T`` (Shepperd 1978).

    Args:
        m: ``(..., 3, 3)``.

    Returns:
        ``(..., 4)`` ``qx qy qz qw``, ``qw >= 0``.
    """
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    dx, dy, dz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    rows = [
        (1 + m00 - m11 - m22, xy, xz, dx),
        (xy, 1 - m00 + m11 - m22, yz, dy),
        (xz, yz, 1 - m00 - m11 + m22, dz),
        (dx, dy, dz, 1 + m00 + m11 + m22),
    ]
    outer = np.stack([np.stack(row, -1) for row in rows], -2)  # 4 q q^T
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), -1)
    q = np.take_along_axis(outer, best[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def pose_from(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Poses from their parts; the inverse of :func:`split`.

    Args:
        rotation: ``(..., 3, 3)``.
        translation: ``(..., 3)``.

    Returns:
        ``(..., 7)``.
    """
    return np.concatenate([translation, matrix_to_quaternion(rotation)], -1)


def split(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of poses.

    Args:
        pose: ``(..., 7)``.

    Returns:
        Rotation ``(..., 3, 3)`` and translation ``(..., 3)``.
    """
    return quaternion_to_matrix(pose[..., 3:]), pose[..., :3]


def invert_rodrigues(pose: np.ndarray) -> np.ndarray:
    """Inverse of poses, as the renderer computes it (see the comment above on :func:`invert_poses`).

    Args:
        pose: ``(..., 7)``.

    Returns:
        ``(..., 7)``.
    """
    r, t = split(pose)
    rt = np.swapaxes(r, -1, -2)
    return pose_from(rt, -(rt @ t[..., None])[..., 0])


def compose_rodrigues(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product ``a b`` (first ``b``, then ``a``), as the renderer computes it (see the comment above).

    Args:
        a: ``(..., 7)``.
        b: ``(..., 7)``, broadcast.

    Returns:
        ``(..., 7)``.
    """
    ra, ta = split(a)
    rb, tb = split(b)
    return pose_from(ra @ rb, (ra @ tb[..., None])[..., 0] + ta)


def look_rotation(forward: np.ndarray, up: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Camera-to-world rotation of a camera (x right, y down, z forward) that looks along a direction.

    Args:
        forward: ``(3,)`` viewing direction in the world, of any length.
        up: ``(3,)`` direction in the world that appears upward in the image.
        roll: rotation about the optical axis, rad.

    Returns:
        ``(3, 3)``.
    """
    z = forward / (np.linalg.norm(forward) + 1e-9)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6:  # looking straight up or down: any horizontal axis
        x = np.cross(z, np.roll(up, 1))
    x = x / np.linalg.norm(x)
    y = np.cross(z, x)
    r = np.stack([x, y, z], -1)
    return r @ so3_exp(np.array([0.0, 0.0, roll]))
