"""Reader of a results folder."""

from __future__ import annotations

import json
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

_LIMIT = 64 * 2**20  # bytes of run.json
_REMEDY = "give a folder that dvo run has written"


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
        raise DvoError("not a results folder", file=folder, remedy=_REMEDY)
    facts = _read_facts(folder / results.SUMMARY)
    try:
        breaks = tuple(
            Break(found["from"], found["to"], int(found["frames"]), str(found["reason"]), bool(found["new_segment"]))
            for found in facts["breaks"]
        )
        described = [(str(part["file"]), part["joined_to"], bool(part.get("in_map"))) for part in facts["segments"]]
        counts = int(facts["frames"]["read"]), int(facts["frames"]["lost"])
        info = dict(facts["info"])
    except (KeyError, TypeError, ValueError) as error:
        raise DvoError(f"has no valid {error}", file=folder / results.SUMMARY, remedy=_REMEDY) from None
    segments = tuple(_read_segment(folder, *part) for part in described)
    nothing = Trajectory(np.zeros(0), np.zeros((0, 7)))
    trajectory = read_tum(folder / results.TRAJECTORY) if segments else nothing
    map_file = folder / results.MAP
    points = read_ply(map_file) if map_file.is_file() else SparseMap()
    result = Result(trajectory, points, *counts, info, segments, breaks)
    table = folder / results.FRAMES
    rows = read_frames(table) if table.is_file() else rows_of(result)
    return Stored(result, rows, facts)


def _read_facts(file: Path) -> dict[str, Any]:
    try:
        if file.stat().st_size > _LIMIT:
            raise DvoError("too large", file=file, remedy=_REMEDY)
        facts = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DvoError(error.strerror or str(error), file=file, remedy=_REMEDY) from error
    except (ValueError, RecursionError):
        raise DvoError("not JSON", file=file, remedy=_REMEDY) from None
    if not isinstance(facts, dict):
        raise DvoError("not the description of a run", file=file, remedy=_REMEDY)
    return facts


def _read_segment(folder: Path, name: str, joined: int | None, in_map: bool) -> Segment:
    if name != results.TRAJECTORY and not results.SEGMENT_FILE.fullmatch(name):
        raise DvoError(f"unknown file '{name[:60]}' of a segment", file=folder / results.SUMMARY, remedy=_REMEDY)
    trajectory = read_tum(folder / name)
    times = trajectory.timestamps
    return Segment(trajectory, float(times[0]), float(times[-1]), None if joined is None else int(joined), in_map)


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
