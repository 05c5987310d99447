"""Crop of stabilised video that floats over what the sensor sees, told by the corners of the check pairs.

Electronic stabilisation moves the part of the image that is kept, and with it the principal point. To the tracker a
shift looks like a turn, which it nearly is; what tells them apart is the second order towards the edges of the image.
So the motion between the two images of a pair is fitted twice to the corners, with and without a shift of the second
image. Of a camera whose principal point stays, the shift takes away little of the robust cost that is above the noise
of the corners. A wrong trajectory is no start for both fits: they begin in three directions of the translation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dvo.core.kernels import available
from dvo.odometry.checks.check_pairs import CheckPair

MIN_CORNERS = 30
"""Corners of a pair that seven unknowns are fitted to, at least."""
MIN_PAIRS = 6
"""Pairs below which nothing is concluded."""
MAX_PAIRS = 32
"""Pairs that are looked at, evenly over the sequence."""

_SCALE = 0.5  # of the robust kernel, pixels
_NOISE = 0.1  # of a corner, pixels: of a slow camera nothing but that is left, and a shift may explain it
_SHARE = 0.75  # of the pairs have at most the gain that counts: a crop that floats comes back, and is still at times
_ITERATIONS = 12
_STEP = 1e-5  # of the numeric derivatives, radians
_TOLERANCE = 1e-3  # relative decrease of the cost below which a fit has converged
_STRONGEST = 1e8  # damping beyond which no step helps


def shift_gain(pairs: Sequence[CheckPair], motions: Sequence[np.ndarray]) -> float:
    """Share of the cost of the corners of a pair that a shift of the second image takes away, their upper quartile.

    The cost of the noise counts as one that no shift takes away.

    Args:
        pairs: their corners as a global shutter would have seen them.
        motions: ``(4, 4)`` of each pair, from the first camera to the second, by the poses; where the fits begin.

    Returns:
        In [0, 1]; NaN for too few pairs.
    """
    gains = []
    for at in looked_at(pairs):
        plain, shifted = (fitted_cost(pairs[at], motions[at], with_shift) for with_shift in (False, True))
        gains.append(max(plain - shifted, 0.0) / (plain + _NOISE**2 * len(pairs[at].points)))
    return float(np.quantile(gains, _SHARE)) if gains else math.nan


def looked_at(pairs: Sequence[CheckPair]) -> list[int]:
    """Pairs that :func:`shift_gain` looks at.

    Args:
        pairs: all of them.

    Returns:
        Their indices; empty if there are too few.
    """
    known = [at for at, pair in enumerate(pairs) if len(pair.points) >= MIN_CORNERS]
    if len(known) < MIN_PAIRS:
        return []
    return [known[at] for at in np.unique(np.linspace(0, len(known) - 1, MAX_PAIRS).astype(int))]


def fitted_cost(pair: CheckPair, motion: np.ndarray, with_shift: bool) -> float:
    """Robust cost of the Sampson distances of the corners of a pair from the best motion (Levenberg-Marquardt).

    Args:
        pair: the corners.
        motion: ``(4, 4)`` to begin with. Of its translation the direction counts, and as it may be wrong, each fit
            begins there and in two directions across.
        with_shift: the second image may be shifted.

    Returns:
        Sum of Cauchy costs, pixels squared.
    """
    fx, fy, cx, cy = pair.intrinsics
    scale, points = _SCALE / math.sqrt(fx * fy), pair.points.astype(np.float64)
    first, second = (
        np.column_stack([(p[:, 0] - cx) / fx, (p[:, 1] - cy) / fy, np.ones(len(p))])
        for p in (points[:, :2], points[:, 2:])
    )
    length = float(np.linalg.norm(motion[:3, 3]))
    towards = motion[:3, 3] / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
    across = np.linalg.svd(towards[None])[2][1:]
    return min(_fitted(first, second, motion[:3, :3], way, scale, with_shift) for way in (towards, *across))


def _fitted(
    first: np.ndarray, second: np.ndarray, rotation: np.ndarray, towards: np.ndarray, scale: float, with_shift: bool
) -> float:
    """Robust cost from one start; rays ``(N, 3)``, and the scale of the kernel on their plane."""
    aside = np.linalg.svd(towards[None])[2][1:]
    if available():
        from dvo.odometry.checks import fit_kernels

        values = first[:, :2].copy(), second[:, :2].copy(), rotation.copy(), towards.copy(), aside.copy()
        limits = scale, _SCALE, _ITERATIONS, _STEP, _TOLERANCE, _STRONGEST
        return float(fit_kernels.fit(*values, 7 if with_shift else 5, *limits))
    moving = np.arange(7) < (7 if with_shift else 5)
    units = _STEP * np.eye(7)[moving]

    def residuals(x: np.ndarray) -> np.ndarray:
        """``(X, N)`` for ``(X, 7)``: turn, direction, shift."""
        turn = _turns(x[:, :3]) @ rotation
        direction = towards + x[:, 3:5] @ aside
        tx, ty, tz = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).T
        zero = np.zeros_like(tx)
        across = np.stack([zero, -tz, ty, tz, zero, -tx, -ty, tx, zero], 1).reshape(-1, 3, 3)
        essential = across @ turn
        moved = second - np.pad(x[:, None, 5:7], ((0, 0), (0, 0), (0, 1)))
        lines, back = first @ essential.swapaxes(1, 2), moved @ essential
        gradient = lines[..., 0] ** 2 + lines[..., 1] ** 2 + back[..., 0] ** 2 + back[..., 1] ** 2
        return np.asarray((moved * lines).sum(-1) / np.sqrt(np.maximum(gradient, 1e-18)))

    def cost_of(distances: np.ndarray) -> float:
        return float(_SCALE**2 * np.log1p((distances / scale) ** 2).sum())

    x, damping = np.zeros(7), 1e-3
    now = residuals(x[None])[0]
    cost = cost_of(now)
    for _ in range(_ITERATIONS):
        jacobian = (residuals(x + units) - now).T / _STEP
        weighted = jacobian / (1 + (now / scale) ** 2)[:, None]
        normal, gradient = weighted.T @ jacobian, weighted.T @ now
        while damping < _STRONGEST:
            lifted = normal + damping * np.diag(np.diag(normal) + 1e-12)
            step = x.copy()
            step[moving] -= np.linalg.solve(lifted, gradient)
            after = residuals(step[None])[0]
            before, found = cost, cost_of(after)
            if found < cost:
                x, now, cost, damping = step, after, found, damping / 5
                break
            damping *= 8
        else:
            break
        if before - cost <= _TOLERANCE * cost:
            break
    return cost


def _turns(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices ``(X, 3, 3)`` of rotation vectors ``(X, 3)`` (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    across = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * across + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (across @ across)
