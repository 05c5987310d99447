"""Errors by evo: ATE, RPE over frames and over distances.

An estimate and a reference are camera-to-world trajectories in metres and seconds; a value without a meaning is nan. A
trajectory in segments comes in pieces (:mod:`eval.scoring.errors`), whose errors are taken together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import Alignment, Metrics, associate, evaluate, fit_alignment, transform


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

    def __len__(self) -> int:
        return len(self.truth.timestamps)


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

    truth, track = sync.associate_trajectories(evo_trajectory(reference), evo_trajectory(estimate), max_diff=max_dt)
    scale = 1.0
    try:
        if align != "none":
            _, _, scale = track.align(truth, correct_scale=align == "sim3", correct_only_scale=align == "scale")
    except GeometryException:
        i, j = associate(estimate, reference, max_dt)
        scale, rotation, shift = fit_alignment(estimate.positions[i], reference.positions[j], align)
        matched = Trajectory(estimate.timestamps[i], estimate.poses_wc[i])
        track = evo_trajectory(transform(matched, scale, rotation, shift))
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


def metrics_of(*pieces: Aligned, unscored: Sequence[Aligned] = ()) -> Metrics:
    """See :func:`evo_metrics`; of several pieces, the errors of all their frames and pairs together.

    The rotation ratio and the scale drift, which evo has not, are dvo's, as are the counts.

    Args:
        pieces: one or more, each with the same ``ours``, that of the whole.
        unscored: pieces of which only the relative rotations count, as they need no alignment.
    """
    from evo.core.metrics import PoseRelation

    ours = pieces[0].ours
    ate, path = absolute_rmse(*pieces), float(sum(piece.truth.path_length for piece in pieces))
    values = {"ate_rmse": ate, "path_length": path, "scale": max(pieces, key=len).scale}
    if path > 0:
        values["ate_percent"] = 100 * ate / path
    for name, relation, counted in (
        ("rpe_trans", PoseRelation.translation_part, pieces),
        ("rpe_rot_deg", PoseRelation.rotation_angle_deg, (*pieces, *unscored)),
    ):
        errors = relative_errors(counted, relation, ours.rpe_gap)
        if len(errors):
            values[name], values[f"{name}_rmse"] = float(np.median(errors)), _rms(errors)
    return replace(ours, **values)  # type: ignore[arg-type]


def relative_errors(pieces: Sequence[Aligned], relation: Any, gap: int) -> np.ndarray:
    """evo's RPE of all pairs of frames of a piece, metres or degrees; no pair has its frames in two pieces.

    Args:
        pieces: from :func:`align_pair`.
        relation: evo's ``PoseRelation``.
        gap: frames between the two of a pair.
    """
    from evo.core import metrics
    from evo.core.metrics import Unit

    found = [np.zeros(0)]
    for piece in pieces:
        if len(piece) > gap:
            rpe = metrics.RPE(relation, delta=gap, delta_unit=Unit.frames, all_pairs=True)
            rpe.process_data((piece.truth, piece.track))
            found.append(rpe.error)
    return np.concatenate(found)


def absolute_rmse(*pieces: Aligned, angle: bool = False) -> float:
    """Root mean square distance to the reference, metres; or the angle between orientations, degrees (evo's APE).

    Args:
        pieces: from :func:`align_pair`; the mean is over the frames of all.
        angle: orientations in place of positions.
    """
    from evo.core import metrics

    relation = metrics.PoseRelation.rotation_angle_deg if angle else metrics.PoseRelation.translation_part
    errors = []
    for piece in pieces:
        ape = metrics.APE(relation)
        ape.process_data((piece.truth, piece.track))
        errors.append(ape.error)
    return _rms(np.concatenate(errors))


def path_errors(*pieces: Aligned, distance_m: float | None = None) -> PathErrors:
    """evo's RPE with a distance in place of a number of frames, pairs chosen on the reference (tolerance 10 %).

    Args:
        pieces: from :func:`align_pair`; no pair has its frames in two of them.
        distance_m: a tenth of the matched reference's path by default.
    """
    from evo.core import filters, metrics
    from evo.core.metrics import PoseRelation, Unit

    whole = float(sum(piece.truth.path_length for piece in pieces))
    distance = whole / 10 if distance_m is None else distance_m
    if not distance > 0:
        return PathErrors()
    values = []
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        errors = []
        for piece in pieces:
            rpe = metrics.RPE(
                relation, delta=distance, delta_unit=Unit.meters, all_pairs=True, pairs_from_reference=True
            )
            try:
                rpe.process_data((piece.truth, piece.track))
            except filters.FilterException:  # no pair of its frames is that far apart
                continue
            errors.append(rpe.error)
        if not errors:
            return PathErrors(distance)
        values.append(float(np.median(np.concatenate(errors))))
    return PathErrors(distance, 100 * values[0] / distance, values[1])


def evo_trajectory(trajectory: Trajectory) -> Any:
    """A trajectory as evo's."""
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        positions_xyz=trajectory.positions.copy(),
        orientations_quat_wxyz=trajectory.poses_wc[:, [6, 3, 4, 5]],
        timestamps=trajectory.timestamps.copy(),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))
