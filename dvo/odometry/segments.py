"""Segments and breaks of a sequence, from the log of its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.map.keyframe_log import KeyframeLog
from dvo.map.map import Map, Recording
from dvo.odometry.protocol import Break, Estimate, Result, Segment, SparseMap, Status


def segments_of(
    log: KeyframeLog,
    poses: Mapping[int, np.ndarray] | None = None,
    worlds: Mapping[int, int] | None = None,
    recording: Recording = Recording(),  # noqa: B008 (frozen)
) -> tuple[Segment, ...]:
    """Segments of a recording that have rows, in order of time.

    Args:
        log: of every frame, with its segment.
        poses: ``T_cw`` of keyframes that are still being optimised.
        worlds: number of the segment whose world a segment has joined, by its own number; None if none has.
        recording: the last of the log.

    Returns:
        The segments; their positions are the numbers of the records, less that of the first of the recording.
    """
    found: list[Segment] = []
    place: dict[int, int] = {}  # first segment of each world
    for number in sorted({record.segment for record in log.frames[recording.frame :] if not record.lost}):
        rows = log.trajectory(number, poses)
        if len(rows):
            world = (worlds or {}).get(number, number)
            first = place.setdefault(world, len(found))
            joined_to, in_map = None if first == len(found) else first, world < recording.segment
            found.append(Segment(rows, float(rows.timestamps[0]), float(rows.timestamps[-1]), joined_to, in_map))
    return tuple(found)


def find_breaks(times: np.ndarray, owner: np.ndarray, reasons: Mapping[float, str]) -> tuple[Break, ...]:
    """Find the intervals without poses, the changes of segment, and the gaps in time that a segment goes on across.

    Args:
        times: ``(N,)`` increasing timestamps of all frames, seconds.
        owner: ``(N,)`` number of the segment of each frame, -1 for a frame without a pose.
        reasons: causes by timestamp: of a loss, or of a break before a frame with a pose.

    Returns:
        The breaks in order of time, each with the first cause that there is.
    """
    posed = np.flatnonzero(owner >= 0)
    breaks = []
    for before, after in zip([-1, *posed.tolist()], [*posed.tolist(), len(times)], strict=True):
        inside = before >= 0 and after < len(times)
        lost, new_segment = after - before - 1, inside and bool(owner[before] != owner[after])
        causes = [reasons[time] for time in times[before + 1 : after + 1].tolist() if reasons.get(time)]
        if lost or new_segment or (inside and causes):
            start = float(times[before]) if before >= 0 else None
            end = float(times[after]) if after < len(times) else None
            reason = causes[0] if causes else "no pose" if lost else "change of segment"
            breaks.append(Break(start, end, lost, reason, new_segment))
    return tuple(breaks)


def breaks_of(log: KeyframeLog, first: int = 0) -> tuple[Break, ...]:
    """Breaks of a log.

    Args:
        log: of every frame; a record with a pose and a reason was joined across a gap in time.
        first: position of the first frame of the recording.

    Returns:
        Breaks in order of time.
    """
    frames = log.frames[first:]
    times = np.array([record.timestamp for record in frames], dtype=np.float64)
    owner = np.array([-1 if record.lost else record.segment for record in frames], dtype=np.int64)
    return find_breaks(times, owner, {record.timestamp: record.reason for record in frames})


def result_of(graph: Map, info: dict[str, Any], poses: Mapping[int, np.ndarray] | None = None) -> Result:
    """Result of a tracker, for its last recording.

    Args:
        graph: of the sequence.
        info: metadata for run.json.
        poses: ``T_cw`` of keyframes that are still being optimised.

    Returns:
        All segments of the recording, with the trajectory and the map of the world with the most rows; if some are in
        the world of earlier recordings, with those, and the points of these recordings.
    """
    result, main = result_of_log(graph.log, info, poses, graph.worlds, graph.recording)
    return replace(result, map=SparseMap(*graph.points(graph.recording.segment + main)))


def result_of_log(
    log: KeyframeLog,
    info: dict[str, Any],
    poses: Mapping[int, np.ndarray] | None = None,
    worlds: Mapping[int, int] | None = None,
    recording: Recording = Recording(),  # noqa: B008 (frozen)
) -> tuple[Result, int]:
    """Result of an odometry that keeps a log, without a map.

    Args:
        log: of every frame, with its segment.
        info: metadata for run.json.
        poses: ``T_cw`` of keyframes that are still being optimised.
        worlds: number of the segment whose world a segment has joined, by its own number; None if none has.
        recording: the last of the log.

    Returns:
        All segments, with the trajectory of the world with the most rows (of several, the first; one of earlier
        recordings before others), and the number of the first segment in it.
    """
    segments = segments_of(log, poses, worlds, recording)
    rows: dict[int, list[Trajectory]] = {}
    for number, segment in enumerate(segments):
        rows.setdefault(number if segment.joined_to is None else segment.joined_to, []).append(segment.trajectory)
    in_map = [number for number in rows if segments[number].in_map]
    main = max(in_map or rows, key=lambda number: (sum(map(len, rows[number])), -number), default=0)
    trajectory = joined(rows[main]) if segments else Trajectory(np.zeros(0), np.zeros((0, 7)))
    read, tracked = len(log.frames) - recording.frame, sum(len(segment) for segment in segments)
    breaks = breaks_of(log, recording.frame)
    predicted = tuple(r.timestamp for r in log.frames[recording.frame :] if r.inertial and not r.lost)
    return Result(trajectory, SparseMap(), read, read - tracked, info, segments, breaks, inertial=predicted), main


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """One trajectory of several that follow each other in time.

    Args:
        parts: at least one.
    """
    if len(parts) == 1:
        return parts[0]
    return Trajectory(np.concatenate([p.timestamps for p in parts]), np.concatenate([p.poses_wc for p in parts]))


def own_copy(estimate: Estimate) -> Estimate:
    """Estimate with a pose array of its own, so that who changes the array of one does not change that of the other.

    Args:
        estimate: with or without a pose.

    Returns:
        The same values.
    """
    return estimate if estimate.pose_wc is None else replace(estimate, pose_wc=estimate.pose_wc.copy())


def withdraw(estimates: list[Estimate], reasons: dict[float, str], first: int, reason: str) -> None:
    """Take the poses from the newest frames of an odometry without a graph, in place.

    Args:
        estimates: of all frames.
        reasons: causes by timestamp; those that there are stay.
        first: position of the first of the frames.
        reason: cause.
    """
    for position in range(first, len(estimates)):
        time, segment = estimates[position].timestamp, estimates[position].segment
        estimates[position] = Estimate(time, None, Status.LOST, 0.0, segment, reason)
        reasons.setdefault(time, reason)


def result_of_estimates(estimates: Sequence[Estimate], reasons: Mapping[float, str], info: dict[str, Any]) -> Result:
    """Result of an odometry whose estimates are final, without a map.

    Args:
        estimates: of all frames, in order of time.
        reasons: causes by timestamp, see :func:`find_breaks`.
        info: metadata for run.json.

    Returns:
        All segments, with the trajectory of the first of the longest.
    """
    times = np.array([estimate.timestamp for estimate in estimates], dtype=np.float64)
    owner = np.array([-1 if e.pose_wc is None else e.segment for e in estimates], dtype=np.int64)
    segments = []
    for number in np.unique(owner[owner >= 0]):
        poses = [e.pose_wc for e in estimates if e.segment == number and e.pose_wc is not None]
        rows = Trajectory(times[owner == number], np.stack(poses))
        segments.append(Segment(rows, float(rows.timestamps[0]), float(rows.timestamps[-1])))
    longest = max(segments, key=len, default=None)
    trajectory = longest.trajectory if longest else Trajectory(np.zeros(0), np.zeros((0, 7)))
    breaks, lost = find_breaks(times, owner, reasons), int((owner < 0).sum())
    return Result(trajectory, SparseMap(), len(times), lost, info, tuple(segments), breaks)
