"""Second half of an evaluation: compare trajectories with ground truth. Errors are evo's where evo has them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np

from dvo.data.trajectory import Trajectory, read_tum
from dvo.metrics.segment_metrics import most_worlds, worlds_of
from dvo.odometry.protocol import Segment
from eval.execution.plan import Manifest, Run, groundtruth_file
from eval.execution.predict import RECORD, Prediction, read_prediction, read_segments
from eval.scoring.blackout import dark_spans
from eval.scoring.errors import Errors, all_errors
from eval.scoring.loops import LoopErrors, loop_errors
from eval.suites.suite import Sequence as Recording
from eval.suites.suite import Suite, reference_for

SAME_FRAME = 1e-4  # seconds between the stamps of a frame and of its pose
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
        segments: number of segments of the trajectory, those that share a world counted once.
        scored: share of the frames fed that have a pose in a segment that counts for the ATE.
        unseen: number of frames without a view, see :func:`eval.scoring.blackout.without_view`.
        made_up: share of them that carry a pose; nan without such a frame.
        scale_error: percent by which the scale of the longest segment is wrong, with the alignment SE(3).
        ate_sim3_percent: of the path, after a Sim(3) alignment where that of the suite is SE(3).
        loops, false_loops, revisit_s, loop_recall: see :class:`eval.scoring.loops.LoopErrors`.
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
    segments: int
    scored: float
    unseen: int
    made_up: float
    loops: float
    false_loops: float
    revisit_s: float
    loop_recall: float
    scale_error: float
    ate_sim3_percent: float
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

    An error while it is scored, for instance of the renderer that gives the truth about loops, makes this run a failed
    one, and costs no other.

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
        prediction, segments = read_prediction(folder), read_segments(folder)
    else:
        prediction, segments = Prediction("not run", "the evaluation was stopped before"), ()
    row = partial(score, system=run.system, suite=suite, sequence=sequence, seed=run.seed)
    try:
        return row(prediction, segments, groundtruth)
    except Exception as error:
        message = f"scoring ended by {type(error).__name__}: {' '.join(str(error).split())[:300]}"
        return row(replace(prediction, status="failed", reason=message), (), None)


def score(
    prediction: Prediction,
    segments: Sequence[Segment],
    groundtruth: Trajectory | None,
    *,
    system: str,
    suite: Suite,
    sequence: Recording,
    seed: int,
) -> Row:
    """One row of the table. A run that failed is a row too.

    A run is lost if it has poses for less than :attr:`Suite.lost_below` of the frames, or for less than that in the
    segments that are scored (:mod:`eval.scoring.errors`).

    Args:
        prediction: record of the run.
        segments: of its trajectory.
        groundtruth: of the whole sequence; None where the data are not there.
    """
    stamps = np.array(prediction.stamps, dtype=np.float64)
    status, reason = prediction.status, prediction.reason
    frames = len(stamps)
    errors = Errors()
    if groundtruth is not None and frames:
        unseen = np.isin(stamps, prediction.unseen)
        most = most_worlds(frames, len(dark_spans(stamps, unseen)))
        errors = all_errors(segments, reference_for(groundtruth, stamps), suite, prediction.dark, most)
    ran = prediction.status == "ok"
    loops = loop_errors(prediction.info, sequence, prediction.stamps, prediction.unseen) if ran else LoopErrors()
    metrics = errors.metrics
    completeness = prediction.tracked / frames if frames else math.nan
    scored = completeness if math.isnan(errors.scored) else completeness * errors.scored

    def value(name: str) -> float:
        return math.nan if metrics is None else float(getattr(metrics, name))

    if status == "ok" and not completeness >= suite.lost_below:
        status, reason = "lost", f"{prediction.tracked} of {frames} frames have a pose"
    elif status == "ok" and not scored >= suite.lost_below and metrics is not None:
        status, reason = "lost", metrics.reason or "too little of it is scored"
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
        segments=len(worlds_of(segments)),
        scored=scored,
        unseen=len(prediction.unseen),
        made_up=made_up_share(prediction.unseen, segments) if prediction.status == "ok" else math.nan,
        loops=loops.loops,
        false_loops=loops.false,
        revisit_s=loops.revisit_s,
        loop_recall=loops.recall,
        scale_error=errors.scale_error,
        ate_sim3_percent=100 * errors.shape / value("path_length") if value("path_length") > 0 else math.nan,
        threads=prediction.threads,
        parallel=prediction.parallel,
        device=prediction.device,
        reason=reason,
    )


def made_up_share(unseen: Sequence[float], segments: Sequence[Segment]) -> float:
    """Share of the frames without a view that carry a pose; nan without such a frame.

    Args:
        unseen: timestamps of the frames without a view, seconds.
        segments: of the run.
    """
    if not unseen:
        return math.nan
    stamps = np.concatenate([np.zeros(0), *(segment.trajectory.timestamps for segment in segments)])
    return sum(bool((np.abs(stamps - stamp) < SAME_FRAME).any()) for stamp in unseen) / len(unseen)


def _area(status: str, found: float) -> float:
    """An area under a recall curve: what a run did not do counts as not recalled; without data there is no curve."""
    if status in ("no data", "not run", "unavailable"):
        return math.nan
    return found if status == "ok" and math.isfinite(found) else 0.0


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
