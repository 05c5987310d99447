"""Consensus among measurements, from the innovations and their joint covariance alone.

The filter's prior fixes all but a little of the motion, so one measurement can make a hypothesis of it (one-point
RANSAC: Civera, Grasa, Davison, Montiel 2010, J. Field Robotics 27(5)). Conditioning the joint Gaussian of the
innovations on that measurement gives what the others should then be, and how surely: a point whose depth nobody knows
may be anywhere along its epipolar line, one that is known well has to be in its place.
"""

from __future__ import annotations

import numpy as np

GATE = 9.21  # 99 % of the chi-square distribution with two degrees of freedom
WRONG = 0.2  # part of the matches that may be wrong


def condition(innovations: np.ndarray, S: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Innovations that are left when some are known.

    Args:
        innovations: ``(M, 2)``.
        S: ``(2 M, 2 M)`` their covariance.
        given: ``(K,)`` the measurements that are taken as true.

    Returns:
        ``(M, 2)`` differences from what the given ones let expect, ``(M, 2, 2)`` covariances of these.
    """
    a = (2 * np.asarray(given)[:, None] + [0, 1]).ravel()
    gain = np.linalg.solve(S[np.ix_(a, a)], S[a]).T  # (2 M, 2 K)
    left = innovations - (gain @ innovations.ravel()[a]).reshape(-1, 2)
    rows = 2 * np.arange(len(innovations))[:, None] + [0, 1]
    explained = np.einsum("mik,kmj->mij", gain[rows], S[a][:, rows])
    return left, S[rows[:, :, None], rows[:, None, :]] - explained


def find_consensus(innovations: np.ndarray, S: np.ndarray, samples: int, rng: np.random.Generator) -> np.ndarray:
    """A set of measurements that let expect each other.

    Every single measurement makes a hypothesis; while the prior is loose (the first frames, or after a gap) one leaves
    the motion open, so random triples make ``samples`` more. The most likely one, wrong matches being spread evenly
    over the search ellipses, then takes in the others, the likeliest next, each narrowing what the rest may be.

    Args:
        innovations: ``(M, 2)``.
        S: ``(2 M, 2 M)`` their covariance, measurement noise included.
        samples: number of triples.
        rng: draws them.

    Returns:
        ``(M,)`` bool.
    """
    count = len(innovations)
    chosen = np.zeros(count, bool)
    if count == 0:
        return chosen
    rows = 2 * np.arange(count)[:, None] + [0, 1]
    anywhere = WRONG / (np.pi * GATE * np.sqrt(np.linalg.det(S[rows[:, :, None], rows[:, None, :]])))
    hypotheses = [np.array([k]) for k in range(count)]
    if count > 4:
        hypotheses += [rng.choice(count, 3, replace=False) for _ in range(samples)]
    given = max(hypotheses, key=lambda given: _likelihood(innovations, S, given, anywhere))
    chosen[given] = True
    while not chosen.all():
        left, spread = condition(innovations, S, np.flatnonzero(chosen))
        distance = _mahalanobis(left[~chosen], spread[~chosen])
        following = int(np.argmin(distance))
        if distance[following] > GATE:
            break
        chosen[np.flatnonzero(~chosen)[following]] = True
    return chosen


def _mahalanobis(left: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """``(M,)`` squared distances."""
    return np.einsum("mi,mi->m", left, np.linalg.solve(spread, left[..., None])[..., 0])


def _likelihood(innovations: np.ndarray, S: np.ndarray, given: np.ndarray, anywhere: np.ndarray) -> float:
    """Logarithm of the density of all innovations if the given measurements are right and others may be wrong."""
    a = (2 * given[:, None] + [0, 1]).ravel()
    own = innovations.ravel()[a]
    total = -0.5 * float(
        own @ np.linalg.solve(S[np.ix_(a, a)], own) + np.linalg.slogdet(2 * np.pi * S[np.ix_(a, a)])[1]
    )
    others = np.ones(len(innovations), bool)
    others[given] = False
    left, spread = condition(innovations, S, given)
    left, spread = left[others], spread[others]
    density = np.exp(-0.5 * _mahalanobis(left, spread)) / (2 * np.pi * np.sqrt(np.linalg.det(spread)))
    return total + float(np.log((1 - WRONG) * density + anywhere[others]).sum())


def drop_inconsistent(
    innovations: np.ndarray, S: np.ndarray, noise: float, threshold: float, rounds: int = 4
) -> np.ndarray:
    """Measurements that all of them together explain: those that a joint update would leave far off are dropped.

    What an update leaves of the innovations ``n`` is ``noise^2 S^-1 n`` (the model being linear).

    Args:
        innovations, S: as above.
        noise: standard deviation of a measured pixel.
        threshold: distance that may be left, pixels.
        rounds: the worse half of the offenders goes in each, in the last all.

    Returns:
        ``(M,)`` bool.
    """
    kept = np.ones(len(innovations), bool)
    for turn in range(rounds):
        if not kept.any():
            break
        a = np.flatnonzero(np.repeat(kept, 2))
        left = noise**2 * np.linalg.solve(S[np.ix_(a, a)], innovations[kept].ravel()).reshape(-1, 2)
        error = np.zeros(len(kept))
        error[kept] = np.linalg.norm(left, axis=1)
        bad = error > threshold
        if not bad.any():
            break
        worst = threshold if turn == rounds - 1 else float(np.median(error[bad]))
        kept &= ~(bad & (error >= worst))
    return kept
