"""Second half of an evaluation: compare trajectories with ground truth. Errors are evo's where evo has them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, make_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory, read_tum
from dvo.metrics.segment_metrics import most_worlds, worlds_of
from dvo.odometry.protocol import Segment
from eval.execution.plan import Manifest, Run, groundtruth_file, inertial_file
from eval.execution.predict import RECORD, Prediction, read_prediction, read_segments
from eval.execution.streamed import Streamed
from eval.scoring.blackout import dark_spans
from eval.scoring.errors import Errors, all_errors
from eval.scoring.inertial import InertialErrors, inertial_errors
from eval.scoring.loops import LoopErrors, loop_errors
from eval.scoring.metric_table import METRICS, Scored
from eval.suites.inertial import InertialTruth
from eval.suites.suite import Sequence as Recording
from eval.suites.suite import Suite, reference_for

_ABOUT = ("system", str), ("version", str), ("suite", str), ("sequence", str), ("seed", int), ("status", str)
_COUNTS = ("frames", int), ("tracked", int), ("alignment", str)
_MEASURED = ("threads", int), ("parallel", int), ("device", str), ("reason", str)
_FIRST = (
    "ate_rmse", "rpe_trans", "rpe_rot_deg", "completeness", "fps", "latency_p95_ms", "peak_memory_mb",
)  # fmt: skip
_REST = tuple(name for name in METRICS if name not in _FIRST)

_Columns: Any = make_dataclass(
    "_Columns",
    [
        *_ABOUT,
        *_COUNTS,
        *((name, float) for name in _FIRST),
        ("stride", int),
        ("resolution", str),
        *((name, float) for name in _REST),
        *_MEASURED,
    ],  # fmt: skip
    frozen=True,
)


class Row(_Columns):
    """One run in results.csv; fields are the columns, nan where a value has no meaning.

    Beside those of the run they are the metrics of :mod:`eval.scoring.metric_table`. ``threads``, ``parallel`` and
    ``device`` tell how the resources were measured; ``parallel`` above 1 means on a shared machine.
    """

    @property
    def failed(self) -> bool:
        """True unless the run has come to its end."""
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
    truths: dict[tuple[str, str], tuple[Trajectory | None, InertialTruth | None]] = {}
    rows = []
    for run in manifest.runs:
        place = run.suite, run.sequence
        if place not in truths:
            file = groundtruth_file(out, *place)
            samples = inertial_file(out, *place)
            truths[place] = (
                read_tum(file) if file.is_file() else None,
                InertialTruth.read(samples) if samples.is_file() else None,
            )
        rows.append(score_run(out, manifest, run, *truths[place]))
    return rows


def score_run(
    out: Path, manifest: Manifest, run: Run, groundtruth: Trajectory | None, inertial: InertialTruth | None = None
) -> Row:
    """One run of an evaluation as a row.

    An error while it is scored, for instance of the renderer that gives the truth about loops, makes this run a failed
    one, and costs no other.

    Args:
        out: folder of the evaluation.
        manifest: of the evaluation.
        run: to score.
        groundtruth: of the whole sequence; None where there are no data.
        inertial: truth about its inertial samples; None without any.
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
        return row(prediction, segments, groundtruth, streamed=Streamed.read(folder), inertial=inertial)
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
    streamed: Streamed | None = None,
    inertial: InertialTruth | None = None,
) -> Row:
    """One row of the table. A run that failed is a row too.

    A run is lost if it has poses for less than :attr:`Suite.lost_below` of the frames, or for less than that in the
    segments that are scored (:mod:`eval.scoring.errors`).

    Args:
        prediction: record of the run.
        segments: of its trajectory.
        groundtruth: of the whole sequence; None where the data are not there.
        streamed: estimates as they came; None where they were not kept.
        inertial: truth about the inertial samples; None without any.
    """
    stamps = np.array(prediction.stamps, dtype=np.float64)
    status, reason = prediction.status, prediction.reason
    frames = len(stamps)
    errors, reference = Errors(), None
    if groundtruth is not None and frames:
        reference = reference_for(groundtruth, stamps)
        unseen = np.isin(stamps, prediction.unseen)
        most = most_worlds(frames, len(dark_spans(stamps, unseen)))
        errors = all_errors(segments, reference, suite, prediction.dark, most)
    ran = prediction.status == "ok"
    loops = loop_errors(prediction.info, sequence, prediction.stamps, prediction.unseen) if ran else LoopErrors()
    metrics = errors.metrics
    completeness = prediction.tracked / frames if frames else math.nan
    scored = completeness if math.isnan(errors.scored) else completeness * errors.scored
    if status == "ok" and not completeness >= suite.lost_below:
        status, reason = "lost", f"{prediction.tracked} of {frames} frames have a pose"
    elif status == "ok" and not scored >= suite.lost_below and metrics is not None:
        status, reason = "lost", metrics.reason or "too little of it is scored"
    elif status == "ok" and metrics is not None and metrics.reason:
        reason = metrics.reason
        judged = getattr(metrics, sequence.judged_by, metrics.ate_percent)
        if not math.isfinite(judged):
            status = "failed"
    run = Scored(
        prediction, segments, reference, suite, errors, loops, len(worlds_of(segments)), completeness, scored, status,
        InertialErrors() if inertial is None or reference is None or not ran
        else inertial_errors(streamed, segments, reference, inertial, prediction.dark, prediction.unseen),
    )  # fmt: skip
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
        stride=suite.stride,
        resolution=prediction.resolution,
        threads=prediction.threads,
        parallel=prediction.parallel,
        device=prediction.device,
        reason=reason,
        **{name: metric.find(run) for name, metric in METRICS.items()},
    )
