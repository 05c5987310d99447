"""Second half of an evaluation: compare trajectories with ground truth. Errors are evo's where evo has them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from dvo.data.trajectory import Trajectory, read_tum
from dvo.metrics import Metrics
from eval.execution.plan import Manifest, Run, groundtruth_file
from eval.execution.predict import RECORD, Prediction, read_prediction, read_trajectory
from eval.scoring.blackout import BlackoutErrors, blackout_errors
from eval.scoring.metrics import (
    Aligned,
    PathErrors,
    SegmentErrors,
    absolute_rmse,
    align_pair,
    kitti_errors,
    metrics_of,
    path_errors,
    per_frame_scale,
    relative_pose_auc,
)
from eval.suites.suite import Sequence, Suite, reference_for

AUC_METRES = 1.0  # DPVO's "AUC" of a run is max(0, 1 - ATE / 1 m); a table's is the mean over runs, failed ones 0


@dataclass(frozen=True)
class Row:
    """One run in results.csv; fields are the columns, nan where a value has no meaning.

    Attributes:
        ate_rmse, ate_percent: metres, percent of the path; after the alignment, as all errors.
        rpe_trans, rpe_rot_deg: median over all pairs of frames :attr:`Suite.rpe_gap` apart; ``_rmse`` beside.
        rotation_error_ratio: sum of relative rotation errors over sum of relative rotations; 1 without any turn.
        scale_drift: scale of the last third over scale of the first, minus 1.
        t_rel, r_rel, kitti_longest_m: see :class:`eval.scoring.metrics.SegmentErrors`.
        auc: DPVO's, of this run: ``max(0, 1 - ATE)`` with a metre as threshold, 0 for a failed run.
        pose_auc_1, ...: see :func:`eval.scoring.metrics.relative_pose_auc`; 0 for a failed run.
        ate_per_frame_scale: metres, every step given the true length first; not comparable with an ordinary ATE.
        ate_rot_deg: root mean square angle to the truth after the alignment.
        rpe_distance_m, rpe_distance_percent, rpe_distance_deg: see :class:`eval.scoring.metrics.PathErrors`.
        blackouts, segment_ate_percent, recovery_s: see :class:`eval.scoring.blackout.BlackoutErrors`.
        threads, parallel, device: how the resources were measured; ``parallel`` above 1 means on a shared machine.
    """

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
    rotation_error_ratio: float
    scale_drift: float
    t_rel: float
    r_rel: float
    kitti_longest_m: float
    auc: float
    pose_auc_1: float
    pose_auc_2: float
    pose_auc_5: float
    pose_auc_10: float
    ate_per_frame_scale: float
    ate_percent: float
    ate_rot_deg: float
    rpe_distance_m: float
    rpe_distance_percent: float
    rpe_distance_deg: float
    rpe_trans_rmse: float
    rpe_rot_deg_rmse: float
    path_length: float
    blackouts: int
    segment_ate_percent: float
    recovery_s: float
    threads: int
    parallel: int
    device: str
    reason: str

    @property
    def failed(self) -> bool:
        return self.status != "ok"


COLUMNS = tuple(column.name for column in fields(Row))


def score_all(out: Path, manifest: Manifest) -> list[Row]:
    """Every run of an evaluation as a row, those that were never made included.

    Args:
        out: folder of the evaluation.
        manifest: names its runs.

    Returns:
        Rows in the order of the runs.
    """
    truths: dict[tuple[str, str], Trajectory | None] = {}
    rows = []
    for run in manifest.runs:
        place = run.suite, run.sequence
        if place not in truths:
            file = groundtruth_file(out, *place)
            truths[place] = read_tum(file) if file.is_file() else None
        rows.append(score_run(out, manifest, run, truths[place]))
    return rows


def score_run(out: Path, manifest: Manifest, run: Run, groundtruth: Trajectory | None) -> Row:
    """One run of an evaluation as a row.

    Args:
        out: folder of the evaluation.
        manifest: of the evaluation.
        run: to score.
        groundtruth: of the whole sequence; None where there are no data.
    """
    suite = manifest.suite(run.suite)
    sequence = next(sequence for sequence in suite.sequences if sequence.name == run.sequence)
    folder = out / run.folder
    if (folder / RECORD).is_file():
        prediction, estimate = read_prediction(folder), read_trajectory(folder)
    else:
        prediction, estimate = Prediction("not run", "the evaluation was stopped before"), read_trajectory(folder)
    return score(prediction, estimate, groundtruth, system=run.system, suite=suite, sequence=sequence, seed=run.seed)


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
    status, reason = prediction.status, prediction.reason
    frames = len(stamps)
    errors = Errors()
    if groundtruth is not None and frames:
        errors = all_errors(estimate, reference_for(groundtruth, stamps), suite, prediction.dark)
    metrics = errors.metrics
    completeness = prediction.tracked / frames if frames else math.nan

    def value(name: str) -> float:
        return math.nan if metrics is None else float(getattr(metrics, name))

    if status == "ok" and not completeness >= suite.lost_below:
        status, reason = "lost", f"{prediction.tracked} of {frames} frames have a pose"
    elif status == "ok" and metrics is not None and metrics.reason:
        reason = metrics.reason
        judged = getattr(metrics, sequence.judged_by, value("ate_percent"))
        if not math.isfinite(judged):
            status = "failed"
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
        rotation_error_ratio=value("rotation_error_ratio"),
        scale_drift=value("scale_drift"),
        t_rel=errors.kitti.t_rel,
        r_rel=errors.kitti.r_rel,
        kitti_longest_m=errors.kitti.longest_m,
        auc=_area(status, max(0.0, 1 - value("ate_rmse") / AUC_METRES)),
        pose_auc_1=_area(status, errors.pose_auc.get(1.0, math.nan)),
        pose_auc_2=_area(status, errors.pose_auc.get(2.0, math.nan)),
        pose_auc_5=_area(status, errors.pose_auc.get(5.0, math.nan)),
        pose_auc_10=_area(status, errors.pose_auc.get(10.0, math.nan)),
        ate_per_frame_scale=errors.per_frame_scale,
        ate_percent=value("ate_percent"),
        ate_rot_deg=errors.rotation,
        rpe_distance_m=errors.path.distance_m,
        rpe_distance_percent=errors.path.trans_percent,
        rpe_distance_deg=errors.path.rot_deg,
        rpe_trans_rmse=value("rpe_trans_rmse"),
        rpe_rot_deg_rmse=value("rpe_rot_deg_rmse"),
        path_length=value("path_length"),
        blackouts=errors.blackout.blackouts,
        segment_ate_percent=errors.blackout.segment_ate_percent,
        recovery_s=errors.blackout.recovery_s,
        threads=prediction.threads,
        parallel=prediction.parallel,
        device=prediction.device,
        reason=reason,
    )


@dataclass(frozen=True)
class Errors:
    """Everything that a trajectory and its reference give."""

    metrics: Metrics | None = None
    path: PathErrors = PathErrors()
    kitti: SegmentErrors = SegmentErrors()
    blackout: BlackoutErrors = BlackoutErrors()
    pose_auc: dict[float, float] = field(default_factory=dict)
    rotation: float = math.nan
    per_frame_scale: float = math.nan


def all_errors(estimate: Trajectory, reference: Trajectory, suite: Suite, dark: list[list[float]]) -> Errors:
    """Compare an estimate with the reference of the frames that were fed, under the protocol of a suite.

    Args:
        dark: stretches without light, see :func:`eval.scoring.blackout.dark_spans`.
    """
    align = suite.alignment
    pair = align_pair(estimate, reference, align, rpe_gap=suite.rpe_gap)
    rescaled = align_pair(per_frame_scale(estimate, reference), reference, align)
    return Errors(
        metrics=metrics_of(pair) if isinstance(pair, Aligned) else pair,
        path=path_errors(pair) if isinstance(pair, Aligned) else PathErrors(),
        kitti=kitti_errors(estimate, reference, pair.scale) if isinstance(pair, Aligned) else SegmentErrors(),
        blackout=blackout_errors(estimate, reference, [(begin, end) for begin, end in dark], align),
        pose_auc=relative_pose_auc(estimate, reference, suite.rpe_gap),
        rotation=absolute_rmse(pair, angle=True) if isinstance(pair, Aligned) else math.nan,
        per_frame_scale=absolute_rmse(rescaled) if isinstance(rescaled, Aligned) else math.nan,
    )


def _area(status: str, found: float) -> float:
    """An area under a recall curve: what a run did not do counts as not recalled; without data there is no curve."""
    if status in ("no data", "not run", "unavailable"):
        return math.nan
    return found if status == "ok" and math.isfinite(found) else 0.0


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
