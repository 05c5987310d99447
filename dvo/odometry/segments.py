"""Segments and breaks of a sequence, from the log of its frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.keyframe_log import KeyframeLog
from dvo.odometry.protocol import Break, Result, Segment, SparseMap


def segments_of(log: KeyframeLog, poses: Mapping[int, np.ndarray] | None = None) -> tuple[Segment, ...]:
    """Segments of a log that have rows, in order of time.

    Args:
        log: of every frame, with its segment.
        poses: ``T_cw`` of keyframes that are still being optimised.

    Returns:
        The segments; their positions are the numbers of the records.
    """
    found = []
    for number in sorted({record.segment for record in log.frames if not record.lost}):
        rows = log.trajectory(number, poses)
        if len(rows):
            found.append(Segment(rows, float(rows.timestamps[0]), float(rows.timestamps[-1])))
    return tuple(found)


def breaks_of(log: KeyframeLog) -> tuple[Break, ...]:
    """Intervals without poses, and changes of segment.

    Args:
        log: of every frame; the first lost record of an interval states its cause, and a record with a pose and a
            reason was joined across a gap in time.

    Returns:
        Breaks in order of time.
    """
    found: list[Break] = []
    before = None  # last record with a pose
    count, reason = 0, ""
    for record in log.frames:
        if record.lost:
            reason = reason or record.reason
            count += 1
            continue
        new = before is not None and record.segment != before.segment
        if count or new or record.reason:
            start = None if before is None else before.timestamp
            found.append(Break(start, record.timestamp, count, reason or record.reason, new))
        before, count, reason = record, 0, ""
    if count:
        found.append(Break(None if before is None else before.timestamp, None, count, reason, False))
    return tuple(found)


def result_of(graph: KeyframeGraph, info: dict[str, Any], poses: Mapping[int, np.ndarray] | None = None) -> Result:
    """Result of a tracker.

    Args:
        graph: of the sequence.
        info: metadata for run.json.
        poses: ``T_cw`` of keyframes that are still being optimised.

    Returns:
        All segments, with the trajectory and the map of the one with the most rows.
    """
    segments = segments_of(graph.log, poses)
    main = max(range(len(segments)), key=lambda number: (len(segments[number]), -number), default=0)
    trajectory = segments[main].trajectory if segments else Trajectory(np.zeros(0), np.zeros((0, 7)))
    read, tracked = len(graph.log.frames), sum(len(segment) for segment in segments)
    points = SparseMap(*graph.points(main))
    return Result(trajectory, points, read, read - tracked, info, segments, breaks_of(graph.log))
