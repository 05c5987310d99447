"""Errors by evo, and protocols that evo does not have: KITTI's segments, relative-pose AUC, per-frame scale.

Each function takes an estimate and a reference as camera-to-world trajectories in metres and seconds; a value without a
meaning is nan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import pose_matrices, poses_from_matrices
from dvo.metrics import Alignment, Metrics, associate, evaluate, fit_alignment, transform

KITTI_LENGTHS = tuple(range(100, 801, 100))  # metres
KITTI_STEP = 10  # frames between the starts of two segments
AUC_DEGREES = (1.0, 2.0, 5.0, 10.0)
STILL_SHARE = 0.1  # of the median step: a pair that moves less has no direction to judge


@dataclass(frozen=True)
class PathErrors:
    """Relative errors over a distance: pairs of frames ``distance_m`` apart along the reference, all of them.

    Attributes:
        distance_m: a tenth of the reference's path.
        trans_percent: median translation error in percent of the distance.
        rot_deg: median rotation error, degrees.
    """

    distance_m: float = math.nan
    trans_percent: float = math.nan
    rot_deg: float = math.nan


@dataclass(frozen=True)
class SegmentErrors:
    """KITTI odometry's errors, averaged over all segments of 100 to 800 m that fit the sequence.

    Attributes:
        t_rel: translation, percent of the segment's length.
        r_rel: rotation, degrees per 100 m.
        longest_m: longest segment that entered; nan where the path is under 100 m and the two others are nan too.
    """

    t_rel: float = math.nan
    r_rel: float = math.nan
    longest_m: float = math.nan


@dataclass(frozen=True)
class Aligned:
    """The matched frames of a reference and of an estimate after alignment, as evo's trajectories.

    Attributes:
        truth, track: of the same length.
        scale: that was fitted, 1 where none was.
        ours: the errors that dvo itself finds.
    """

    truth: Any
    track: Any
    scale: float
    ours: Metrics


def align_pair(
    estimate: Trajectory, reference: Trajectory, align: Alignment = "sim3", *, rpe_gap: int = 1, max_dt: float = 0.01
) -> Aligned | Metrics:
    """Match and align. Where that has no meaning, dvo's :class:`Metrics` that say why.

    evo refuses to align points on a line, as the turn about the line is open; then dvo's fit is taken.

    Args:
        estimate, reference: camera to world, metres and seconds.
        align: ``none``, ``scale``, ``se3`` or ``sim3``.
        rpe_gap: frames between the two of a relative error.
        max_dt: largest difference of matched stamps, seconds.
    """
    ours = evaluate(estimate, reference, align, rpe_gap=rpe_gap, max_dt=max_dt)
    if not math.isfinite(ours.ate_rmse):
        return ours
    from evo.core import sync
    from evo.core.geometry import GeometryException

    truth, track = sync.associate_trajectories(_evo(reference), _evo(estimate), max_diff=max_dt)
    scale = 1.0
    try:
        if align != "none":
            _, _, scale = track.align(truth, correct_scale=align == "sim3", correct_only_scale=align == "scale")
    except GeometryException:
        i, j = associate(estimate, reference, max_dt)
        scale, rotation, shift = fit_alignment(estimate.positions[i], reference.positions[j], align)
        matched = Trajectory(estimate.timestamps[i], estimate.poses_wc[i])
        track = _evo(transform(matched, scale, rotation, shift))
    return Aligned(truth, track, float(scale), ours)


def evo_metrics(
    estimate: Trajectory,
    reference: Trajectory,
    align: Alignment = "sim3",
    *,
    rpe_gap: int = 1,
    max_dt: float = 0.01,
) -> Metrics:
    """:func:`dvo.metrics.evaluate` with ATE, RPE, scale and path length computed by evo.

    Args:
        estimate, reference, align, rpe_gap, max_dt: see :func:`align_pair`.
    """
    pair = align_pair(estimate, reference, align, rpe_gap=rpe_gap, max_dt=max_dt)
    return metrics_of(pair) if isinstance(pair, Aligned) else pair


def metrics_of(pair: Aligned) -> Metrics:
    """See :func:`evo_metrics`; the rotation ratio and the scale drift, which evo has not, are dvo's."""
    from evo.core import metrics
    from evo.core.metrics import PoseRelation, Unit

    ate, gap = absolute_rmse(pair), pair.ours.rpe_gap
    values = {"ate_rmse": ate, "scale": pair.scale, "path_length": float(pair.truth.path_length)}
    if values["path_length"] > 0:
        values["ate_percent"] = 100 * ate / values["path_length"]
    if pair.ours.matched > gap:
        for name, relation in (
            ("rpe_trans", PoseRelation.translation_part),
            ("rpe_rot_deg", PoseRelation.rotation_angle_deg),
        ):
            rpe = metrics.RPE(relation, delta=gap, delta_unit=Unit.frames, all_pairs=True)
            rpe.process_data((pair.truth, pair.track))
            values[name] = float(rpe.get_statistic(metrics.StatisticsType.median))
            values[f"{name}_rmse"] = float(rpe.get_statistic(metrics.StatisticsType.rmse))
    return replace(pair.ours, **values)  # type: ignore[arg-type]


def absolute_rmse(pair: Aligned, angle: bool = False) -> float:
    """Root mean square distance to the reference, metres; or the angle between orientations, degrees (evo's APE).

    Args:
        pair: from :func:`align_pair`.
        angle: orientations in place of positions.
    """
    from evo.core import metrics

    relation = metrics.PoseRelation.rotation_angle_deg if angle else metrics.PoseRelation.translation_part
    ape = metrics.APE(relation)
    ape.process_data((pair.truth, pair.track))
    return float(ape.get_statistic(metrics.StatisticsType.rmse))


def path_errors(pair: Aligned, distance_m: float | None = None) -> PathErrors:
    """evo's RPE with a distance in place of a number of frames, pairs chosen on the reference (tolerance 10 %).

    Args:
        distance_m: a tenth of the matched reference's path by default.
    """
    from evo.core import filters, metrics
    from evo.core.metrics import PoseRelation, Unit

    distance = float(pair.truth.path_length) / 10 if distance_m is None else distance_m
    if not distance > 0:
        return PathErrors()
    values = []
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        rpe = metrics.RPE(relation, delta=distance, delta_unit=Unit.meters, all_pairs=True, pairs_from_reference=True)
        try:
            rpe.process_data((pair.truth, pair.track))
        except filters.FilterException:  # no pair of frames is that far apart
            return PathErrors(distance)
        values.append(float(rpe.get_statistic(metrics.StatisticsType.median)))
    return PathErrors(distance, 100 * values[0] / distance, values[1])


def kitti_errors(
    estimate: Trajectory, reference: Trajectory, scale: float = 1.0, max_dt: float = 0.01
) -> SegmentErrors:
    """Translation and rotation error over segments of 100, 200, ... 800 m of the reference (Geiger et al., CVPR 2012).

    A segment starts at every tenth frame of the reference and ends at the first frame beyond its length; it counts if
    the estimate has both ends. Lengths that the sequence does not reach are left out, as in KITTI's own tool.

    Args:
        scale: factor on the estimate's translations, from the alignment.
    """
    distances = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(reference.positions, axis=0), axis=1))])
    i, j = associate(estimate, reference, max_dt)
    rows = np.full(len(reference), -1)
    rows[j] = i
    truth, track = pose_matrices(reference.poses_wc), pose_matrices(estimate.poses_wc)
    track[:, :3, 3] *= scale
    found = []
    for first in range(0, len(reference), KITTI_STEP):
        for length in KITTI_LENGTHS:
            last = int(np.searchsorted(distances, distances[first] + length, side="right"))
            if last >= len(reference) or rows[first] < 0 or rows[last] < 0:
                continue
            step = np.linalg.inv(truth[first]) @ truth[last]
            error = np.linalg.inv(np.linalg.inv(track[rows[first]]) @ track[rows[last]]) @ step
            angle = math.acos(min(1.0, max(-1.0, (float(np.trace(error[:3, :3])) - 1) / 2)))
            found.append((float(np.linalg.norm(error[:3, 3])) / length, math.degrees(angle) / length, length))
    if not found:
        return SegmentErrors()
    table = np.array(found)
    return SegmentErrors(100 * table[:, 0].mean(), 100 * table[:, 1].mean(), table[:, 2].max())


def relative_pose_auc(
    estimate: Trajectory, reference: Trajectory, gap: int = 1, max_dt: float = 0.01
) -> dict[float, float]:
    """Area under the recall curve of relative poses up to 1, 2, 5 and 10 degrees, in [0, 1]; scale plays no part.

    The error of a pair ``i, i + gap`` of reference frames is the larger of its rotation error and the angle between the
    translations' directions (rotation alone where the reference hardly moves: under a tenth of its median step). The
    area under a curve of steps is ``mean(max(0, 1 - error / threshold))``. A pair that the estimate lacks fails.

    Args:
        estimate, reference: camera to world, seconds.
        gap: frames between the two of a pair.
        max_dt: largest difference of matched stamps, seconds.

    Returns:
        Area by threshold, degrees; nan for a reference that is too short.
    """
    if len(reference) <= gap:
        return dict.fromkeys(AUC_DEGREES, math.nan)
    i, j = associate(estimate, reference, max_dt)
    rows = np.full(len(reference), -1)
    rows[j] = i
    starts = np.arange(len(reference) - gap)
    true_turn, true_step = _steps(reference.poses_wc, starts, starts + gap)
    errors = np.full(len(starts), np.inf)
    has = (rows[starts] >= 0) & (rows[starts + gap] >= 0)
    turn, step = _steps(estimate.poses_wc, rows[starts[has]], rows[starts[has] + gap])
    errors[has] = _angles(np.swapaxes(true_turn[has], 1, 2) @ turn)
    lengths = np.linalg.norm(true_step, axis=1)
    moves = has & (lengths > max(1e-9, STILL_SHARE * float(np.median(lengths))))
    errors[moves] = np.maximum(errors[moves], _between(step[moves[has]], true_step[moves]))
    return {limit: float(np.maximum(0, 1 - errors / limit).mean()) for limit in AUC_DEGREES}


def per_frame_scale(estimate: Trajectory, reference: Trajectory, max_dt: float = 0.01) -> Trajectory:
    """The estimate with every frame-to-frame translation rescaled to the reference's length, chained anew.

    This is how TartanVO and its heirs report; it hands the estimate one true number per frame, so its ATE stands in a
    column of its own and is never compared with an ordinary one. A step without a direction stays at zero.

    Args:
        estimate, reference: camera to world, seconds.
        max_dt: largest difference of matched stamps, seconds.

    Returns:
        Camera to world at the matched stamps of the reference.
    """
    i, j = associate(estimate, reference, max_dt)
    track = pose_matrices(estimate.poses_wc[i])
    truth = reference.positions[j]
    if len(i) < 2:
        return Trajectory(reference.timestamps[j], estimate.poses_wc[i])
    steps = np.diff(track[:, :3, 3], axis=0)
    have = np.linalg.norm(steps, axis=1, keepdims=True)
    want = np.linalg.norm(np.diff(truth, axis=0), axis=1, keepdims=True)
    steps = np.where(have > 1e-12, steps * want / np.maximum(have, 1e-12), 0.0)
    track[1:, :3, 3] = track[0, :3, 3] + np.cumsum(steps, axis=0)
    return Trajectory(reference.timestamps[j], poses_from_matrices(track))


def _evo(trajectory: Trajectory) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        positions_xyz=trajectory.positions.copy(),
        orientations_quat_wxyz=trajectory.poses_wc[:, [6, 3, 4, 5]],
        timestamps=trajectory.timestamps.copy(),
    )


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
