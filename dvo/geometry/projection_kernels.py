"""Kernel of :func:`dvo.geometry.projection.reproject` without Jacobians, and its adjoint.

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


@compiled
def project_patches_adjoint(
    poses: Array,
    patches: Array,
    intrinsics: Array,
    ii: Array,
    jj: Array,
    kk: Array,
    least_divisor: float,
    by_coords: Array,
    by_depth: Array,
    d_poses: Array,
    d_patches: Array,
    d_intrinsics: Array,
) -> None:
    """Add the gradients of :func:`project_patches` by poses, patches and intrinsics, whose indices are in range.

    Args:
        poses, patches, intrinsics, ii, jj, kk, least_divisor: see there.
        by_coords: ``(B, E, A, 2)``, by_depth: ``(B, E, A)``: gradients.
        d_poses, d_patches, d_intrinsics: float64.
    """
    batch, frames = poses.shape[:2]
    rotations, motions = np.empty((frames, 3, 3)), np.empty((frames, frames, 3, 4))
    for b in range(batch):
        for n in range(frames):
            _rotation(poses[b, n], rotations[n])
        for i in range(frames):
            for j in range(frames):
                m = motions[i, j]
                for a in range(3):
                    t = np.float64(poses[b, j, a])
                    for c in range(3):
                        r = rotations[j, a, 0] * rotations[i, c, 0]
                        r += rotations[j, a, 1] * rotations[i, c, 1] + rotations[j, a, 2] * rotations[i, c, 2]
                        m[a, c] = r
                        t -= r * poses[b, i, c]
                    m[a, 3] = t
        d_motions = np.zeros((frames, frames, 3, 4))
        for e in range(len(ii)):
            i, j, k = ii[e], jj[e], kk[e]
            m, g, patch = motions[i, j], d_motions[i, j], patches[b, k]
            fix, fiy = np.float64(intrinsics[b, i, 0]), np.float64(intrinsics[b, i, 1])
            fx, fy = np.float64(intrinsics[b, j, 0]), np.float64(intrinsics[b, j, 1])
            for a in range(patch.shape[1]):
                gx, gy = np.float64(by_coords[b, e, a, 0]), np.float64(by_coords[b, e, a, 1])
                gz = np.float64(by_depth[b, e, a])
                if gx == 0 and gy == 0 and gz == 0:
                    continue
                u = (np.float64(patch[0, a]) - intrinsics[b, i, 2]) / fix
                v = (np.float64(patch[1, a]) - intrinsics[b, i, 3]) / fiy
                d = np.float64(patch[2, a])
                x = m[0, 0] * u + m[0, 1] * v + m[0, 2] + m[0, 3] * d
                y = m[1, 0] * u + m[1, 1] * v + m[1, 2] + m[1, 3] * d
                z = m[2, 0] * u + m[2, 1] * v + m[2, 2] + m[2, 3] * d
                ahead = not z < least_divisor
                inverse = 1 / (z if ahead else least_divisor)
                x, y = x * inverse, y * inverse
                d_intrinsics[b, j, 0] += gx * x
                d_intrinsics[b, j, 1] += gy * y
                d_intrinsics[b, j, 2] += gx
                d_intrinsics[b, j, 3] += gy
                gx, gy = gx * fx * inverse, gy * fy * inverse
                if ahead:
                    gz -= gx * x + gy * y
                by_u = (m[0, 0] * gx + m[1, 0] * gy + m[2, 0] * gz) / fix
                by_v = (m[0, 1] * gx + m[1, 1] * gy + m[2, 1] * gz) / fiy
                d_patches[b, k, 0, a] += by_u
                d_patches[b, k, 1, a] += by_v
                d_patches[b, k, 2, a] += m[0, 3] * gx + m[1, 3] * gy + m[2, 3] * gz
                d_intrinsics[b, i, 0] -= by_u * u
                d_intrinsics[b, i, 1] -= by_v * v
                d_intrinsics[b, i, 2] -= by_u
                d_intrinsics[b, i, 3] -= by_v
                g[0, 0] += gx * u
                g[0, 1] += gx * v
                g[0, 2] += gx
                g[0, 3] += gx * d
                g[1, 0] += gy * u
                g[1, 1] += gy * v
                g[1, 2] += gy
                g[1, 3] += gy * d
                g[2, 0] += gz * u
                g[2, 1] += gz * v
                g[2, 2] += gz
                g[2, 3] += gz * d
        d_rotations = np.zeros((frames, 3, 3))
        for i in range(frames):
            for j in range(frames):
                m, g = motions[i, j], d_motions[i, j]
                for a in range(3):
                    d_poses[b, j, a] += g[a, 3]
                    for c in range(3):
                        d_poses[b, i, c] -= m[a, c] * g[a, 3]
                        g[a, c] -= g[a, 3] * poses[b, i, c]
                for a in range(3):
                    for c in range(3):
                        for k in range(3):
                            d_rotations[j, a, c] += g[a, k] * rotations[i, k, c]
                            d_rotations[i, a, c] += g[k, a] * rotations[j, k, c]
        for n in range(frames):
            _add_rotation_gradient(poses[b, n], d_rotations[n], d_poses[b, n])


@part
def _add_rotation_gradient(pose: Array, g: Array, out: Array) -> None:
    """Gradient by the quaternion of a pose from that by its matrix, as of :func:`dvo.geometry.so3.matrix`."""
    x, y, z, w = np.float64(pose[3]), np.float64(pose[4]), np.float64(pose[5]), np.float64(pose[6])
    s01, s02, s12 = g[0, 1] + g[1, 0], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1]
    a, b, c = g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]
    out[3] += 2 * (x * (g[0, 0] - g[1, 1] - g[2, 2]) + y * s01 + z * s02 + w * a)
    out[4] += 2 * (x * s01 + y * (g[1, 1] - g[0, 0] - g[2, 2]) + z * s12 + w * b)
    out[5] += 2 * (x * s02 + y * s12 + z * (g[2, 2] - g[0, 0] - g[1, 1]) + w * c)
    out[6] += 2 * (w * (g[0, 0] + g[1, 1] + g[2, 2]) + x * a + y * b + z * c)


@part
def _rotation(pose: Array, r: Array) -> None:
    """Rotation matrix of a pose; the length of the quaternion, 1 to the last digit of float32, does not matter."""
    x, y, z, w = np.float64(pose[3]), np.float64(pose[4]), np.float64(pose[5]), np.float64(pose[6])
    two = 2 / (x * x + y * y + z * z + w * w)
    r[0, 0], r[0, 1], r[0, 2] = 1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)
