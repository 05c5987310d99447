"""The metrics of an evaluation, one row each: columns of results.csv, of the tables, and what sequences are judged by.

A metric of another package is a row too: a :class:`dvo.metrics.table.Metric` whose ``find`` takes a :class:`Scored`,
announced by an entry point of the group ``dvo.metrics``. It gets a column in results.csv and in the tables, and
sequences can be judged by it::

    from dvo.metrics.table import Metric

    END_ERROR = Metric("end_error", "end error m", "m", 3, lambda run: end_error(run.segments, run.reference))
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.data.trajectory import Trajectory
from dvo.metrics.table import ERRORS, Metric
from dvo.odometry.protocol import Segment

if TYPE_CHECKING:  # these know the suites, which know the metrics that sequences are judged by
    from eval.execution.predict import Prediction
    from eval.scoring.errors import Errors
    from eval.scoring.inertial import InertialErrors
    from eval.scoring.loops import LoopErrors
    from eval.suites.suite import Suite

SAME_FRAME = 1e-4  # seconds between the stamps of a frame and of its pose
AUC_METRES = 1.0  # DPVO's "AUC" of a run is max(0, 1 - ATE / 1 m); a table's is the mean over runs, failed ones 0
WRONG = 2.0  # percent of the path: an ATE that a verdict has to tell
NEVER_MADE = ("no data", "not run", "unavailable")
"""States of runs that were never made."""


@dataclass(frozen=True)
class Scored:
    """What is known of a run when its metrics are taken.

    Attributes:
        prediction: record of the run.
        segments: of its trajectory.
        reference: ground truth of the frames that were fed, camera to world; None where the data are not there.
        suite: protocol of the comparison.
        errors: of the trajectory, under that protocol.
        loops: errors of the loops.
        worlds: number of segments, those that share a world counted once.
        completeness: share of the frames that have a pose.
        scored: share of the frames that have a pose in a segment that counts for the ATE.
        status: ``ok``, or how the run failed.
        inertial: errors of metric poses; all nan without inertial samples.
    """

    prediction: Prediction
    segments: Sequence[Segment]
    reference: Trajectory | None
    suite: Suite
    errors: Errors
    loops: LoopErrors
    worlds: int
    completeness: float
    scored: float
    status: str
    inertial: InertialErrors

    def area(self, found: float) -> float:
        """Area under a recall curve: what a run did not do counts as not recalled; without data there is no curve.

        Args:
            found: in [0, 1], of a run that did not fail.
        """
        if self.status in NEVER_MADE:
            return math.nan
        return found if self.status == "ok" and math.isfinite(found) else 0.0


def false_pose_share(unseen: Sequence[float], segments: Sequence[Segment]) -> float:
    """Share of the frames without a view that carry a pose; nan without such a frame.

    Args:
        unseen: timestamps of the frames without a view, seconds.
        segments: of the run.
    """
    if not unseen:
        return math.nan
    stamps = np.concatenate([np.zeros(0), *(segment.trajectory.timestamps for segment in segments)])
    return sum(bool((np.abs(stamps - stamp) < SAME_FRAME).any()) for stamp in unseen) / len(unseen)


def _of_errors(metric: Metric) -> Metric:
    """Row for one of :data:`dvo.metrics.table.ERRORS`."""

    def find(run: Scored) -> float:
        return math.nan if run.errors.metrics is None else metric.find(run.errors.metrics)

    return replace(metric, find=find)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _pose_auc(degrees: float) -> Callable[[Scored], float]:
    return lambda run: run.area(run.errors.pose_auc.get(degrees, math.nan))


def _auc(run: Scored) -> float:
    found = run.errors.metrics
    return run.area(max(0.0, 1 - (math.nan if found is None else found.ate_rmse) / AUC_METRES))


def _shape_percent(run: Scored) -> float:
    path = math.nan if run.errors.metrics is None else run.errors.metrics.path_length
    return 100 * run.errors.shape / path if path > 0 else math.nan


def _false_poses(run: Scored) -> float:
    return false_pose_share(run.prediction.unseen, run.segments) if run.prediction.status == "ok" else math.nan


def _doubted(run: Scored) -> float:
    return float(run.prediction.verdict != "good") if run.prediction.verdict else math.nan


def _silent(run: Scored) -> float:
    found, shape = run.errors.metrics, _shape_percent(run)  # a verdict tells nothing of metres
    error = shape if math.isfinite(shape) or found is None else found.ate_percent
    if run.prediction.verdict != "good":
        return 0.0 if run.prediction.verdict else math.nan
    return math.nan if math.isnan(error) else float(error > WRONG)


def _inertial(name: str) -> Callable[[Scored], float]:
    """Value of an attribute of :class:`eval.scoring.inertial.InertialErrors`."""
    return lambda run: float(getattr(run.inertial, name))


_OWN = (
    Metric("completeness", "complete %", "%", 0, lambda run: run.completeness, "high", 100.0),
    Metric("fps", "frames/s", "1/s", 1, lambda run: _number(run.prediction.fps), "high"),
    Metric("latency_p95_ms", "p95 ms", "ms", 0, lambda run: _number(run.prediction.latency_p95_ms)),
    Metric("peak_memory_mb", "MB", "MB", 0, lambda run: _number(run.prediction.peak_memory_mb)),
    # Mean translation and rotation error of KITTI over 100 m to 800 m, and the longest of these that the path has.
    Metric("t_rel", "t_rel %", "%", 2, lambda run: run.errors.kitti.t_rel),
    Metric("r_rel", "r_rel °/100 m", "°/100 m", 2, lambda run: run.errors.kitti.r_rel),
    Metric("kitti_longest_m", "longest m", "m", 0, lambda run: run.errors.kitti.longest_m, ""),
    Metric("auc", "ATE AUC", "", 2, _auc, "high", over_runs="mean"),
    # See eval.scoring.protocols.relative_pose_auc.
    Metric("pose_auc_1", "pose AUC 1°", "", 2, _pose_auc(1.0), "high", over_runs="mean"),
    Metric("pose_auc_2", "2°", "", 2, _pose_auc(2.0), "high", over_runs="mean"),
    Metric("pose_auc_5", "5°", "", 2, _pose_auc(5.0), "high", over_runs="mean"),
    Metric("pose_auc_10", "10°", "", 2, _pose_auc(10.0), "high", over_runs="mean"),
    # Every step given the true length first; not comparable with an ordinary ATE.
    Metric("ate_per_frame_scale", "ATE m, true scale per frame", "m", 3, lambda run: run.errors.per_frame_scale),
    # Root mean square angle to the truth after the alignment.
    Metric("ate_rot_deg", "ATE °", "°", 2, lambda run: run.errors.rotation),
    # See eval.scoring.metrics.PathErrors.
    Metric("rpe_distance_m", "RPE distance m", "m", 2, lambda run: run.errors.path.distance_m, ""),
    Metric("rpe_distance_percent", "RPE per distance %", "%", 1, lambda run: run.errors.path.trans_percent),
    Metric("rpe_distance_deg", "RPE per distance °", "°", 2, lambda run: run.errors.path.rot_deg),
    # See eval.scoring.blackout.BlackoutErrors.
    Metric("blackouts", "blackouts", "", 0, lambda run: run.errors.blackout.blackouts, ""),
    Metric("segment_ate_percent", "segment ATE %", "%", 2, lambda run: run.errors.blackout.segment_ate_percent),
    Metric("recovery_s", "recovery s", "s", 1, lambda run: run.errors.blackout.recovery_s),
    Metric("segments", "segments", "", 0, lambda run: run.worlds, ""),
    Metric("scored", "scored %", "%", 0, lambda run: run.scored, "high", 100.0),
    # Frames without a view (eval.scoring.blackout.without_view), and the share of them that carries a pose.
    Metric("unseen", "frames without a view", "", 0, lambda run: len(run.prediction.unseen), ""),
    Metric("false_poses", "false poses %", "%", 0, _false_poses, "low", 100.0),
    # Whether the verdict of the system is not good; whether it is good and the ATE above WRONG.
    Metric("doubted", "doubted %", "%", 0, _doubted, "", 100.0, "mean"),
    Metric("silent", "wrong, called good %", "%", 0, _silent, "low", 100.0, "mean"),
    # See eval.scoring.loops.LoopErrors.
    Metric("loops", "loops", "", 0, lambda run: run.loops.loops, ""),
    Metric("false_loops", "false loops", "", 0, lambda run: run.loops.false),
    Metric("revisit_s", "revisit s", "s", 1, lambda run: run.loops.revisit_s, ""),
    Metric("loop_recall", "loop recall", "", 2, lambda run: run.loops.recall, "high"),
    # Percent by which the scale of the longest world is wrong, and the ATE without that error, under SE(3).
    Metric("scale_error", "scale error %", "%", 2, lambda run: run.errors.scale_error),
    Metric("ate_sim3_percent", "ATE %, Sim(3)", "%", 2, _shape_percent),
    # See eval.scoring.inertial.InertialErrors.
    Metric("scale_10s", "scale error at 10 s %", "%", 2, _inertial("scale_10s")),
    Metric("gravity_deg", "gravity °", "°", 2, _inertial("gravity_deg")),
    Metric("align_s", "s to alignment", "s", 1, _inertial("align_s")),
    Metric("coverage", "coverage %", "%", 0, _inertial("coverage"), "high", 100.0),
    Metric("nees_position", "NEES position", "", 2, _inertial("nees_position"), ""),
    Metric("nees_orientation", "NEES orientation", "", 2, _inertial("nees_orientation"), ""),
    Metric("nees_velocity", "NEES velocity", "", 2, _inertial("nees_velocity"), ""),
    Metric("gyro_bias_error", "gyro bias °/s", "°/s", 3, _inertial("gyro_bias_error")),
    Metric("accel_bias_error", "accel bias m/s²", "m/s²", 3, _inertial("accel_bias_error")),
    Metric("offset_error_ms", "time offset ms", "ms", 2, _inertial("offset_error_ms")),
    Metric("wrong_alignments", "wrong alignments", "", 0, _inertial("wrong_alignments")),
    Metric("dark_tracked", "tracked in the dark", "", 0, _inertial("dark_tracked")),
    Metric("dark_cm", "dark cm", "cm", 1, _inertial("dark_cm")),
    Metric("dark_percent", "dark %", "%", 2, _inertial("dark_percent")),
    Metric("dark_sigmas", "dark σ", "", 1, _inertial("dark_sigmas"), ""),
)

FOREIGN = Registry("metric", "dvo.metrics")
"""Metrics of other packages."""


def all_metrics(foreign: Registry) -> dict[str, Metric]:
    """Metrics of the package, and those of others after them.

    Args:
        foreign: those of others.

    Returns:
        All by name.

    Raises:
        DvoError: one of another package has the name of another, or is announced by a name that is not its own.
    """
    found = {metric.name: metric for metric in (*map(_of_errors, ERRORS), *_OWN)}
    for name in foreign:
        metric = foreign.resolve(name)
        if metric.name != name or name in found:
            fault = "a metric of dvo has this name" if name in found else f"the metric calls itself {metric.name}"
            raise DvoError(fault, field=f"entry point {name}", remedy="give both one name of their own")
        found[name] = metric
    return found


METRICS = all_metrics(FOREIGN)
"""All by name."""


def columns(*names: str) -> tuple[Metric, ...]:
    """Rows by their names.

    Args:
        names: of metrics.
    """
    return tuple(METRICS[name] for name in names)


FIGURES = columns(
    "ate_percent", "ate_rmse", "rpe_trans", "rpe_rot_deg", "rotation_error_ratio", "scale_drift", *FOREIGN
)
"""Of every table."""
SCALE = columns("scale_error", "ate_sim3_percent")
"""Where the alignment leaves the scale to the systems."""
INERTIAL = columns(
    "scale_10s", "gravity_deg", "align_s", "coverage", "nees_position", "nees_orientation", "nees_velocity",
    "gyro_bias_error", "accel_bias_error", "offset_error_ms", "wrong_alignments",
)  # fmt: skip
"""Where frames carry inertial samples whose truth is known."""
DARK = columns("dark_tracked", "dark_cm", "dark_percent", "dark_sigmas")
"""Where such a sequence goes dark."""
RECOVERY = columns("recovery_s")
"""Where sequences are judged by it."""
JUDGES = tuple(metric.name for metric in (*FIGURES, *RECOVERY) if metric.better == "low")
"""Names of those that can decide between systems; that of a failed run is infinite."""
BLACKOUT = columns("segment_ate_percent", "recovery_s")
"""Where images are dark."""
SEGMENTS = columns("segments", "scored")
"""Where a run has several segments."""
FALSE_POSES = columns("false_poses")
"""Where there are frames without a view."""
VERDICTS = columns("doubted", "silent")
"""Where a verdict is not good, or should not be."""
RESOURCES = columns("fps", "latency_p95_ms", "peak_memory_mb")
"""Which failed runs have too."""
OVERALL = columns(
    "completeness", "rotation_error_ratio", "scale_drift", "auc", "pose_auc_1", "pose_auc_2", "pose_auc_5",
    "pose_auc_10", "rpe_distance_percent", "t_rel", "r_rel", "ate_per_frame_scale",
)  # fmt: skip
"""Of the table of systems over all their runs."""
