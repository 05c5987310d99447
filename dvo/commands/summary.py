"""Page of a run (summary.html): contents from a run or from a results folder, and ``dvo summary``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.commands import OK
from dvo.commands.console import say
from dvo.commands.page_tables import figures, headline_of, tables, verdict_of
from dvo.commands.picture import world_root
from dvo.commands.places import check_outputs
from dvo.commands.report import score
from dvo.data.files.output import replaced
from dvo.data.trajectory import Trajectory, read_tum
from dvo.metrics import MINIMUM_MATCHES, associate, fit_alignment, stands_still, transform
from dvo.odometry.protocol import Odometry, Result
from dvo.session import results
from dvo.session.files import write_error
from dvo.session.frame_table import FrameRow, FrameTable, keyframe_times, write_frames
from dvo.session.results_reader import Stored, read_results
from dvo.session.session import Run
from dvo.viz.run_page import RunPage, TrackLine, World, read_images, write_page

Similarity = tuple[float, np.ndarray, np.ndarray]


def summary(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo summary``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: no results folder, a file in it that cannot be read, or a page that cannot be written.
    """
    folder = Path(arguments.source)
    stored = read_results(folder)
    if arguments.groundtruth is not None:
        stored = _with_truth(stored, Path(arguments.groundtruth))
    out = folder / results.PAGE if arguments.out is None else Path(arguments.out)
    inputs = {name: folder / name for name in (*sorted(results.files_of_run(folder)),) if name != results.PAGE}
    check_outputs({"--out": arguments.out}, {"--groundtruth": arguments.groundtruth, **inputs})
    try:
        with replaced(out) as part:
            name = Path(str(stored.facts.get("source") or folder.resolve())).name
            images = read_images(folder / results.PAGE)
            write_page(part, run_page(name, stored.result, stored.rows, stored.facts, images))
    except OSError as error:
        raise write_error(out, error) from error
    say(f"summary in {out}")
    return OK


def _with_truth(stored: Stored, file: Path) -> Stored:
    """Results compared with another ground truth."""
    groundtruth = read_tum(file)
    truth = true_positions(np.array([row.timestamp for row in stored.rows]), groundtruth)
    rows = [row.at(position) for row, position in zip(stored.rows, truth, strict=True)]
    scores = score(Run(stored.result, len(rows), False), groundtruth)
    segments = stored.facts["segments"]
    if scores.segments:
        segments = [{**part, **errors} for part, errors in zip(segments, scores.segment_facts, strict=True)]
    metrics = None if scores.longest is None else asdict(scores.longest)
    facts = {**stored.facts, "groundtruth": str(file), "metrics": metrics, "segments": segments}
    return Stored(stored.result, rows, facts)


@dataclass(frozen=True)
class Pages:
    """Writers of frames.csv and summary.html at the end of a run.

    Attributes:
        name: of the clip.
        run: record of the session.
        table: record of the estimates.
        odometry: that has tracked the clip.
        groundtruth: camera to world, metres; None if there is none.
        images: time (seconds) and small JPEG file of some frames.
    """

    name: str
    run: Run
    table: FrameTable
    odometry: Odometry
    groundtruth: Trajectory | None
    images: Sequence[tuple[float, bytes]] = ()

    def frames(self, path: Path) -> None:
        """Write frames.csv."""
        write_frames(path, self.rows())

    def page(self, path: Path, values: dict[str, Any]) -> None:
        """Write summary.html.

        Args:
            path: file to write.
            values: content of run.json.
        """
        write_page(path, run_page(self.name, self.run.result, self.rows(), values, self.images))

    def add_warnings(self, folder: Path, warnings: Sequence[str]) -> None:
        """Add to the warnings in run.json and summary.html what was found after they were written.

        Args:
            folder: of the results.
            warnings: sentences; without one only the list of files is written anew.

        Raises:
            DvoError: a file cannot be read or written.
        """
        file = folder / results.SUMMARY
        try:
            values = json.loads(file.read_text(encoding="utf-8"))
            if not warnings:
                results.write_summary(folder, values)  # lists what observers have written at the end
                return
            values["warnings"] += warnings
            results.write_summary(folder, values)
            file = folder / results.PAGE
            with replaced(file) as part:
                self.page(part, values)
        except OSError as error:
            raise write_error(file, error) from error

    def rows(self) -> list[FrameRow]:
        """Rows of frames.csv."""
        truth = None if self.groundtruth is None else true_positions(self.table.timestamps, self.groundtruth)
        return self.table.rows(self.run, keyframe_times(self.odometry, self.run.result), truth)


def true_positions(times: np.ndarray, groundtruth: Trajectory) -> np.ndarray:
    """True positions of the camera at the times of frames.

    Args:
        times: ``(N,)`` seconds, increasing.
        groundtruth: camera to world, metres.

    Returns:
        ``(N, 3)`` metres, nan where the ground truth has no pose within 10 ms.
    """
    found = np.full((len(times), 3), np.nan)
    i, j = associate(Trajectory(times, np.zeros((len(times), 7))), groundtruth)
    found[i] = groundtruth.positions[j]
    return found


def run_page(
    name: str,
    result: Result,
    rows: Sequence[FrameRow],
    facts: dict[str, Any],
    images: Sequence[tuple[float, bytes]] = (),
) -> RunPage:
    """Contents of the page.

    With true positions every segment is aligned with them on its own, as for the metrics, and all share a
    world. Segments that cannot be aligned, or all without ground truth, are shown in worlds of their own.

    Args:
        name: of the clip.
        result: of the run.
        rows: of its frames, in order of time.
        facts: content of run.json.
        images: time (seconds) and small JPEG file of some frames.

    Returns:
        The page.
    """
    fits = _fits(result, rows)
    worlds = _true_world(result, rows, fits, facts) + _own_worlds(result, set(fits), facts)
    loops = [(loop["from"], loop["to"]) for loop in _loops(facts)]
    return RunPage(
        title=name,
        verdict=verdict_of(facts),
        subtitle=headline_of(facts),
        notices=facts.get("warnings") or [],
        facts=figures(facts, rows),
        tables=tables(facts, rows[0].timestamp if rows else 0.0),
        worlds=worlds or [World("nothing tracked", (), points=result.map.points, colors=result.map.colors)],
        rows=rows,
        errors=_errors(result, rows, fits),
        loops=loops,
        images=images,
    )


def _loops(facts: dict[str, Any]) -> list[dict[str, Any]]:
    """Loops within the recording: the earlier visit of one with a map is on another clock."""
    loops = (facts.get("info") or {}).get("loops") or []
    return [loop for loop in loops if not loop.get("in_map")]


def _truth(rows: Sequence[FrameRow]) -> np.ndarray:
    """``(N, 3)`` true positions, nan where unknown."""
    return np.array([row.true_position or (np.nan,) * 3 for row in rows]).reshape(-1, 3)


def _matched(result: Result, rows: Sequence[FrameRow], number: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the trajectory of a segment and rows of the table that are of the same frames with a true position."""
    times = np.round([row.timestamp for row in rows], 6)
    _, i, j = np.intersect1d(np.round(result.segments[number].trajectory.timestamps, 6), times, return_indices=True)
    known = np.isfinite(_truth(rows)[j]).all(axis=1)
    return i[known], j[known]


def _fits(result: Result, rows: Sequence[FrameRow]) -> dict[int, Similarity]:
    """Alignment of each segment with the true positions, of those that can be aligned."""
    truth, fits = _truth(rows), {}
    if not np.isfinite(truth).any():
        return {}
    for number, segment in enumerate(result.segments):
        i, j = _matched(result, rows, number)
        found, true = segment.trajectory.positions[i], truth[j]
        if len(i) >= MINIMUM_MATCHES and not (stands_still(found) or stands_still(true)):
            fits[number] = fit_alignment(found, true, "se3" if result.is_metric(number) else "sim3")
    return fits


def _errors(result: Result, rows: Sequence[FrameRow], fits: dict[int, Similarity]) -> np.ndarray:
    """``(N,)`` distance of each frame from its true position, metres, nan where unknown."""
    errors, truth = np.full(len(rows), np.nan), _truth(rows)
    for number, (scale, rotation, shift) in fits.items():
        i, j = _matched(result, rows, number)
        aligned = scale * result.segments[number].trajectory.positions[i] @ rotation.T + shift
        errors[j] = np.linalg.norm(aligned - truth[j], axis=1)
    return errors


def _true_world(
    result: Result, rows: Sequence[FrameRow], fits: dict[int, Similarity], facts: dict[str, Any]
) -> list[World]:
    if not fits:
        return []
    tracks = tuple(TrackLine(transform(result.segments[k].trajectory, *fit), k) for k, fit in fits.items())
    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if result.longest in fits:
        scale, rotation, shift = fits[result.longest]
        with np.errstate(invalid="ignore", over="ignore"):  # of points that are not finite, which are not drawn
            points, colors = scale * result.map.points @ rotation.T + shift, result.map.colors
    return [World("ground truth", tracks, True, _truth(rows), points, colors, _loop_positions(tracks, facts))]


def _own_worlds(result: Result, shown: set[int], facts: dict[str, Any]) -> list[World]:
    """A world for the segments that share one and are not shown yet; first the one of the map."""
    roots = [world_root(result, number) for number in range(len(result.segments))]
    main = None if result.longest is None else roots[result.longest]
    worlds = []
    for root in sorted(set(roots), key=lambda k: (k != main, k)):
        members = [k for k in range(len(roots)) if roots[k] == root and k not in shown]
        if not members:
            continue
        tracks = tuple(TrackLine(result.segments[k].trajectory, k) for k in members)
        name = f"segment{'s' * (len(members) > 1)} {', '.join(map(str, members))}"
        world = World(name, tracks, all(map(result.is_metric, members)), loops=_loop_positions(tracks, facts))
        mapped = root == main and result.longest not in shown
        worlds.append(replace(world, points=result.map.points, colors=result.map.colors) if mapped else world)
    return worlds


def _loop_positions(tracks: Sequence[TrackLine], facts: dict[str, Any]) -> np.ndarray:
    """``(L, 2, 3)`` positions of both visits of the loops whose frames are on the tracks."""

    def position(time: float) -> np.ndarray | None:
        for track in tracks:
            row = np.flatnonzero(np.isclose(track.trajectory.timestamps, time, rtol=0, atol=1e-6))
            if len(row):
                return track.trajectory.positions[row[0]]
        return None

    pairs = [(position(loop["from"]), position(loop["to"])) for loop in _loops(facts)]
    return np.array([pair for pair in pairs if pair[0] is not None and pair[1] is not None]).reshape(-1, 2, 3)
