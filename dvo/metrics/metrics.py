"""Errors of an estimated trajectory against a reference: ATE, RPE, rotation and scale errors, in plain numpy.

Definitions follow Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems" (IROS 2012) for ATE and RPE and
Umeyama (PAMI 1991) for the alignment; the tests compare the values with those of evo. An undefined value is nan, with
an explanation in :attr:`Metrics.reason`; a poor estimate raises no exception.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import pose_matrices, poses_from_matrices

Alignment = Literal["none", "scale", "se3", "sim3"]
MINIMUM_MATCHES = 3
_STILL = 1e-9  # relative spread of positions below which a trajectory counts as not moving


@dataclass(frozen=True)
class Metrics:
    """Errors of an estimate against a reference. An undefined value is nan, with an explanation in ``reason``.

    Attributes:
        alignment: transformation fitted before the errors were computed: ``none``, ``scale``, ``se3`` or ``sim3``.
        ate_rmse: absolute trajectory error, root mean square over the matched frames, metres.
        ate_percent: the same in percent of ``path_length``.
        rpe_gap: frame gap of the relative errors (pairs ``i, i + gap`` of matched frames, all of them).
        rpe_trans, rpe_trans_rmse: relative translation error, median and RMSE, metres.
        rpe_rot_deg, rpe_rot_deg_rmse: relative rotation error, median and RMSE, degrees.
        rotation_error_ratio: sum of the relative rotation errors over the sum of the reference's relative rotations;
            1 for an estimate without rotation.
        scale: factor from the estimate to the reference (1 unless the alignment fits it).
        scale_drift: scale of the last third over scale of the first third of the matched frames, minus 1.
        matched: number of frames that both trajectories have.
        reference_frames: number of frames of the reference.
        completeness: ``matched / reference_frames``.
        path_length: length of the matched reference, metres.
        reason: explanation of values that are nan, or None.
    """

    alignment: Alignment
    ate_rmse: float
    ate_percent: float
    rpe_gap: int
    rpe_trans: float
    rpe_trans_rmse: float
    rpe_rot_deg: float
    rpe_rot_deg_rmse: float
    rotation_error_ratio: float
    scale: float
    scale_drift: float
    matched: int
    reference_frames: int
    completeness: float
    path_length: float
    reason: str | None = None


def associate(estimate: Trajectory, reference: Trajectory, max_dt: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Match the frames of two trajectories by time, each frame at most once.

    Every timestamp of the shorter trajectory is matched with the nearest one of the longer trajectory within
    ``max_dt``; of two candidates for the same frame, the nearer is matched.

    Args:
        estimate, reference: the trajectories, timestamps in seconds.
        max_dt: largest difference of matched timestamps, seconds.

    Returns:
        Index vectors ``(M,)`` into the estimate and into the reference; increasing where the timestamps are.
    """
    swap = len(estimate) > len(reference)
    few, many = (reference, estimate) if swap else (estimate, reference)
    empty = np.zeros(0, np.int64)
    if len(few) == 0:
        return empty, empty
    order = np.argsort(many.timestamps, kind="stable")
    stamps = many.timestamps[order]
    above = np.clip(np.searchsorted(stamps, few.timestamps, side="right"), 0, len(stamps) - 1)
    below = np.maximum(above - 1, 0)
    to_above, to_below = np.abs(stamps[above] - few.timestamps), np.abs(few.timestamps - stamps[below])
    nearest = np.where(to_above < to_below, above, below)
    gap = np.minimum(to_above, to_below)
    wanted = np.lexsort((gap, nearest))
    first = np.ones(len(wanted), bool)
    first[1:] = nearest[wanted][1:] != nearest[wanted][:-1]
    kept = np.sort(wanted[first & (gap[wanted] <= max_dt)])
    pairs = kept, order[nearest[kept]]
    return (pairs[1], pairs[0]) if swap else pairs


def fit_alignment(
    source: np.ndarray, target: np.ndarray, mode: Alignment = "sim3"
) -> tuple[float, np.ndarray, np.ndarray]:
    """Least-squares alignment ``s, R, t`` of positions, ``target ~ s R source + t`` (Umeyama 1991).

    ``scale`` is the scale of the Sim(3) fit with identity rotation and zero translation, as in evo.

    Args:
        source: ``(N, 3)`` positions.
        target: ``(N, 3)`` positions.
        mode: transformation to fit.

    Returns:
        Scale, rotation ``(3, 3)`` and translation ``(3,)``.

    Raises:
        DvoError: an unknown mode.
    """
    if mode not in get_args(Alignment):
        raise DvoError(
            f"unknown alignment '{mode}'", field="align", remedy=f"choose one of {', '.join(get_args(Alignment))}"
        )
    if mode == "none":
        return 1.0, np.eye(3), np.zeros(3)
    from dvo.geometry.alignment import align  # imported here because it imports torch

    fitted = align(source, target, "se3" if mode == "se3" else "sim3").numpy()
    if mode == "scale":
        return float(fitted[7]), np.eye(3), np.zeros(3)
    matrix = pose_matrices(fitted[:7])
    return float(fitted[7]), matrix[:3, :3], matrix[:3, 3]


def transform(trajectory: Trajectory, scale: float, rotation: np.ndarray, translation: np.ndarray) -> Trajectory:
    """Transform a trajectory to another world frame: positions ``s R p + t``, orientations ``R q``.

    Args:
        trajectory: camera to world.
        scale: ``s``.
        rotation: ``(3, 3)``.
        translation: ``(3,)``.

    Returns:
        Trajectory with the same timestamps.
    """
    positions = scale * trajectory.positions @ rotation.T + translation
    turn = poses_from_matrices(np.column_stack([rotation, translation]))[3:]
    quaternions = _multiply(turn, _unit(trajectory.poses_wc[:, 3:]))
    return Trajectory(trajectory.timestamps, np.column_stack([positions, quaternions]))


def align_trajectory(
    estimate: Trajectory, reference: Trajectory, align: Alignment = "sim3", max_dt: float = 0.01
) -> Trajectory:
    """Align an estimate with a reference, for plots.

    Args:
        estimate, reference: camera to world, metres, seconds.
        align: transformation to fit.
        max_dt: largest difference of matched timestamps, seconds.

    Returns:
        All frames of the estimate in the frame of the reference; the estimate itself if no fit is possible.

    Raises:
        DvoError: an unknown alignment.
    """
    i, j = associate(estimate, reference, max_dt)
    if len(i) < MINIMUM_MATCHES or stands_still(estimate.positions[i]):
        return estimate
    return transform(estimate, *fit_alignment(estimate.positions[i], reference.positions[j], align))


def relative_rotation_errors(
    estimate: Trajectory, reference: Trajectory, gap: int = 1, max_dt: float = 0.01
) -> tuple[np.ndarray, np.ndarray]:
    """Relative rotation error of every pair ``i, i + gap`` of matched frames.

    Args:
        estimate, reference: camera to world, seconds.
        gap: distance of the frames of a pair.
        max_dt: largest difference of matched timestamps, seconds.

    Returns:
        ``(P,)`` time of the second frame of each pair, seconds, and ``(P,)`` error, degrees.
    """
    i, j = associate(estimate, reference, max_dt)
    errors, _, _ = relative_errors(estimate.poses_wc[i], reference.poses_wc[j], gap, 1.0)
    return estimate.timestamps[i][gap:], errors


@checked_arguments
def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    align: Alignment = "sim3",
    *,
    rpe_gap: int = 1,
    max_dt: float = 0.01,
) -> Metrics:
    """Compare an estimate with a reference.

    Args:
        estimate: camera to world ``T_wc``.
        reference: ground truth, camera to world ``T_wc``, metres.
        align: transformation to fit first: ``none``, ``scale``, ``se3`` or ``sim3``.
        rpe_gap: frame gap of the relative errors.
        max_dt: largest difference of matched timestamps, seconds.

    Returns:
        Errors in metres and degrees; an undefined value is nan.

    Raises:
        DvoError: an unknown alignment or a gap below 1.

    Example:
        >>> times = np.arange(4.0)
        >>> poses_wc = np.tile([0.0, 0, 0, 0, 0, 0, 1], (4, 1))
        >>> poses_wc[:, :3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]]
        >>> half = poses_wc * [0.5, 0.5, 0.5, 1, 1, 1, 1]
        >>> found = dvo.evaluate(dvo.Trajectory(times, half), dvo.Trajectory(times, poses_wc), align="sim3")
        >>> round(found.ate_rmse, 6), round(found.scale, 6)
        (0.0, 2.0)
    """
    if rpe_gap < 1:
        raise DvoError(f"must be 1 or more, got {rpe_gap}", field="rpe_gap", remedy="give a number of frames")
    fit_alignment(np.zeros((1, 3)), np.zeros((1, 3)), align)  # checks the mode, also without matches
    i, j = associate(estimate, reference, max_dt)
    est, ref = estimate.poses_wc[i], reference.poses_wc[j]
    finite = np.isfinite(est).all(axis=1)
    est, ref = est[finite], ref[finite]
    path_length = float(np.linalg.norm(np.diff(ref[:, :3], axis=0), axis=1).sum())

    reasons = [] if finite.all() else [f"{int((~finite).sum())} poses are not finite"]
    nan = float("nan")
    ate = scale = rpe_trans = rpe_trans_rmse = nan
    aligned = None
    if len(est) < MINIMUM_MATCHES:
        reasons.append(f"{len(est)} matched frames, {MINIMUM_MATCHES} are needed")
    elif align != "none" and (stands_still(est[:, :3]) or stands_still(ref[:, :3])):
        still = "estimate" if stands_still(est[:, :3]) else "reference"
        reasons.append(f"the {still} stands still, nothing to align")
    else:
        scale, rotation, translation = fit_alignment(est[:, :3], ref[:, :3], align)
        aligned = scale * est[:, :3] @ rotation.T + translation
        ate = float(np.sqrt(((aligned - ref[:, :3]) ** 2).sum(axis=1).mean()))

    rotation_errors, turned, moved_wrong = relative_errors(est, ref, rpe_gap, 1.0 if np.isnan(scale) else scale)
    if aligned is not None and len(moved_wrong):
        rpe_trans, rpe_trans_rmse = float(np.median(moved_wrong)), _rms(moved_wrong)
    if len(est) >= MINIMUM_MATCHES and not len(rotation_errors):
        reasons.append(f"no two matched frames {rpe_gap} apart")
    return Metrics(
        alignment=align,
        ate_rmse=ate,
        ate_percent=100 * ate / path_length if path_length > 0 else nan,
        rpe_gap=rpe_gap,
        rpe_trans=rpe_trans,
        rpe_trans_rmse=rpe_trans_rmse,
        rpe_rot_deg=float(np.median(rotation_errors)) if len(rotation_errors) else nan,
        rpe_rot_deg_rmse=_rms(rotation_errors) if len(rotation_errors) else nan,
        rotation_error_ratio=float(rotation_errors.sum() / turned.sum()) if turned.sum() > 1e-9 else nan,
        scale=scale,
        scale_drift=_scale_drift(est[:, :3], ref[:, :3]),
        matched=len(est),
        reference_frames=len(reference),
        completeness=len(est) / len(reference) if len(reference) else nan,
        path_length=path_length,
        reason="; ".join(reasons) or None,
    )


def relative_errors(
    est: np.ndarray, ref: np.ndarray, gap: int, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation error and reference rotation (degrees) and translation error (metres) of the pairs ``(i, i + gap)``.

    With ``P = inverse(T_i) T_{i+gap}``, the error is ``inverse(P_ref) P_est`` (Sturm 2012, eq. 2).

    Args:
        est, ref: ``(N, 7)`` matched poses, camera to world.
        gap: distance of the frames of a pair.
        scale: factor on the translations of ``est``.

    Returns:
        Three vectors ``(N - gap,)``, empty without a pair.
    """
    if len(est) <= gap:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    q_est, t_est = _relative(est, gap)
    q_ref, t_ref = _relative(ref, gap)
    errors = _angle_deg(_multiply(_conjugate(q_ref), q_est))
    return errors, _angle_deg(q_ref), np.linalg.norm(scale * t_est - t_ref, axis=1)


def _relative(poses: np.ndarray, gap: int) -> tuple[np.ndarray, np.ndarray]:
    quaternions = _unit(poses[:, 3:])
    back = _conjugate(quaternions[:-gap])
    return _multiply(back, quaternions[gap:]), _rotate(back, poses[gap:, :3] - poses[:-gap, :3])


def _scale_drift(est: np.ndarray, ref: np.ndarray) -> float:
    third = len(est) // 3
    if third < MINIMUM_MATCHES:
        return float("nan")
    spreads = [(_spread(ref[part]), _spread(est[part])) for part in (slice(0, third), slice(-third, None))]
    if min(min(pair) for pair in spreads) <= _STILL * max(1.0, float(np.abs(est).max()), float(np.abs(ref).max())):
        return float("nan")
    first, last = (ref_spread / est_spread for ref_spread, est_spread in spreads)
    return last / first - 1


def _spread(points: np.ndarray) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def stands_still(points: np.ndarray) -> bool:
    """Return True if positions ``(N, 3)`` do not spread, up to rounding."""
    return _spread(points) <= _STILL * max(1.0, float(np.abs(points).max()))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def _unit(q: np.ndarray) -> np.ndarray:
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def _conjugate(q: np.ndarray) -> np.ndarray:
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of ``(..., 4)`` quaternions ``x y z w``."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + np.cross(av, bv)
    return np.concatenate([vector, aw * bw - (av * bv).sum(axis=-1, keepdims=True)], axis=-1)


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    twice = 2 * np.cross(q[..., :3], v)
    return v + q[..., 3:] * twice + np.cross(q[..., :3], twice)


def _angle_deg(q: np.ndarray) -> np.ndarray:
    return np.degrees(2 * np.arctan2(np.linalg.norm(q[..., :3], axis=-1), np.abs(q[..., 3])))
