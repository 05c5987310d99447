"""Reader of a results folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory, read_tum
from dvo.odometry.protocol import Break, Result, Segment, SparseMap, Status
from dvo.session import results
from dvo.session.files import read_ply
from dvo.session.frame_table import FrameRow, read_frames
from dvo.session.run_facts import REMEDY, read_facts


@dataclass(frozen=True)
class Stored:
    """Results of a run as they stand in a folder.

    Attributes:
        result: trajectories, map and breaks.
        rows: of the frames, in order of time.
        facts: content of run.json.
    """

    result: Result
    rows: list[FrameRow]
    facts: dict[str, Any]


def read_results(folder: Path) -> Stored:
    """Read a results folder.

    Args:
        folder: of a run that is finished, or goes on.

    Returns:
        The results. Without frames.csv (folders of older versions, and of runs that go on), there is a row for every
        frame with a pose and for every lost frame; times of lost frames are spread over their break.

    Raises:
        DvoError: not a results folder, or a file that cannot be read.
    """
    if not folder.is_dir():
        raise DvoError("not a results folder", file=folder, remedy=REMEDY)
    facts = read_facts(folder / results.SUMMARY)
    breaks = tuple(
        Break(found.get("from"), found.get("to"), found["frames"], found["reason"], found["new_segment"])
        for found in facts["breaks"]
    )
    described = [(part["file"], part.get("joined_to"), bool(part.get("in_map"))) for part in facts["segments"]]
    counts, info = (facts["frames"]["read"], facts["frames"]["lost"]), facts["info"]
    segments = tuple(_read_segment(folder, *part) for part in described)
    nothing = Trajectory(np.zeros(0), np.zeros((0, 7)))
    trajectory = read_tum(folder / results.TRAJECTORY) if segments else nothing
    map_file = folder / results.MAP
    points = read_ply(map_file) if map_file.is_file() else SparseMap()
    result = Result(trajectory, points, *counts, info, segments, breaks)
    table = folder / results.FRAMES
    rows = read_frames(table) if table.is_file() else rows_of(result)
    return Stored(result, rows, facts)


def _read_segment(folder: Path, name: str, joined: int | None, in_map: bool) -> Segment:
    if name != results.TRAJECTORY and not results.SEGMENT_FILE.fullmatch(name):
        raise DvoError(f"unknown file '{name[:200]}' of a segment", file=folder / results.SUMMARY, remedy=REMEDY)
    trajectory = read_tum(folder / name)
    times = trajectory.timestamps
    return Segment(trajectory, float(times[0]), float(times[-1]), joined, in_map)


def rows_of(result: Result) -> list[FrameRow]:
    """Rows of the frames as far as trajectories and breaks tell.

    Args:
        result: of a run.

    Returns:
        In order of time; times of lost frames are spread over their break.
    """
    tracking, lost = Status.TRACKING.value, Status.LOST.value
    rows = [
        FrameRow(float(time), tracking, number)
        for number, segment in enumerate(result.segments)
        for time in segment.trajectory.timestamps
    ]
    times = sorted(row.timestamp for row in rows)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    for found in result.breaks:
        length = step * (found.frames + 1)
        first = found.start if found.start is not None else (0.0 if found.end is None else found.end - length)
        last = found.end if found.end is not None else first + length
        between = np.linspace(first, last, found.frames + 2)[1:-1]
        rows += [FrameRow(float(time), lost, reason=found.reason) for time in between]
    return sorted(rows, key=lambda row: row.timestamp)
