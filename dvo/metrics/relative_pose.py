"""Errors of relative poses in degrees, and the area under their recall, in plain numpy: measures without a scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import pose_matrices
from dvo.metrics import associate
from dvo.metrics.segment_metrics import match_worlds, rows_of
from dvo.odometry.protocol import Segment

STILL_SHARE = 0.1  # of the median step: a pair that moves less has no direction to judge


def relative_pose_errors(
    estimate: Trajectory,
    reference: Trajectory,
    gap: int = 1,
    max_dt: float = 0.01,
    labels: np.ndarray | None = None,
) -> np.ndarray:
    """Error of each pair ``i, i + gap`` of reference frames; scale plays no part.

    The larger of the rotation error and the angle between the translations' directions, as in the evaluation of
    SuperGlue (Sarlin et al., CVPR 2020) and LoFTR (Sun et al., CVPR 2021). Odometry knows the sign of a translation, so
    that the angle is up to 180 degrees; there, essential matrices leave it open. Where the reference hardly moves
    (under a tenth of its median step) the rotation counts alone.

    Args:
        estimate, reference: camera to world, seconds.
        gap: frames between the two of a pair.
        max_dt: largest difference of matched stamps, seconds.
        labels: world of each row of the estimate; None for a single one.

    Returns:
        ``(N - gap,)`` degrees; infinite for a pair that the estimate lacks, or whose frames lie in two worlds.
    """
    if len(reference) <= gap:
        return np.zeros(0)
    i, j = associate(estimate, reference, max_dt)
    rows = np.full(len(reference), -1)
    rows[j] = i
    starts = np.arange(len(reference) - gap)
    true_turn, true_step = _steps(reference.poses_wc, starts, starts + gap)
    errors = np.full(len(starts), np.inf)
    has = (rows[starts] >= 0) & (rows[starts + gap] >= 0)
    if labels is not None:
        has[has] = labels[rows[starts[has]]] == labels[rows[starts[has] + gap]]
    turn, step = _steps(estimate.poses_wc, rows[starts[has]], rows[starts[has] + gap])
    errors[has] = _angles(np.swapaxes(true_turn[has], 1, 2) @ turn)
    lengths = np.linalg.norm(true_step, axis=1)
    moves = has & (lengths > max(1e-9, STILL_SHARE * float(np.median(lengths))))
    errors[moves] = np.maximum(errors[moves], _between(step[moves[has]], true_step[moves]))
    return errors


def join_segments(segments: Sequence[Segment], reference: Trajectory) -> tuple[Trajectory, np.ndarray | None]:
    """Rows of all segments in order of time, with the number of the world of each.

    Args:
        segments: of a result.
        reference: camera to world, seconds; of several segments, rows without a frame of it are left out.

    Returns:
        Estimate, and labels for :func:`relative_pose_errors`; None for a single segment.
    """
    if len(segments) == 1:
        return segments[0].trajectory, None
    worlds = match_worlds(segments, reference)
    stamps = np.concatenate([np.zeros(0), *(world.estimate.timestamps for world in worlds)])
    poses = np.concatenate([np.zeros((0, 7)), *(world.estimate.poses_wc for world in worlds)])
    labels = np.repeat(np.arange(len(worlds)), [len(world) for world in worlds])
    order = np.argsort(stamps, kind="stable")
    return rows_of(Trajectory(stamps, poses), order), labels[order]


def recall_area(errors: np.ndarray, limits: Iterable[float]) -> dict[float, float]:
    """Area under the cumulative recall curve up to each limit (AUC), in [0, 1], as SuperGlue and LoFTR compute it.

    The curve goes through the origin and, for the errors in increasing order, ``(error_k, k / N)``; it is linear
    between them, and level from the last one below the limit on. The area is divided by the limit. That of the steps,
    without the lines, is ``mean(max(0, 1 - error / limit))``, less by at most ``1 / (2 N)``.

    Args:
        errors: ``(N,)``, not negative; infinite for what is missing. Those of several sequences are pooled.
        limits: positive, in the unit of the errors.

    Returns:
        Area by limit; nan without errors.

    Example:
        >>> recall_area(np.array([0.0, 1.0, np.inf, np.inf]), [2.0])
        {2.0: 0.4375}
    """
    ordered = np.sort(np.asarray(errors, float))
    found = {}
    for limit in limits:
        below = int(np.searchsorted(ordered, limit))
        recall = np.arange(below + 1) / max(len(ordered), 1)
        x, y = np.r_[0.0, ordered[:below], limit], np.r_[recall, recall[-1]]
        area = float((np.diff(x) * (y[1:] + y[:-1]) / 2).sum() / limit)
        found[limit] = area if len(ordered) else float("nan")
    return found


def _steps(poses_wc: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    matrices = pose_matrices(poses_wc)
    step = np.linalg.inv(matrices[first]) @ matrices[last]
    return step[:, :3, :3], step[:, :3, 3]


def _angles(rotations: np.ndarray) -> np.ndarray:
    """Angle of rotation matrices, degrees; exact for small angles, where the arc cosine is not."""
    axis = np.stack([rotations[:, a, b] - rotations[:, b, a] for a, b in ((2, 1), (0, 2), (1, 0))], axis=1)
    return np.degrees(np.arctan2(np.linalg.norm(axis, axis=1), np.trace(rotations, axis1=1, axis2=2) - 1))


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between vectors, degrees; 90 where the first has no length, as a guess at random has on average."""
    lengths = np.linalg.norm(a, axis=1)
    angles = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))
    return np.where(lengths > 1e-12, angles, 90.0)
