"""Time and memory of every frame of a long video that comes back again and again: `python -m eval.benchmarks.long_run`.

A rendered walk is played forwards and backwards in turn, at a steady rate, until the number of frames is reached: every
pass after the first shows places that are known. Loop closure is on. The command prints a table over the parts of the
video, writes the rows of every 100 frames as CSV and draws them.

    python -m eval.benchmarks.long_run --frames 20000 --csv docs/long_run.csv --svg docs/long_run.svg
"""

from __future__ import annotations

import argparse
import csv
import io
import time
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.threads import settle_threads
from dvo.data.frame import Frame
from dvo.odometry.load import load
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.synth.sequence import make_sequence
from eval.benchmarks.loops.runs import resident_bytes

STEP = 100
"""Frames of a row."""
PARTS = 5
"""Lines of the printed table."""
SEED = 4_310_000_000


@dataclass(frozen=True)
class Row:
    """Frames that were tracked since the row before.

    Attributes:
        frame: number of frames so far.
        median_ms, p95_ms, worst_ms: time of ``track``.
        resident_mb: resident memory of the process.
        archive_mb: features, images, edges and patches of the archive.
        keyframes: kept ones.
        loops: confirmed ones so far.
    """

    frame: int
    median_ms: float
    p95_ms: float
    worst_ms: float
    resident_mb: float
    archive_mb: float
    keyframes: int
    loops: int


def there_and_back(frames: list[Frame], count: int, interval: float) -> Iterator[Frame]:
    """Frames forwards and backwards in turn.

    Args:
        frames: of a walk, two or more.
        count: number of frames to give.
        interval: seconds between two of them.

    Yields:
        Frames with times and indices that go on; no frame twice in succession.
    """
    period = 2 * (len(frames) - 1)
    for index in range(count):
        place = index % period
        source = frames[place if place < len(frames) else period - place]
        yield replace(source, index=index, timestamp=index * interval)


def measure(odometry: PatchOdometry, frames: Iterator[Frame]) -> Iterator[Row]:
    """Track frames.

    Args:
        odometry: newly built.
        frames: to track.

    Yields:
        A row after every :data:`STEP` frames; the rest is left out.
    """
    times: list[float] = []
    for number, frame in enumerate(frames, 1):
        begin = time.perf_counter()
        odometry.track(frame)
        times.append(1000 * (time.perf_counter() - begin))
        if number % STEP == 0:
            archive, median, p95 = odometry.graph.archive, *np.percentile(times, [50, 95])
            kept = sum(keyframe.anchor is None for keyframe in archive)
            yield Row(
                number, float(median), float(p95), max(times), resident_bytes() / 1e6, archive.nbytes / 1e6, kept,
                len(odometry.loops.loops),
            )  # fmt: skip
            times.clear()


def table(rows: list[Row]) -> str:
    """Parts of a video of equal length, in Markdown.

    Args:
        rows: of the whole video.
    """
    lines = [
        "| frames | median ms | p95 ms | resident MB | growth kB a keyframe | archive MB | keyframes | loops |",
        "|---|" + "--:|" * 7,
    ]
    before: Row | None = None
    for part in np.array_split(np.arange(len(rows)), min(PARTS, len(rows))):
        chosen, last = [rows[int(k)] for k in part], rows[int(part[-1])]
        median, p95 = (float(np.median([getattr(row, name) for row in chosen])) for name in ("median_ms", "p95_ms"))
        growth = "–"
        if before is not None and last.keyframes > before.keyframes:
            growth = f"{1000 * (last.resident_mb - before.resident_mb) / (last.keyframes - before.keyframes):.0f}"
        lines.append(
            f"| to {last.frame} | {median:.0f} | {p95:.0f} | {last.resident_mb:.0f} | {growth} | "
            f"{last.archive_mb:.0f} | {last.keyframes} | {last.loops} |"
        )
        before = last
    return "\n".join(lines)


def write_csv(file: Path, rows: list[Row]) -> None:
    """Write the rows.

    Args:
        file: replaced.
        rows: to write.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(Row)])
    writer.writerows([f"{value:.6g}" for value in astuple(row)] for row in rows)
    file.write_text(text.getvalue(), encoding="utf-8")


def read_csv(file: Path) -> list[Row]:
    """Rows of :func:`write_csv`.

    Args:
        file: to read.

    Raises:
        DvoError: another file.
    """
    try:
        with file.open(encoding="utf-8", newline="") as text:
            return [
                Row(**dict[str, Any]((f.name, (int if f.type == "int" else float)(entry[f.name])) for f in fields(Row)))
                for entry in csv.DictReader(text)
            ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DvoError(f"no rows of this benchmark ({error})", file=file, remedy="give the file of --csv") from error


def draw(file: Path, rows: list[Row]) -> None:
    """Draw time and memory over the frames.

    Args:
        file: SVG, replaced.
        rows: of the whole video.
    """
    from matplotlib.figure import Figure

    figure = Figure((9, 5.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    columns = {name: np.array([asdict(row)[name] for row in rows]) for name in asdict(rows[0])}
    at = columns["frame"]
    above.plot(at, columns["p95_ms"], color="#d55e00", lw=1, label="95th percentile of 100 frames")
    above.plot(at, columns["median_ms"], color="#0072b2", lw=1.5, label="median of 100 frames")
    above.set_ylabel("ms a frame")
    below.plot(at, columns["resident_mb"], color="#0072b2", lw=1.5, label="resident memory")
    below.plot(at, columns["archive_mb"], color="#009e73", lw=1.5, label="archive of keyframes")
    below.set_ylabel("MB")
    below.set_xlabel("frame")
    for axes in (above, below):
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, loc="best", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file, format="svg", metadata={"Date": None})


def main() -> None:
    """Entry point."""
    parser = OneLineParser(prog="python -m eval.benchmarks.long_run", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("--frames", type=int, default=20_000, metavar="N", help="of the video (%(default)s)")
    parser.add_argument("--walk", type=int, default=600, metavar="N", help="frames of the walk (%(default)s)")
    parser.add_argument("--fps", type=float, default=10.0, help="%(default)s")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="rows of every 100 frames")
    parser.add_argument("--svg", type=Path, metavar="FILE", help="drawing of them")
    parser.add_argument("--read", type=Path, metavar="FILE", help="rows of an earlier run, instead of tracking")
    options = parser.parse_args()
    try:
        rows = read_csv(options.read) if options.read else run(options.frames, options.walk, options.fps)
        if not rows:
            raise DvoError("no rows", field="--frames", remedy=f"give {STEP} or more")
        if options.csv:
            write_csv(options.csv, rows)
        if options.svg:
            draw(options.svg, rows)
        print(table(rows))
    except DvoError as error:
        raise SystemExit(f"error: {error}") from error


def run(count: int, walk: int, fps: float) -> list[Row]:
    """Render the walk and track the video.

    Args:
        count: frames of the video.
        walk: frames of the walk, two or more.
        fps: frames in a second.

    Returns:
        The rows; those of an interrupted run so far.
    """
    settle_threads()
    if walk < 2 or fps <= 0:
        raise DvoError("out of range", field="--walk, --fps", remedy="give 2 frames or more, and a positive rate")
    options: dict[str, Any] = {
        "frames": walk,
        "family": "hall",
        "kind": "revisit",
        "fps": fps,
        "apart": True,
        "height": 240,
        "width": 320,
    }
    frames = list(make_sequence(SEED, **options))
    rows: list[Row] = []
    try:
        odometry = load("small", device="cpu")
        assert isinstance(odometry, PatchOdometry)
        for row in measure(odometry, there_and_back(frames, count, 1 / fps)):
            rows.append(row)
            if row.frame % 1000 == 0:
                print(
                    f"frame {row.frame}: {row.median_ms:.0f} ms, {row.resident_mb:.0f} MB, {row.loops} loops",
                    flush=True,
                )
    except KeyboardInterrupt:
        print("stopped")
    return rows


if __name__ == "__main__":
    main()
