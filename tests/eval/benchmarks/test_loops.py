"""Benchmark of loops: one run from end to end, going on after an interruption, joined worlds, tables."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.map.archive import ArrayStorage
from dvo.odometry.protocol import Segment
from eval.benchmarks.loops.__main__ import blackout_sequences, check_out, line, read_runs, run_all
from eval.benchmarks.loops.processes import Alternating
from eval.benchmarks.loops.runs import Fed, Run, Task, Turns, Watched, carry_out, joined_world, resident_bytes
from eval.benchmarks.loops.tables import blackout_table, revisit_table
from eval.scoring.blackout import without_view
from eval.suites.suite import Sequence

SYSTEM = '''
"""A line with loops."""
import numpy as np
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, Segment, SparseMap, Status


class Line:
    """Moves along x; tells of a loop if it may."""

    name = "line"

    def __init__(self, loops: bool = True) -> None:
        self.loops, self.times = loops, []

    def track(self, frame):
        self.times.append(frame.timestamp)
        return Estimate(frame.timestamp, self.poses()[-1], Status.TRACKING)

    def poses(self):
        t = np.array(self.times)
        return np.stack([t, 0 * t, 0 * t, 0 * t, 0 * t, 0 * t, 1 + 0 * t], 1)

    def finish(self):
        track = Trajectory(np.array(self.times), self.poses())
        segments = (Segment(track, self.times[0], self.times[-1]),)
        loops = [{"from": self.times[-1], "to": self.times[0], "inliers": 0.7}]
        info = {"keyframes": 6, **({"loops": loops} if self.loops else {})}
        return Result(track, SparseMap(), len(track), 0, info, segments)
'''
OPTIONS = {"kind": "return", "frames": 24, "fps": 2.0, "seed": 3_900_000_009, "family": "gallery", "apart": True,
           "width": 64, "height": 48, "version": 1}  # fmt: skip
SEQUENCE = Sequence("there_and_back", rendered=tuple(sorted(OPTIONS.items())))


@pytest.mark.long
@pytest.mark.parametrize("dark", [False, True])
def test_a_run_from_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dark: bool) -> None:
    pytest.importorskip("evo", reason="evo is in the extra 'eval'")
    monkeypatch.setenv("DVO_CACHE", str(tmp_path))
    (tmp_path / "line.py").write_text(SYSTEM)
    task = Task("blackout" if dark else "revisit", f"{tmp_path / 'line.py'}:Line", SEQUENCE, loops=True, dark=dark)
    run = carry_out(task)
    assert (run.status, run.frames, run.keyframes, run.found) == ("ok", 24, 6, 1)
    assert run.key == task.key and run.joined and 0 < run.joined_ate < 5 and run.false == 0  # it ends where it began
    assert run.p95_ms > 0 and math.isfinite(run.resident_kb) and math.isnan(run.archive_kb)
    assert "1 loops, 0 false" in line(run)
    if not dark:
        assert math.isnan(carry_out(replace(task, loops=False)).found)


@pytest.mark.slow
def test_two_runs_take_turns_and_find_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("evo", reason="evo is in the extra 'eval'")
    monkeypatch.setenv("DVO_CACHE", str(tmp_path))
    (tmp_path / "line.py").write_text(SYSTEM)
    task = Task("revisit", f"{tmp_path / 'line.py'}:Line", SEQUENCE, loops=False)
    do = Alternating()
    runs = [do(task), do(replace(task, loops=True))]
    assert [run.loops for run in runs] == [False, True] and runs[1].found == 1
    assert [run.ate_percent for run in runs] == [carry_out(replace(task, loops=on)).ate_percent for on in (False, True)]


def test_a_frame_is_read_in_its_turn() -> None:
    """Two alternations of the same process: each reads and tracks one frame while the other waits."""
    events: list[tuple[int, str]] = []
    one, two = threading.Semaphore(1), threading.Semaphore(0)

    class Still:
        name = "still"

        def __init__(self, number: int) -> None:
            self.number = number

        def track(self, frame: int) -> None:
            events.append((self.number, f"track {frame}"))

    def frames(number: int) -> Iterator[int]:
        for frame in range(3):
            events.append((number, f"read {frame}"))
            yield frame

    def go(number: int, turns: Turns) -> None:
        watched = Watched(Still(number), turns)
        for frame in Fed(frames(number), None, None, 0, turns):
            watched.track(frame)

    threads = [threading.Thread(target=go, args=(k, Turns(*pair))) for k, pair in enumerate([(one, two), (two, one)])]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert events == [(k, f"{what} {frame}") for frame in range(3) for k in (0, 1) for what in ("read", "track")]


def test_darkness_is_in_its_span_and_shows_nothing() -> None:
    rng = np.random.default_rng(0)
    camera = Camera(40, 40, 31.5, 23.5, 64, 48)
    frames = [Frame(k, float(k), rng.integers(0, 256, (48, 64, 3), np.uint8), camera) for k in range(9)]
    fed = list(Fed(frames, 8, (2.5, 5.5), seed=0))
    assert [without_view(frame.image) for frame in fed if 2.5 < frame.timestamp < 5.5] == [True] * 3
    assert all(one is other for one, other in zip(fed[:3], frames[:3], strict=True)) and len(fed) == 8
    assert len(list(Fed(frames, None, None, seed=0))) == 9


class Untold:
    """Odometry of which nothing is known but its name."""

    name = "untold"


def test_growth_is_that_of_what_stays() -> None:
    watched, frames = Watched(Untold()), np.arange(1200)  # type: ignore[arg-type]
    searching = 60_000_000 * ((frames > 800) & (frames % 30 < 8))  # memory of searches, which begin late
    filling = 1e8 * np.minimum(frames / 200, 1)
    watched.resident = (5e8 + filling + searching + 20_000.0 * frames).astype(int).tolist()
    assert watched.growth_kb(240) == pytest.approx(20 * 1200 / 240, rel=0.01)
    watched.keyframes = np.minimum(frames, 900).tolist()
    watched.resident = (5e8 + searching + 70_000.0 * np.minimum(frames, 900)).astype(int).tolist()
    assert watched.growth_kb(7) == pytest.approx(70, rel=0.01)
    watched.keyframes = [3] * len(frames)
    assert math.isnan(watched.growth_kb(7))
    watched.resident = watched.resident[:5]
    assert math.isnan(watched.growth_kb(7))


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="needs Linux")
def test_pages_of_files_are_not_counted(tmp_path: Path) -> None:
    file, size = tmp_path / "data", 2**24
    file.write_bytes(bytes(size))
    before = resident_bytes()
    mapped = np.memmap(file, np.uint8, "r")
    assert int(mapped.sum()) == 0 and resident_bytes() < before + size / 2
    held = ArrayStorage().keep(np.ones(size, np.uint8))  # in a mapping of its own: the heap may have room
    assert resident_bytes() > before + size / 2 and held.all()


def track(begin: int, end: int, shift: float = 0.0) -> Trajectory:
    s = np.arange(begin, end) / 10
    rows = np.column_stack([np.cos(s) + shift, np.sin(s), 0.1 * s, *np.zeros((3, len(s))), np.ones(len(s))])
    return Trajectory(s, rows)


def test_worlds_that_go_on_after_the_middle() -> None:
    truth, stamps = track(0, 100), np.r_[0:40, 60:100] / 10
    first, second = (Segment(track(a, b, shift), a / 10, b / 10) for a, b, shift in ((0, 40, 0.0), (60, 100, 3.0)))
    apart, error = joined_world((first, second), truth, stamps, 5.0)
    assert not apart and error < 1e-9
    joined, error = joined_world((first, replace(second, joined_to=0)), truth, stamps, 5.0)
    assert joined and error > 0.1
    assert joined_world((Segment(truth, 0.0, 9.9),), truth, stamps, 5.0)[0]
    short = Segment(track(60, 75), 6.0, 7.4, joined_to=0)
    assert not joined_world((first, short), truth, stamps, 5.0)[0]
    assert joined_world((), truth, stamps, 5.0) == (False, pytest.approx(math.nan, nan_ok=True))


def make(task: Task) -> Run:
    return Run(key=task.key, mode=task.mode, system=task.system, sequence=task.sequence.name, loops=task.loops,
               dark=task.dark, status="ok", ate_percent=2.0 - task.loops, found=4.0, false=0.0)  # fmt: skip


def test_going_on_from_the_lines_of_before(tmp_path: Path) -> None:
    out = tmp_path / "runs.jsonl"
    wanted = [Task("revisit", "s", SEQUENCE, loops) for loops in (False, True)]
    made: list[Task] = []

    def do(task: Task) -> Run:
        made.append(task)
        return make(task)

    first = run_all(wanted, out, do, lambda _: None)
    assert made == wanted and len(out.read_text().splitlines()) == 2
    assert json.dumps([run.key for run in read_runs(out)]) == json.dumps([task.key for task in wanted])
    again = run_all([*wanted, replace(wanted[0], seed=1)], out, do, lambda _: None)
    assert made == [*wanted, replace(wanted[0], seed=1)]
    assert [run.ate_percent for run in again[:2]] == [run.ate_percent for run in first]
    assert math.isnan(again[0].recall)
    out.write_text(out.read_text()[:-40])  # killed while it wrote the last line
    assert len(read_runs(out)) == 2
    run_all([replace(wanted[0], seed=1)], out, do, lambda _: None)
    assert len(made) == 4 and len(read_runs(out)) == 3
    out.write_text("no runs\nat all\n")
    with pytest.raises(DvoError, match="not runs of this benchmark"):
        read_runs(out)


def test_a_file_that_cannot_be_written_is_told_before_the_first_run(tmp_path: Path) -> None:
    check_out(tmp_path / "new" / "runs.jsonl")
    assert read_runs(tmp_path / "new" / "runs.jsonl") == []
    with pytest.raises(DvoError, match="--out"):
        check_out(tmp_path)


def test_tables() -> None:
    off = Run(sequence="a", loops=False, status="ok", frames=1200, ate_percent=8.0, p95_ms=90.0, archive_kb=30.0)
    on = replace(off, loops=True, ate_percent=2.0, found=9.0, false=1.0, revisit_s=40.0, recall=0.5, p95_ms=120.0)
    other = [replace(run, sequence="b", revisit_s=10.0, recall=1.0, status="lost", found=1.0) for run in (off, on)]
    rows = revisit_table([off, on, *other]).splitlines()
    assert [cell.strip() for cell in rows[2].split("|")[2:10]] == ["1200", "8.00", "2.00", "9", "1", "40", "50", "90"]
    assert "| lost | lost |" in rows[3]
    assert [cell.strip() for cell in rows[4].split("|")[3:9]] == ["–", "–", "10", "2", "50", "60"]
    dark = Run(mode="blackout", sequence="a", dark=True, joined=True, joined_ate=0.2, found=3.0, false=0.0)
    bright = replace(dark, dark=False, joined_ate=0.1)
    lost = [replace(run, sequence="b", joined=not run.dark) for run in (bright, dark)]
    table = blackout_table([bright, dark, *lost]).splitlines()
    assert "| a | yes | 3 | 0 | 0.2000 | 0.1000 | 2.00 |" in table[2] and "| b | no |" in table[3]
    assert table[-1] == "joined 1 of 2, 0 false loops, median ratio of the ATE –"
    assert "ATE – " in blackout_table([]).splitlines()[-1] + " "


def test_sequences_that_look_back() -> None:
    sequences = blackout_sequences(20)
    options = [dict(one.rendered or ()) for one in sequences]
    assert len({one["seed"] for one in options}) == 20 and {one["kind"] for one in options} == {"return"}
    assert len({one["family"] for one in options}) == 3 and all(one["apart"] for one in options)
    assert {one["frames"] / one["fps"] for one in options} == {20.0}
