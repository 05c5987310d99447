"""Errors of metric poses from inertial samples: scale, gravity, alignment, motion in the dark, and consistency.

Definitions:

- The scale at a time is the median, weighted by length, of the ratios of estimated to true displacements of streamed
  poses over :data:`SPAN` seconds in one segment, whose middle lies in the :data:`WINDOW` seconds about it. It is not
  defined where the camera moves less than :data:`LEAST` metres in all; one re-expression of the world leaves it right.
- The time to alignment runs from the first frame, or from the end of a degenerate stretch in which the sequence begins,
  to the first time from which the scale stays within :data:`SCALE_PERCENT` percent, whatever the system says of itself.
- NEES (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 5.4.2) is
  ``e^T P^-1 e`` over its dimension, mean over the frames with a covariance, 1 if consistent. Yaw and position of the
  pose at the alignment are taken as right, as they cannot be observed; also after segments that share its world.
- An alignment is wrong if the scale of the poses that follow it, as long as the system calls them aligned, is off by
  :data:`WRONG_PERCENT` percent in the median of any :data:`JUDGED` seconds with motion, or gravity by
  :data:`WRONG_DEGREES` degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import quaternion_to_matrix
from dvo.metrics import associate
from dvo.metrics.segment_metrics import worlds_of
from dvo.odometry.protocol import Segment
from eval.execution.streamed import Streamed
from eval.suites.inertial import InertialTruth

SPAN, WINDOW, LEAST = 0.5, 2.0, 0.2
SCALE_PERCENT = 5.0
WRONG_PERCENT, WRONG_DEGREES, JUDGED = 10.0, 5.0, 5.0
SAME_FRAME = 1e-4  # seconds
_ALIGNED = ("aligned", "refined")


@dataclass(frozen=True)
class InertialErrors:
    """Errors of a run on a sequence with inertial samples; nan where a value has no meaning, or was not given.

    Attributes:
        scale_10s: percent by which the scale is wrong in the five seconds from ten seconds after the start (as of the
            time to alignment).
        gravity_deg: angle between the vertical of the world of most rows and the true one, in the mean of all its rows,
            degrees; of a system that never says that it is aligned there is none.
        align_s: seconds to alignment; inf if the scale does not stay right.
        coverage: share of the frames with a streamed pose.
        nees_position, nees_orientation, nees_velocity: see the module.
        gyro_bias_error, accel_bias_error: of the last estimate, degrees/s and m/s^2.
        offset_error_ms: of the last estimate of the time offset.
        wrong_alignments: number; nan of systems that do not tell of alignments.
        dark_tracked: frames without a view whose status is ``tracking``.
        dark_cm, dark_percent: error of the streamed position on the last dark frame relative to the last lit one, whose
            yaw and position are taken as right, in centimetres and in percent of the way between; mean over the
            stretches of dark, inf where there is no pose.
        dark_sigmas: that error over the root of the trace of the covariance of the position; mean.
    """

    scale_10s: float = math.nan
    gravity_deg: float = math.nan
    align_s: float = math.nan
    coverage: float = math.nan
    nees_position: float = math.nan
    nees_orientation: float = math.nan
    nees_velocity: float = math.nan
    gyro_bias_error: float = math.nan
    accel_bias_error: float = math.nan
    offset_error_ms: float = math.nan
    wrong_alignments: float = math.nan
    dark_tracked: float = math.nan
    dark_cm: float = math.nan
    dark_percent: float = math.nan
    dark_sigmas: float = math.nan


@dataclass(frozen=True)
class Pairs:
    """Displacements over :data:`SPAN` seconds: time of their middle, estimated over true length, true length; and the
    time between those of neighbouring frames, seconds."""

    times: np.ndarray
    ratios: np.ndarray
    lengths: np.ndarray
    spacing: float

    def scale(self, begin: float, end: float) -> float:
        """Scale over displacements whose middle lies in an interval, nan with too little motion.

        Args:
            begin, end: seconds.
        """
        inside = (self.times >= begin) & (self.times < end)
        lengths, ratios = self.lengths[inside], self.ratios[inside]
        # Displacements overlap: their sum counts a way as often as there are of them in a span.
        if lengths.sum() * self.spacing / SPAN < LEAST:
            return math.nan
        order = np.argsort(ratios)
        share = np.cumsum(lengths[order])
        return float(ratios[order][np.searchsorted(share, share[-1] / 2)])


def inertial_errors(
    streamed: Streamed | None,
    segments: Sequence[Segment],
    reference: Trajectory,
    truth: InertialTruth,
    dark: Sequence[Sequence[float]] = (),
    unseen: Sequence[float] = (),
) -> InertialErrors:
    """Compare a run with the truth.

    Args:
        streamed: estimates as they came; None where they were not kept.
        segments: of the result.
        reference: camera to world at the times of the frames, metres, z up.
        truth: about the inertial samples.
        dark: first and last stamp of each stretch of dark, seconds.
        unseen: stamps of frames without a view, apart from these.
    """
    if streamed is None or not len(streamed):
        return InertialErrors(gravity_deg=_final_tilt(segments, reference))
    told = ~np.isin(streamed.scale_state, ("", "none"))
    aligned = np.isin(streamed.scale_state, _ALIGNED)
    run = _Run.of(streamed, reference, truth)
    origin = _origin(streamed, truth)
    pairs = run.pairs()
    spent = np.isin(np.round(streamed.timestamps / SAME_FRAME), np.round(np.array(unseen) / SAME_FRAME))
    for begin, end in dark:
        spent |= (streamed.timestamps > begin - SAME_FRAME) & (streamed.timestamps < end + SAME_FRAME)
    tracked = streamed.status == "tracking"
    metric = aligned | np.isfinite(streamed.covariance).all(axis=(1, 2))  # also where the scale is in doubt for now
    position, orientation, velocity = run.nees(metric, _worlds(streamed, segments))
    dark_cm, dark_percent, dark_sigmas = run.in_the_dark(dark)
    return InertialErrors(
        scale_10s=100 * abs(pairs.scale(origin + 10, origin + 15) - 1),
        gravity_deg=math.nan if told.any() and not aligned.any() else _final_tilt(segments, reference),
        align_s=_time_to_alignment(pairs, origin, streamed.timestamps),
        coverage=float(np.isfinite(streamed.poses_wc).all(axis=1).mean()),
        nees_position=position,
        nees_orientation=orientation,
        nees_velocity=velocity,
        gyro_bias_error=math.degrees(_last_error(streamed.gyro_bias, run.gyro_bias)),
        accel_bias_error=_last_error(streamed.accel_bias, run.accel_bias),
        offset_error_ms=1000 * _last_error(streamed.time_offset[:, None], np.full((len(streamed), 1), truth.offset)),
        wrong_alignments=run.wrong_alignments(aligned, pairs) if told.any() else math.nan,
        dark_tracked=float((spent & tracked).sum()) if spent.any() else math.nan,
        dark_cm=dark_cm,
        dark_percent=dark_percent,
        dark_sigmas=dark_sigmas,
    )


@dataclass(frozen=True)
class _Run:
    """Streamed estimates with the truth at their times; ``(N, ...)``, nan without truth or pose."""

    streamed: Streamed
    rotation: np.ndarray
    position: np.ndarray
    true_rotation: np.ndarray
    true_position: np.ndarray
    true_velocity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray

    @classmethod
    def of(cls, streamed: Streamed, reference: Trajectory, truth: InertialTruth) -> _Run:
        """Put the truth beside the estimates."""
        poses = _at(streamed.timestamps, reference.timestamps, reference.poses_wc)
        others = [
            _at(streamed.timestamps, truth.timestamps, values)
            for values in (truth.velocity_w, truth.gyro_bias, truth.accel_bias)
        ]
        estimated = streamed.poses_wc
        return cls(
            streamed,
            quaternion_to_matrix(estimated[:, 3:]),
            estimated[:, :3],
            quaternion_to_matrix(poses[:, 3:]),
            poses[:, :3],
            *others,
        )

    def pairs(self) -> Pairs:
        """Displacements over :data:`SPAN` seconds within a segment."""
        times, segment = self.streamed.timestamps, self.streamed.segment
        later = np.searchsorted(times, times + SPAN - SAME_FRAME)
        first = np.flatnonzero(later < len(times))
        last = later[first]
        true = np.linalg.norm(self.true_position[last] - self.true_position[first], axis=1)
        found = np.linalg.norm(self.position[last] - self.position[first], axis=1)
        keep = np.isfinite(true) & np.isfinite(found) & (true > 0.02) & (segment[first] == segment[last])
        keep &= times[last] - times[first] < 1.5 * SPAN
        first, last, true, found = first[keep], last[keep], true[keep], found[keep]
        spacing = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        return Pairs((times[first] + times[last]) / 2, found / true, true, spacing)

    def gauge(self, at: int) -> tuple[np.ndarray, np.ndarray]:
        """Turn about the vertical ``(3, 3)`` and shift ``(3,)`` that put the pose of a frame where it is in truth."""
        turn = self.true_rotation[at] @ self.rotation[at].T
        yaw = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        upright = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1.0]])
        return upright, self.true_position[at] - upright @ self.position[at]

    def nees(self, metric: np.ndarray, worlds: np.ndarray) -> tuple[float, float, float]:
        """Of position, orientation and velocity, over the frames in metres with a covariance; worlds ``(N,)``."""
        found: list[list[float]] = [[], [], []]
        for begin, end in _stretches_of(metric, worlds):
            if not (np.isfinite(self.position[begin]).all() and np.isfinite(self.true_position[begin]).all()):
                continue
            upright, shift = self.gauge(begin)
            for k in range(begin + 1, end):
                covariance = self.streamed.covariance[k]
                if not (np.isfinite(covariance).all() and np.isfinite(self.rotation[k] @ self.true_rotation[k]).all()):
                    continue
                errors = (
                    upright.T @ (self.true_position[k] - shift) - self.position[k],
                    _logarithm(self.rotation[k].T @ upright.T @ self.true_rotation[k]),
                    upright.T @ self.true_velocity[k] - self.streamed.velocity_w[k],
                )
                for number, error in enumerate(errors):
                    part = covariance[3 * number : 3 * number + 3, 3 * number : 3 * number + 3]
                    if np.isfinite(error).all() and np.linalg.eigvalsh(part)[0] > 0:
                        found[number].append(float(error @ np.linalg.solve(part, error)) / 3)
        position, orientation, velocity = (float(np.mean(values)) if values else math.nan for values in found)
        return position, orientation, velocity

    def wrong_alignments(self, aligned: np.ndarray, pairs: Pairs) -> int:
        """Number of alignments that were wrong."""
        times, wrong = self.streamed.timestamps, 0
        for begin, end in _stretches_of(aligned, self.streamed.segment):
            since, until = times[begin] + SPAN / 2, times[end - 1] - SPAN / 2  # displacements within the stretch
            windows = np.arange(since, max(until - JUDGED, since) + 1e-9, 1.0)
            scales = (pairs.scale(start, min(start + JUDGED, until)) for start in windows)
            off = max((abs(value - 1) for value in scales if math.isfinite(value)), default=0.0)
            tilt = _tilt(self.true_rotation[begin:end], self.rotation[begin:end])
            wrong += off > WRONG_PERCENT / 100 or tilt > WRONG_DEGREES
        return wrong

    def in_the_dark(self, spans: Sequence[Sequence[float]]) -> tuple[float, float, float]:
        """Error on the last dark frames: cm, percent of the way, and its own standard deviations."""
        times = self.streamed.timestamps
        rows = []
        for begin, end in spans:
            lit, last = (int(np.searchsorted(times, stamp - SAME_FRAME)) for stamp in (begin, end))
            lit -= 1
            way = float(np.linalg.norm(np.diff(self.true_position[lit : last + 1], axis=0), axis=1).sum())
            known = np.isfinite(self.position[[lit, last]]).all()
            if not known or self.streamed.segment[lit] != self.streamed.segment[last]:
                rows.append((math.inf, math.inf, math.nan))
                continue
            upright, shift = self.gauge(lit)
            error = float(np.linalg.norm(upright @ self.position[last] + shift - self.true_position[last]))
            spread = float(np.trace(self.streamed.covariance[last][:3, :3]))
            sigmas = error / math.sqrt(spread) if spread > 0 else math.nan
            rows.append((100 * error, 100 * error / way if way > 0 else math.nan, sigmas))
        if not rows:
            return math.nan, math.nan, math.nan
        cm, percent, sigmas = np.array(rows).mean(axis=0).tolist()
        return cm, percent, sigmas


def _at(times: np.ndarray, stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Rows of ``values`` at the frames of ``times``, nan where there is none of that time."""
    found = np.full((len(times), *values.shape[1:]), np.nan)
    if len(stamps):
        nearest = np.clip(np.searchsorted(stamps, times), 0, len(stamps) - 1)
        before = np.maximum(nearest - 1, 0)
        nearest = np.where(np.abs(stamps[before] - times) < np.abs(stamps[nearest] - times), before, nearest)
        same = np.abs(stamps[nearest] - times) < SAME_FRAME
        found[same] = values[nearest[same]]
    return found


def _origin(streamed: Streamed, truth: InertialTruth) -> float:
    """First frame, or end of the degenerate stretch that it lies in, seconds."""
    first = float(streamed.timestamps[0])
    return next((float(end) for begin, end in truth.stretches if begin <= first < end), first)


def _time_to_alignment(pairs: Pairs, origin: float, stamps: np.ndarray) -> float:
    """Seconds from ``origin`` until the scale stays right."""
    centres = np.arange(origin, stamps[-1] - SPAN / 2, 0.1)
    scales = np.array([pairs.scale(at - WINDOW / 2, at + WINDOW / 2) for at in centres])
    known = np.flatnonzero(np.isfinite(scales))
    right = np.abs(scales[known] - 1) <= SCALE_PERCENT / 100
    if not len(known) or not right[-1]:
        return math.inf
    wrong = np.flatnonzero(~right)
    return float(centres[known[wrong[-1] + 1 if len(wrong) else 0]] - origin)


def _worlds(streamed: Streamed, segments: Sequence[Segment]) -> np.ndarray:
    """``(N,)`` number of the world of each frame: streamed segments whose rows are in one world share it."""
    worlds = streamed.segment.astype(np.int64).copy()
    for number, members in enumerate(worlds_of(segments)):
        rows = np.concatenate([segments[k].trajectory.timestamps for k in members])
        mine = np.isin(np.round(streamed.timestamps / SAME_FRAME), np.round(rows / SAME_FRAME))
        worlds[np.isin(streamed.segment, np.unique(streamed.segment[mine]))] = -1 - number
    return worlds


def _stretches_of(aligned: np.ndarray, segment: np.ndarray) -> list[tuple[int, int]]:
    """Runs of aligned frames of one segment: first frame, and the one after the last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], aligned.astype(int), [0]])))
    found = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        cuts = [begin, *(begin + 1 + np.flatnonzero(np.diff(segment[begin:end]))).tolist(), end]
        found += list(zip(cuts[:-1], cuts[1:], strict=True))
    return found


def _tilt(true: np.ndarray, found: np.ndarray) -> float:
    """Angle between the true vertical and that of the estimates, from their mean difference, degrees; nan without."""
    turns = true @ np.swapaxes(found, -1, -2)
    turns = turns[np.isfinite(turns).all(axis=(1, 2))]
    if not len(turns):
        return math.nan
    u, _, vt = np.linalg.svd(turns.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return math.degrees(math.acos(min(1.0, max(-1.0, float(mean[2, 2])))))


def _final_tilt(segments: Sequence[Segment], reference: Trajectory) -> float:
    """:func:`_tilt` of the world with most rows; nan without rows."""
    worlds = [[segments[number].trajectory for number in numbers] for numbers in worlds_of(segments)]
    if not worlds:
        return math.nan
    parts = max(worlds, key=lambda world: sum(map(len, world)))
    rows = Trajectory(
        np.concatenate([part.timestamps for part in parts]), np.concatenate([part.poses_wc for part in parts])
    )
    i, j = associate(rows, reference)
    return _tilt(quaternion_to_matrix(reference.poses_wc[j, 3:]), quaternion_to_matrix(rows.poses_wc[i, 3:]))


def _last_error(found: np.ndarray, true: np.ndarray) -> float:
    """Length of the error of the last row that is known; nan without one."""
    known = np.flatnonzero(np.isfinite(found).all(axis=1) & np.isfinite(true).all(axis=1))
    return float(np.linalg.norm(found[known[-1]] - true[known[-1]])) if len(known) else math.nan


def _logarithm(rotation: np.ndarray) -> np.ndarray:
    """Rotation vector ``(3,)`` of a rotation, rad."""
    import cv2

    return cv2.Rodrigues(rotation)[0][:, 0]
