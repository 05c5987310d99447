"""The second half of an evaluation: compare what the runs left behind with ground truth. Errors are evo's."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import Alignment, Metrics, associate, evaluate, fit_alignment, transform
from eval.predict import Prediction
from eval.sequences import Sequence, Suite, reference_for


@dataclass(frozen=True)
class Row:
    """One run in results.csv; fields are the columns, nan where a value has no meaning."""

    system: str
    version: str
    suite: str
    sequence: str
    seed: int
    status: str
    frames: int
    tracked: int
    alignment: str
    ate_rmse: float
    rpe_trans: float
    rpe_rot_deg: float
    completeness: float
    fps: float
    latency_p95_ms: float
    peak_memory_mb: float
    stride: int
    resolution: str
    ate_percent: float
    rotation_error_ratio: float
    scale_drift: float
    reason: str

    @property
    def failed(self) -> bool:
        return self.status != "ok"


COLUMNS = tuple(field.name for field in fields(Row))


def score(
    prediction: Prediction,
    estimate: Trajectory,
    groundtruth: Trajectory | None,
    *,
    system: str,
    suite: Suite,
    sequence: Sequence,
    seed: int,
) -> Row:
    """One row of the table. A run that failed is a row too.

    Args:
        groundtruth: of the whole sequence; None where the data are not there.
    """
    stamps = np.array(prediction.stamps, dtype=np.float64)
    metrics = None
    status, reason = prediction.status, prediction.reason
    frames = len(stamps)
    if groundtruth is not None and frames:
        metrics = evo_metrics(estimate, reference_for(groundtruth, stamps), suite.alignment, rpe_gap=suite.rpe_gap)
    completeness = prediction.tracked / frames if frames else math.nan
    if status == "ok" and not completeness >= suite.lost_below:
        status, reason = "lost", f"{prediction.tracked} of {frames} frames have a pose"
    elif status == "ok" and metrics is not None and metrics.reason:
        reason = metrics.reason
        if not math.isfinite(getattr(metrics, sequence.judged_by)):
            status = "failed"

    def value(name: str) -> float:
        return math.nan if metrics is None else float(getattr(metrics, name))

    return Row(
        system=system,
        version=prediction.version,
        suite=suite.name,
        sequence=sequence.name,
        seed=seed,
        status=status,
        frames=frames,
        tracked=prediction.tracked,
        alignment=suite.alignment,
        ate_rmse=value("ate_rmse"),
        rpe_trans=value("rpe_trans"),
        rpe_rot_deg=value("rpe_rot_deg"),
        completeness=completeness,
        fps=_number(prediction.fps),
        latency_p95_ms=_number(prediction.latency_p95_ms),
        peak_memory_mb=_number(prediction.peak_memory_mb),
        stride=suite.stride,
        resolution=prediction.resolution,
        ate_percent=value("ate_percent"),
        rotation_error_ratio=value("rotation_error_ratio"),
        scale_drift=value("scale_drift"),
        reason=reason,
    )


def evo_metrics(
    estimate: Trajectory,
    reference: Trajectory,
    align: Alignment = "sim3",
    *,
    rpe_gap: int = 1,
    max_dt: float = 0.01,
) -> Metrics:
    """:func:`dvo.metrics.evaluate` with ATE, RPE, scale and path length computed by evo.

    evo has no rotation ratio, no scale drift, and no alignment of points on a line (it refuses, as the turn about the
    line is open); those are dvo's.
    """
    ours = evaluate(estimate, reference, align, rpe_gap=rpe_gap, max_dt=max_dt)
    if not math.isfinite(ours.ate_rmse):
        return ours
    from evo.core import metrics, sync
    from evo.core.geometry import GeometryException
    from evo.core.metrics import PoseRelation, Unit

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
    ape = metrics.APE(PoseRelation.translation_part)
    ape.process_data((truth, track))
    ate = float(ape.get_statistic(metrics.StatisticsType.rmse))
    values = {"ate_rmse": ate, "scale": float(scale), "path_length": float(truth.path_length)}
    if values["path_length"] > 0:
        values["ate_percent"] = 100 * ate / values["path_length"]
    if ours.matched > rpe_gap:
        for name, relation in (
            ("rpe_trans", PoseRelation.translation_part),
            ("rpe_rot_deg", PoseRelation.rotation_angle_deg),
        ):
            rpe = metrics.RPE(relation, delta=rpe_gap, delta_unit=Unit.frames, all_pairs=True)
            rpe.process_data((truth, track))
            values[name] = float(rpe.get_statistic(metrics.StatisticsType.median))
            values[f"{name}_rmse"] = float(rpe.get_statistic(metrics.StatisticsType.rmse))
    return replace(ours, **values)  # type: ignore[arg-type]


def _evo(trajectory: Trajectory):  # type: ignore[no-untyped-def]  # evo is an extra: its types are not at hand
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        positions_xyz=trajectory.positions.copy(),
        orientations_quat_wxyz=trajectory.poses_wc[:, [6, 3, 4, 5]],
        timestamps=trajectory.timestamps.copy(),
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
