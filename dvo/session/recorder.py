"""Results of a run while it goes on: what a crash, a kill or a full disk leaves behind."""

from __future__ import annotations

import contextlib
import os
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.files.output import replaced
from dvo.data.frame import Frame
from dvo.data.trajectory import TUM_HEADER, Trajectory, tum_row
from dvo.odometry.protocol import Estimate, Interim, Odometry, Result, Segment, SparseMap, Status
from dvo.session.files import write_ply
from dvo.session.results import MAP, TRAJECTORY, remove_results, segment_file, summary, write_summary
from dvo.session.session import Run

INTERVAL = 10.0  # seconds between two versions of map and run.json
_COLUMNS = 8  # of a TUM row


@dataclass
class _RowFile:
    """Rows of a file that have reached the system; bytes after ``size`` are of a row that was cut off."""

    segment: int
    rows: int
    size: int


class Recorder:
    """Writer of the results folder during a run; :func:`dvo.session.results.write_results` replaces its files.

    A row of ``trajectory.txt`` is handed to the system as soon as its frame is tracked, so that killing the process
    loses none. It holds the current estimates of the longest segment; of several segments, each has a file of its own.
    ``run.json`` (with ``"finished": false``), and ``map.ply`` if the odometry is an
    :class:`~dvo.odometry.protocol.Interim`, are replaced at intervals, when everything is also brought to the disk.
    Files of an earlier run in the folder are removed at the first frame.

    A write that fails does not end the run: it is reported once, and repeated after later frames. The rows are kept in
    memory for that, 64 bytes a frame.

    Args:
        folder: an existing folder.
        odometry: the odometry that the frames are passed to.
        facts: metadata of the caller, the first entries of run.json.
        warn: called with a sentence at the first write that fails.
        clock: time in seconds.
        interval: seconds between two versions of map and run.json.

    Attributes:
        warnings: sentences that ``warn`` was called with.
    """

    def __init__(
        self,
        folder: Path,
        odometry: Odometry,
        facts: dict[str, Any],
        *,
        warn: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
        interval: float = INTERVAL,
    ) -> None:
        self.folder, self.odometry, self.facts = folder, odometry, facts
        self.warn, self.clock, self.interval = warn, clock, interval
        self.warnings: list[str] = []
        self._rows: dict[int, array[float]] = {}
        self._files: dict[str, _RowFile] = {}
        self._longest = 0
        self._read = self._fed = self._lost = 0
        self._started = self._written = clock()
        self._clean = False

    @property
    def started(self) -> bool:
        """True after the first frame."""
        return self._read > 0

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """Record a frame; callback of :func:`dvo.session.session.run`.

        Args:
            frame: the frame.
            estimate: of the frame; None if it was skipped.
        """
        self._read += 1
        if estimate is not None:
            self._fed += 1
            self._lost += estimate.status is Status.LOST
            if estimate.pose_wc is not None and estimate.status is not Status.LOST:
                self._add(estimate.segment, estimate.timestamp, estimate.pose_wc)
        self._write(everything=not self._clean or self.clock() - self._written >= self.interval)

    def stop(self, *, interrupted: bool, reason: str) -> None:
        """Write what there is, because the run ends without a result. Nothing is written before the first frame.

        Args:
            interrupted: True if the user stopped the run.
            reason: sentence for the warnings in run.json.
        """
        if self._read:
            self.warnings.append(reason)
            self._write(everything=True, interrupted=interrupted)

    # -- rows ----------------------------------------------------------------------------------------------------

    def _add(self, segment: int, timestamp: float, pose_wc: np.ndarray) -> None:
        rows = self._rows.setdefault(segment, array("d"))
        rows.extend(array("d", [timestamp, *np.asarray(pose_wc, np.float64).tolist()]))  # one call: never half a row
        if len(rows) > len(self._rows.get(self._longest, ())):
            self._longest = segment

    def _lines(self, segment: int, start: int = 0) -> bytes:
        """Rows of a segment as text, from row ``start`` on."""
        rows = self._rows.get(segment, array("d"))
        cells = range(start * _COLUMNS, len(rows), _COLUMNS)
        return "".join(tum_row(rows[cell : cell + _COLUMNS]) for cell in cells).encode("ascii")

    def _write_rows(self, *, durable: bool) -> None:
        """Bring every file up to date; one that fails does not keep the others from it."""
        wanted = {TRAJECTORY: self._longest}
        if len(self._rows) > 1:
            wanted |= {segment_file(segment): segment for segment in sorted(self._rows)}
        failures = []
        for name, segment in wanted.items():
            try:
                self._write_segment(name, segment, durable=durable)
            except OSError as error:
                failures.append(error)
        if failures:
            raise failures[0]

    def _write_segment(self, name: str, segment: int, *, durable: bool) -> None:
        """Append the rows that a file does not have yet; replace a file that held another segment."""
        path, count = self.folder / name, len(self._rows.get(segment, ())) // _COLUMNS
        known = self._files.get(name)
        if known is None or known.segment != segment:
            content = TUM_HEADER.encode("ascii") + self._lines(segment)
            with replaced(path) as part:
                part.write_bytes(content)
            self._files[name] = _RowFile(segment, count, len(content))
        elif known.rows < count:
            lines = self._lines(segment, known.rows)
            _append(path, known.size, lines)
            known.rows, known.size = count, known.size + len(lines)
        if durable:
            with open(path, "rb+") as file:
                os.fsync(file.fileno())

    # -- everything else -----------------------------------------------------------------------------------------

    def _write(self, *, everything: bool, interrupted: bool = False) -> None:
        """Write the rows and, if ``everything``, map and run.json; a failure becomes a warning."""
        try:
            if not self._clean:
                remove_results(self.folder)
                # Before the other files, which then are known to be of a run, also if this one is killed.
                self._write_summary(self._rows_so_far(), interrupted)
                self._clean = True
            self._write_rows(durable=everything)
            if everything:
                self._write_state(interrupted)
        except OSError as error:
            if not self.warnings:
                at = self.clock() - self._started
                self.warnings.append(
                    f"after {at:.0f} s and {self._read} frames results could not be written to {self.folder} "
                    f"({error.strerror or error}); tracking goes on"
                )
                self.warn(self.warnings[-1])
        finally:
            if everything:
                self._written = self.clock()

    def _write_state(self, interrupted: bool) -> None:
        result = self._result()
        if len(result.map.points):
            with replaced(self.folder / MAP) as part:
                write_ply(part, result.map)
        self._write_summary(result, interrupted)

    def _write_summary(self, result: Result, interrupted: bool) -> None:
        elapsed = {"elapsed": self.clock() - self._started}
        run = Run(result, self._fed, interrupted, tuple(self.warnings), elapsed)
        write_summary(self.folder, {**self.facts, **summary(run), "finished": False})

    def _result(self) -> Result:
        """Result so far: that of the odometry if it gives one, else the rows."""
        if isinstance(self.odometry, Interim):
            result = self.odometry.current()  # where a frame may have a row that was lost at first
            return replace(result, frames_read=self._read, frames_lost=min(self._lost, result.frames_lost))
        return self._rows_so_far()

    def _rows_so_far(self) -> Result:
        segments: list[Segment] = []
        for _, rows in sorted(self._rows.items()):
            table = np.array(rows).reshape(-1, _COLUMNS)
            segments.append(Segment(Trajectory(table[:, 0], table[:, 1:]), float(table[0, 0]), float(table[-1, 0])))
        longest = max(segments, key=len).trajectory if segments else Trajectory(np.zeros(0), np.zeros((0, 7)))
        return Result(longest, SparseMap(), self._read, self._lost, {}, tuple(segments))


def _append(path: Path, size: int, content: bytes) -> None:
    """Append to the first ``size`` bytes of a file; what lies behind them, a row that was cut off, is removed."""
    os.truncate(path, size)
    try:
        with open(path, "ab") as file:
            file.write(content)
    except OSError:
        with contextlib.suppress(OSError):
            os.truncate(path, size)
        raise
