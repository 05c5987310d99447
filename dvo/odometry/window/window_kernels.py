"""Kernels of what is asked of a window after a step: :mod:`dvo.odometry.window.pose_validation` and
:mod:`dvo.odometry.window.motion` are their twins.

Values are float32, what is computed of them float64.
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
