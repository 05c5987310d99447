"""Scores of a tracker on interrupted sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import associate, evaluate
from dvo.odometry.protocol import Estimate, Result, Status
from eval.benchmarks.interruptions.trials import Clip, Trial

SCORED = 10
"""Least number of rows of a segment whose error is compared."""


@dataclass(frozen=True)
class Score:
    """Score of one trial.

    Attributes:
        clip, kind, seed: of the trial.
        duration: of the interruption, frames (of a gap: 0).
        dark: frames without a view.
        false_poses: of these, frames with the status ``tracking``, or with a row in the result.
        good: frames with a view.
        posed: of these, frames with a row in any segment.
        recovery: good frames after the interruption up to the first with the status ``tracking``, that one included;
            None if there is none.
        told: the interruption appears among the breaks of the result.
        segments: number of segments.
        scale: ratio of the scales before and after the interruption within a segment that contains both; None if no
            segment does.
        moved: distance between the poses of frozen frames, in path lengths of the segment (``frozen`` only).
        error, error_without: ATE of the rows of all scored segments, each aligned on its own, and of the same frames
            tracked without the interruption, aligned over the same parts; metres.
    """

    clip: str
    kind: str
    seed: int
    duration: int
    dark: int
    false_poses: int
    good: int
    posed: int
    recovery: int | None
    told: bool
    segments: int
    scale: float | None
    moved: float
    error: float
    error_without: float


def score(trial: Trial, clip: Clip, estimates: Sequence[Estimate], result: Result, whole: Trajectory) -> Score:
    """Score a trial.

    Args:
        trial: interrupted sequence.
        clip: that it was made from, with the ground truth.
        estimates: of its frames.
        result: of the tracker.
        whole: trajectory of the clip tracked without an interruption.

    Returns:
        The score.
    """
    times = np.array([frame.timestamp for frame in trial.frames])
    rows = np.isin(times, np.concatenate([[], *[part.trajectory.timestamps for part in result.segments]]))
    tracking = np.array([estimate.status is Status.TRACKING for estimate in estimates])
    after = np.flatnonzero(tracking[trial.resumes :])
    # Frames of the clip by position in the trial: the interruption replaces or inserts frames.
    kept = np.flatnonzero(trial.good)
    source = np.array([trial.source[k] for k in kept])
    truth = Trajectory(times[kept], clip.groundtruth.poses_wc[source])
    without = Trajectory(times[kept], _rows_at(whole, clip, source))
    errors, others = [], []
    for part in result.segments:
        inside = np.isin(truth.timestamps, part.trajectory.timestamps)
        if inside.sum() < SCORED:
            continue
        reference = Trajectory(truth.timestamps[inside], truth.poses_wc[inside])
        errors.append((int(inside.sum()), evaluate(part.trajectory, reference).ate_rmse))
        unbroken = Trajectory(without.timestamps[inside], without.poses_wc[inside])
        others.append((int(inside.sum()), evaluate(unbroken, reference).ate_rmse))
    return Score(
        clip=trial.clip,
        kind=trial.kind,
        seed=trial.seed,
        duration=trial.duration,
        dark=int(trial.without_view.sum()),
        false_poses=int((trial.without_view & (tracking | rows)).sum()),
        good=int(trial.good.sum()),
        posed=int((trial.good & rows).sum()),
        recovery=int(after[0]) + 1 if len(after) else None,
        told=_told(trial, times, result),
        segments=len(result.segments),
        scale=_scale_change(trial, times, result, truth),
        moved=_moved(trial, times, result),
        error=_together(errors),
        error_without=_together(others),
    )


def _rows_at(whole: Trajectory, clip: Clip, source: np.ndarray) -> np.ndarray:
    """Poses of frames of the clip; nan where the clip was not tracked."""
    wanted = np.array([clip.frames[k].timestamp for k in source])
    poses = np.full((len(source), 7), np.nan)
    position = np.searchsorted(whole.timestamps, wanted).clip(max=max(len(whole) - 1, 0))
    if len(whole):
        same = whole.timestamps[position] == wanted
        poses[same] = whole.poses_wc[position[same]]
    return poses


def _together(errors: list[tuple[int, float]]) -> float:
    """Root of the mean square over the rows of all segments."""
    counts = sum(count for count, _ in errors)
    return float(np.sqrt(sum(count * error**2 for count, error in errors) / counts)) if counts else float("nan")


def _told(trial: Trial, times: np.ndarray, result: Result) -> bool:
    """A break of the result begins and ends around the interruption."""
    last, first = times[trial.cut - 1], times[trial.resumes]
    return any(
        (gap.start is None or gap.start <= first) and (gap.end is None or gap.end >= last) for gap in result.breaks
    )


def _scale_change(trial: Trial, times: np.ndarray, result: Result, truth: Trajectory) -> float | None:
    last, first = times[trial.cut - 1], times[trial.resumes]
    for part in result.segments:
        found = []
        for side in (part.trajectory.timestamps <= last, part.trajectory.timestamps >= first):
            rows = Trajectory(part.trajectory.timestamps[side], part.trajectory.poses_wc[side])
            if len(associate(rows, truth)[0]) >= SCORED:
                found.append(evaluate(rows, truth).scale)
        if len(found) == 2:
            return found[1] / found[0]
    return None


def _moved(trial: Trial, times: np.ndarray, result: Result) -> float:
    if trial.kind != "frozen":
        return 0.0
    frozen = times[trial.cut - 1 : trial.resumes]
    for part in result.segments:
        rows = part.trajectory.poses_wc[np.isin(part.trajectory.timestamps, frozen)][:, :3]
        if len(rows) > 1:
            length = np.linalg.norm(np.diff(part.trajectory.poses_wc[:, :3], axis=0), axis=1).sum()
            return float(np.linalg.norm(rows - rows[0], axis=1).max() / max(length, 1e-12))
    return float("nan")
