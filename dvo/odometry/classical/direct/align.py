"""Photometric alignment of an image to a keyframe with inverse depths (Engel et al., LSD-SLAM 2014, section 3.3).

Residual of a keyframe pixel ``x`` of inverse depth ``d``, seen at ``u = pi(R x + t d)``:

    r = I(u) - (a I_key(x) + b)

with the variance ``2 sigma^2 + (dr/dd)^2 Var(d)``: a pixel whose depth is uncertain counts little where that matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from dvo.odometry.classical.direct.image import Level, inside, sample


@dataclass(frozen=True)
class Reference:
    """Pixels of one level of a keyframe.

    Attributes:
        rays: ``(N, 3)`` float32 viewing rays, z = 1.
        inverse_depth, variance: ``(N,)`` float32.
        intensity: ``(N,)`` float32.
    """

    rays: np.ndarray
    inverse_depth: np.ndarray
    variance: np.ndarray
    intensity: np.ndarray


@dataclass(frozen=True)
class Alignment:
    """Outcome of :func:`align`.

    Attributes:
        T: ``(4, 4)`` keyframe to image.
        gain, offset: ``I = gain I_key + offset``.
        overlap: part of the keyframe's pixels (weighted equally) that fall into the image.
        agreement: part of those whose residual is within three standard deviations.
        residual: root of the mean squared normalised residual, capped at 3.
    """

    T: np.ndarray
    gain: float
    offset: float
    overlap: float
    agreement: float
    residual: float


def residuals(
    reference: Reference, level: Level, T: np.ndarray, gain: float, offset: float, noise: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Residuals of all pixels, their Jacobian and variance.

    Args:
        T: ``(4, 4)`` keyframe to image.
        noise: standard deviation of an intensity.

    Returns:
        r ``(N,)``; ``(N, 8)`` derivative by ``[tau, phi]`` (T moved by Exp from the left), gain and offset;
        variance ``(N,)``; ``(N,)`` bool, whether the pixel is seen (the rest is meaningless where not).
    """
    d = reference.inverse_depth
    fx, fy, cx, cy = level.intrinsics.astype(np.float32)
    t = T[:3, 3].astype(np.float32)
    q = reference.rays @ T[:3, :3].T.astype(np.float32) + d[:, None] * t
    front = q[:, 2] > 1e-3
    iz = 1 / np.where(front, q[:, 2], 1)
    x, y = q[:, 0] * iz, q[:, 1] * iz
    u, v = fx * x + cx, fy * y + cy
    seen = front & inside(u, v, level.grey.shape, 1)
    value, along_u, along_v = sample(level.packed, u, v).T
    along_x, along_y = fx * along_u, fy * along_v
    J = np.empty((len(d), 8), np.float32)
    scaled = d * iz
    J[:, 0], J[:, 1] = along_x * scaled, along_y * scaled
    J[:, 2] = -(J[:, 0] * x + J[:, 1] * y)
    J[:, 3] = -along_x * x * y - along_y * (1 + y * y)
    J[:, 4] = along_x * (1 + x * x) + along_y * x * y
    J[:, 5] = -along_x * y + along_y * x
    J[:, 6], J[:, 7] = -reference.intensity, -1
    by_depth = iz * (along_x * (t[0] - x * t[2]) + along_y * (t[1] - y * t[2]))
    variance = 2 * noise**2 + by_depth**2 * reference.variance
    return value - gain * reference.intensity - offset, J, variance, seen


def align(
    references: list[Reference],
    levels: list[Level],
    T: np.ndarray,
    *,
    gain: float = 1.0,
    offset: float = 0.0,
    noise: float,
    huber: float,
    iterations: tuple[int, ...],
) -> Alignment:
    """Levenberg-Marquardt from the coarsest level to the finest.

    Args:
        references: pixels of the keyframe, one entry per level, finest first.
        levels: of the image.
        T: prediction, keyframe to image.
        huber: normalised residual from which the loss is linear.
        iterations: at most, per level, finest first.
    """
    start = np.concatenate([T[:3].ravel(), [gain, offset]])
    for reference, level, count in reversed(list(zip(references, levels, iterations, strict=False))):
        if len(reference.inverse_depth) >= 30:
            T, gain, offset = _align_level(reference, level, T, gain, offset, noise, huber, count)
    if not np.isfinite(T).all():
        T, gain, offset = np.vstack([start[:12].reshape(3, 4), [0, 0, 0, 1]]), 1.0, 0.0
    if not len(references[0].inverse_depth):
        return Alignment(T, gain, offset, 0.0, 0.0, 3.0)
    r, _, variance, seen = residuals(references[0], levels[0], T, gain, offset, noise)
    if not seen.any():
        return Alignment(T, gain, offset, 0.0, 0.0, 3.0)
    size = np.abs(r[seen]) / np.sqrt(variance[seen])
    rms = float(np.sqrt((np.minimum(size, 3) ** 2).mean()))
    return Alignment(T, float(gain), float(offset), float(seen.mean()), float((size < 3).mean()), rms)


def _align_level(
    reference: Reference,
    level: Level,
    T: np.ndarray,
    gain: float,
    offset: float,
    noise: float,
    huber: float,
    iterations: int,
) -> tuple[np.ndarray, float, float]:
    def evaluate(T: np.ndarray, gain: float, offset: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Mean Huber loss of what is seen, and its normal equations. Little seen is a bad fit, not a good one."""
        r, J, variance, seen = residuals(reference, level, T, gain, offset, noise)
        r, J, variance = r[seen], J[seen], variance[seen]
        if len(r) < 20:
            return np.inf, np.eye(8), np.zeros(8)
        size = np.abs(r) / np.sqrt(variance)
        bend = np.where(size <= huber, 1, huber / np.maximum(size, 1e-9))
        loss = float(np.where(size <= huber, size**2, 2 * huber * size - huber**2).mean())
        weighted = J * (bend / variance)[:, None]
        return loss, (weighted.T @ J).astype(np.float64) / len(r), (weighted.T @ r).astype(np.float64) / len(r)

    damping = 1e-3
    loss, H, g = evaluate(T, gain, offset)
    for _ in range(iterations):
        if not np.isfinite(loss):
            break
        diagonal = np.maximum(np.diag(H), 1e-9 * max(H.trace(), 1e-12))
        step = -np.linalg.solve(H + damping * np.diag(diagonal), g)
        turn = cv2.Rodrigues(step[3:6])[0]
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = turn @ T[:3, :3], turn @ T[:3, 3] + step[:3]
        after = evaluate(moved, gain + step[6], offset + step[7])
        if after[0] < loss:
            gained = 1 - after[0] / loss
            T, gain, offset = moved, gain + step[6], offset + step[7]
            loss, H, g = after
            damping = max(damping * 0.3, 1e-6)
            if gained < 3e-4:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return T, gain, offset
