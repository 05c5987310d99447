"""Kernel of :func:`dvo.geometry.projection.reproject` without Jacobians.

Values are float32, what is computed of them float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dvo.core.compiled import compiled, part

Array = np.ndarray[Any, Any]


@compiled
def project_patches(
    poses: Array,
    patches: Array,
    intrinsics: Array,
    ii: Array,
    jj: Array,
    kk: Array,
    least_divisor: float,
    least_z: float,
    coords: Array,
    depth: Array,
    valid: Array,
) -> bool:
    """Project patches into other frames.

    Args:
        poses: ``(B, N, 7)`` world to camera. patches: ``(B, K, 3, A)`` of ``A`` pixels. intrinsics: ``(B, N, 4)``.
        ii, jj, kk: ``(E,)`` source frame, target frame, patch.
        least_divisor: the projection divides by a Z of at least this.
        least_z: a point with a greater Z is valid.
        coords: ``(B, E, A, 2)``, depth: ``(B, E, A)``, valid: ``(B, E, A)`` bool: filled.

    Returns:
        False if an index is out of range; then nothing is filled.
    """
    batch, frames = poses.shape[:2]
    for e in range(len(ii)):
        if not (0 <= ii[e] < frames and 0 <= jj[e] < frames and 0 <= kk[e] < patches.shape[1]):
            return False
    rotations, m = np.empty((frames, 3, 3)), np.empty((3, 4))
    for b in range(batch):
        for n in range(frames):
            _rotation(poses[b, n], rotations[n])
        for e in range(len(ii)):
            i, j = ii[e], jj[e]
            fx, fy = np.float64(intrinsics[b, i, 0]), np.float64(intrinsics[b, i, 1])
            cx, cy = np.float64(intrinsics[b, i, 2]), np.float64(intrinsics[b, i, 3])
            for a in range(3):  # X' = m (x, y, 1, d) of pixels
                t = np.float64(poses[b, j, a])
                for c in range(3):
                    r = rotations[j, a, 0] * rotations[i, c, 0]
                    r += rotations[j, a, 1] * rotations[i, c, 1] + rotations[j, a, 2] * rotations[i, c, 2]
                    m[a, c] = r
                    t -= r * poses[b, i, c]
                m[a, 3] = t
                m[a, 0] /= fx
                m[a, 1] /= fy
                m[a, 2] -= m[a, 0] * cx + m[a, 1] * cy
            m00, m01, m02, m03 = m[0]
            m10, m11, m12, m13 = m[1]
            m20, m21, m22, m23 = m[2]
            fx, fy = np.float64(intrinsics[b, j, 0]), np.float64(intrinsics[b, j, 1])
            cx, cy = np.float64(intrinsics[b, j, 2]), np.float64(intrinsics[b, j, 3])
            patch = patches[b, kk[e]]
            for a in range(patch.shape[1]):
                x, y, d = np.float64(patch[0, a]), np.float64(patch[1, a]), np.float64(patch[2, a])
                z = m20 * x + m21 * y + m22 + m23 * d
                inverse = 1 / (least_divisor if z < least_divisor else z)  # NaN stays
                coords[b, e, a, 0] = cx + fx * (m00 * x + m01 * y + m02 + m03 * d) * inverse
                coords[b, e, a, 1] = cy + fy * (m10 * x + m11 * y + m12 + m13 * d) * inverse
                depth[b, e, a] = z
                valid[b, e, a] = z > least_z
    return True


@part
def _rotation(pose: Array, r: Array) -> None:
    """Rotation matrix of a pose; the length of the quaternion, 1 to the last digit of float32, does not matter."""
    x, y, z, w = np.float64(pose[3]), np.float64(pose[4]), np.float64(pose[5]), np.float64(pose[6])
    two = 2 / (x * x + y * y + z * z + w * w)
    r[0, 0], r[0, 1], r[0, 2] = 1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)
