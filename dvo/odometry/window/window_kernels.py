"""Kernels of what is asked of a window after a step, and of the pose of a frame that is aligned with it:
:mod:`dvo.odometry.window.pose_validation` and :mod:`dvo.odometry.window.frame_alignment` are their twins.

Values of a window are float32, what is computed of them float64.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dvo.core.compiled import compiled, part

Array = np.ndarray[Any, Any]


@compiled
def support(
    position: int,
    masked: bool,
    jj: Array,
    kk: Array,
    per_frame: int,
    poses: Array,
    patches: Array,
    intrinsics: Array,
    targets: Array,
    confidence: Array,
    confident: float,
    agreement: float,
    least_divisor: float,
) -> tuple[bool, float, float]:
    """Agreement of the measurements of a frame with those before it.

    Args:
        position: of the frame.
        masked: measurements whose confidence is zero do not count.
        jj, kk: ``(E,)`` target frame and patch.
        per_frame: patches of a frame.
        poses: ``(n, 7)`` world to camera. patches: ``(K, 3, p, p)``. intrinsics: ``(n, 4)``.
        targets, confidence: ``(E, 2)``.
        confident: least mean confidence of an inlier.
        agreement: longest residual of an inlier, pixels.
        least_divisor: the projection divides by a Z of at least this.

    Returns:
        False if an index is out of range; mean confidence and share of inliers, 0 where nothing counts.
    """
    centre = patches.shape[2] // 2
    motions, made = np.empty((len(poses), 3, 4)), np.empty(len(poses), np.bool_)
    for i in range(len(poses)):
        made[i] = False
    total, edges, earlier, inliers = 0.0, 0, 0, 0
    for e in range(len(jj)):
        k = kk[e]
        i = k // per_frame
        if not (0 <= k < len(patches) and i < len(poses) and position < len(poses)):
            return False, 0.0, 0.0
        if jj[e] != position or i > position:
            continue
        own_x, own_y = np.float64(confidence[e, 0]), np.float64(confidence[e, 1])
        if masked and own_x == 0 and own_y == 0:
            continue
        total += own_x + own_y
        edges += 1
        if i == position:
            continue
        earlier += 1
        if not made[i]:
            _motion(poses[i], poses[position], motions[i])
            made[i] = True
        x, y = _projected(
            motions[i], intrinsics[i], intrinsics[position], patches[k, :, centre, centre], least_divisor
        )  # fmt: skip
        x, y = targets[e, 0] - x, targets[e, 1] - y
        if (own_x + own_y) / 2 > confident and math.sqrt(x * x + y * y) < agreement:
            inliers += 1
    return True, total / (2 * edges) if edges else 0.0, inliers / earlier if earlier else 0.0


@compiled
def mean_flow(
    first: Array, second: Array, of_first: Array, of_second: Array, patches: Array, least_divisor: float, longest: float
) -> float:
    """Mean flow of a frame pair, half of it without the rotation.

    Args:
        first, second: ``(7,)`` poses, world to camera.
        of_first, of_second: ``(4,)`` intrinsics.
        patches: ``(M, 3, p, p)`` of the first frame.
        least_divisor: the projection divides by a Z of at least this.
        longest: flow of a patch at most, pixels.

    Returns:
        Pixels.
    """
    whole, straight = np.empty((3, 4)), np.empty((3, 4))
    _motion(first, second, whole)
    for a in range(3):
        for b in range(3):
            straight[a, b] = 1.0 if a == b else 0.0
        straight[a, 3] = whole[a, 3]
    total, centre = 0.0, patches.shape[2] // 2
    for k in range(len(patches)):
        patch = patches[k, :, centre, centre]
        flow = 0.0
        for motion in (whole, straight):
            x, y = _projected(motion, of_first, of_second, patch, least_divisor)
            x, y = x - patch[0], y - patch[1]
            flow += 0.5 * math.sqrt(x * x + y * y)
        total += longest if flow > longest else flow  # NaN stays
    return total / len(patches)


@part
def _motion(first: Array, second: Array, m: Array) -> None:
    """Rotation and translation of ``T_second T_first^-1``."""
    rotations = np.empty((2, 3, 3))
    for side in range(2):
        pose, r = first if side == 0 else second, rotations[side]
        x, y, z, w = np.float64(pose[3]), np.float64(pose[4]), np.float64(pose[5]), np.float64(pose[6])
        two = 2 / (x * x + y * y + z * z + w * w)
        r[0, 0], r[0, 1], r[0, 2] = 1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)
        r[1, 0], r[1, 1], r[1, 2] = two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)
        r[2, 0], r[2, 1], r[2, 2] = two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)
    for a in range(3):
        t = np.float64(second[a])
        for b in range(3):
            m[a, b] = 0.0
            for c in range(3):
                m[a, b] += rotations[1, a, c] * rotations[0, b, c]
            t -= m[a, b] * first[b]
        m[a, 3] = t


@part
def _projected(m: Array, source: Array, target: Array, patch: Array, least_divisor: float) -> tuple[float, float]:
    """Pixel of a point ``(3,)`` = x, y, inverse depth in the other frame."""
    x = (np.float64(patch[0]) - source[2]) / source[0]
    y = (np.float64(patch[1]) - source[3]) / source[1]
    d = np.float64(patch[2])
    z = m[2, 0] * x + m[2, 1] * y + m[2, 2] + m[2, 3] * d
    z = least_divisor if z < least_divisor else z
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] + m[0, 3] * d) / z
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] + m[1, 3] * d) / z
    return np.float64(target[2]) + target[0] * u, np.float64(target[3]) + target[1] * v


@compiled
def solve_pose_kernel(points, measured, weights, camera, pose, widths, iterations, nearest, tolerance):
    """See :func:`dvo.odometry.window.frame_alignment.solve_pose_plain`; all arrays are float64 and contiguous, ``pose
    (4, 4)`` is changed in place."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    count = len(points)
    h, g, j = np.empty((6, 6)), np.empty(6), np.empty((2, 6))
    for width in widths:
        for _ in range(iterations):
            for k in range(6):
                g[k] = 0.0
                for m in range(6):
                    h[k, m] = 0.0
            closest = 0.0
            for e in range(count):
                p0, p1, p2 = points[e, 0], points[e, 1], points[e, 2]
                x = pose[0, 0] * p0 + pose[0, 1] * p1 + pose[0, 2] * p2 + pose[0, 3]
                y = pose[1, 0] * p0 + pose[1, 1] * p1 + pose[1, 2] * p2 + pose[1, 3]
                z = pose[2, 0] * p0 + pose[2, 1] * p1 + pose[2, 2] * p2 + pose[2, 3]
                q = 1.0 / max(z, nearest)
                closest = max(closest, q)
                if z <= nearest:
                    continue
                a, b = x * q, y * q
                r0, r1 = measured[e, 0] - (a * fx + cx), measured[e, 1] - (b * fy + cy)
                robust = 1.0 / (1.0 + (r0 * r0 + r1 * r1) / (width * width))
                j[0, 0], j[0, 1], j[0, 2] = fx * q, 0.0, -fx * a * q
                j[0, 3], j[0, 4], j[0, 5] = -fx * a * b, fx * (1.0 + a * a), -fx * b
                j[1, 0], j[1, 1], j[1, 2] = 0.0, fy * q, -fy * b * q
                j[1, 3], j[1, 4], j[1, 5] = -fy * (1.0 + b * b), fy * a * b, fy * a
                w0, w1 = weights[e, 0] * robust, weights[e, 1] * robust
                for k in range(6):
                    g[k] += j[0, k] * w0 * r0 + j[1, k] * w1 * r1
                    for m in range(k + 1):
                        h[k, m] += j[0, k] * w0 * j[0, m] + j[1, k] * w1 * j[1, m]
            damping = 0.0
            for k in range(6):
                damping += h[k, k]
            damping = 1e-6 * damping / 6.0 + 1e-12
            # Cholesky in place, and the two substitutions.
            for k in range(6):
                h[k, k] += damping
                for m in range(k + 1):
                    total = h[k, m]
                    for i in range(m):
                        total -= h[k, i] * h[m, i]
                    h[k, m] = np.sqrt(total) if k == m else total / h[m, m]
            for k in range(6):
                for i in range(k):
                    g[k] -= h[k, i] * g[i]
                g[k] /= h[k, k]
            for k in range(5, -1, -1):
                for i in range(k + 1, 6):
                    g[k] -= h[i, k] * g[i]
                g[k] /= h[k, k]
            _move(pose, g)
            turn, shift = 0.0, 0.0
            for k in range(3):
                shift, turn = max(shift, abs(g[k])), max(turn, abs(g[k + 3]))
            if turn < tolerance and shift * closest < tolerance:
                break


@part
def _move(pose, step):
    """``Exp(step) pose`` in place."""
    x, y, z = step[3], step[4], step[5]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < 1e-4:
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        a, b, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square, (angle - np.sin(angle)) / (square * angle)
    turn, left, w, before = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 4))
    w[0, 0], w[0, 1], w[0, 2] = 0.0, -z, y
    w[1, 0], w[1, 1], w[1, 2] = z, 0.0, -x
    w[2, 0], w[2, 1], w[2, 2] = -y, x, 0.0
    for i in range(3):
        for k in range(3):
            twice = 0.0
            for m in range(3):
                twice += w[i, m] * w[m, k]
            one = 1.0 if i == k else 0.0
            turn[i, k] = one + a * w[i, k] + b * twice
            left[i, k] = one + b * w[i, k] + c * twice
    for i in range(3):
        for k in range(4):
            before[i, k] = pose[i, k]
    for i in range(3):
        for k in range(4):
            total = 0.0
            for m in range(3):
                total += turn[i, m] * before[m, k]
            pose[i, k] = total
        for m in range(3):
            pose[i, 3] += left[i, m] * step[m]
