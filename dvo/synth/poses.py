"""Rigid motions in numpy float64, for laying out scenes and camera paths.

Poses are ``(..., 7)`` ``tx ty tz qx qy qz qw``; matrices map camera to world where named ``_wc``. The renderer builds
its per-frame coefficients in float64 here, so that float32 images stay consistent over scenes of hundreds of metres.
"""

from __future__ import annotations

import numpy as np

EPS = 1e-9


def skew(v: np.ndarray) -> np.ndarray:
    """``(..., 3)`` -> ``(..., 3, 3)`` with ``skew(v) @ w = v x w``."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    x, y, z = np.moveaxis(v, -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def so3_exp(phi: np.ndarray) -> np.ndarray:
    """Rotation vector ``(..., 3)`` rad -> matrix ``(..., 3, 3)`` (Rodrigues)."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    s = np.sinc(angle / np.pi)
    c = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    k = skew(phi)
    return np.eye(3) + s * k + c * (k @ k)


def se3_exp(xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twist ``(..., 6)`` ``[tau, phi]`` -> rotation ``(..., 3, 3)`` and translation ``(..., 3)``."""
    tau, phi = xi[..., :3], xi[..., 3:]
    angle2 = (phi**2).sum(-1)[..., None, None]
    angle = np.sqrt(angle2)
    c = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    safe = np.where(angle2 < 1e-6, 1.0, angle2)
    d = np.where(angle2 < 1e-6, 1.0 / 6 - angle2 / 120, (1 - np.sinc(angle / np.pi)) / safe)
    k = skew(phi)
    v = np.eye(3) + c * k + d * (k @ k)
    return so3_exp(phi), (v @ tau[..., None])[..., 0]


def quaternion_to_matrix(q: np.ndarray) -> np.ndarray:
    """``(..., 4)`` ``qx qy qz qw`` (normalised inside) -> ``(..., 3, 3)``."""
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3][..., None, None]
    k = skew(v)
    return np.eye(3) + 2 * w * k + 2 * (k @ k)


def matrix_to_quaternion(m: np.ndarray) -> np.ndarray:
    """``(..., 3, 3)`` -> ``(..., 4)`` ``qx qy qz qw``, ``qw >= 0``; picks the largest of four pivots for accuracy."""
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
    """``(..., 3, 3)``, ``(..., 3)`` -> pose ``(..., 7)``."""
    return np.concatenate([translation, matrix_to_quaternion(rotation)], -1)


def split(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose ``(..., 7)`` -> rotation ``(..., 3, 3)``, translation ``(..., 3)``."""
    return quaternion_to_matrix(pose[..., 3:]), pose[..., :3]


def inverse(pose: np.ndarray) -> np.ndarray:
    """Inverse of poses ``(..., 7)``."""
    r, t = split(pose)
    rt = np.swapaxes(r, -1, -2)
    return pose_from(rt, -(rt @ t[..., None])[..., 0])


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``a b``: first ``b``, then ``a``; ``(..., 7)``."""
    ra, ta = split(a)
    rb, tb = split(b)
    return pose_from(ra @ rb, (ra @ tb[..., None])[..., 0] + ta)


def look_rotation(forward: np.ndarray, up: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Camera-to-world rotation ``(3, 3)`` of a camera (x right, y down, z forward) that looks along ``forward``."""
    z = forward / (np.linalg.norm(forward) + EPS)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6:  # looking straight up or down: any horizontal will do
        x = np.cross(z, np.roll(up, 1))
    x = x / np.linalg.norm(x)
    y = np.cross(z, x)
    r = np.stack([x, y, z], -1)
    return r @ so3_exp(np.array([0.0, 0.0, roll]))
