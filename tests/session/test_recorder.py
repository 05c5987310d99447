"""Results while a run goes on: after every frame they are read back as a crash at that moment would leave them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory, read_tum
from dvo.geometry.camera import Camera
from dvo.odometry.protocol import Break, Estimate, Interim, Result, Segment, SparseMap, Status
from dvo.session.recorder import Recorder

resource = pytest.importorskip("resource")  # limits of files, which Windows does not have

IMAGE, CAMERA = np.zeros((48, 64, 3), np.uint8), Camera(50, 50, 31.5, 23.5, 64, 48)
POSE = np.array([1.0, 2, 3, 0, 0, 0, 1])


class Clock:
    """Time that passes only when told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Silent:
    """An odometry without a result so far."""

    name = "silent"

    def track(self, frame: Frame) -> Estimate:
        raise AssertionError

    def finish(self) -> Result:
        raise AssertionError


class Telling(Silent):
    """An odometry that gives its result so far, and counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0

    def current(self) -> Result:
        self.asked += 1
        times = np.arange(2.0)
        segment = Segment(Trajectory(times, np.tile(POSE, (2, 1))), 0.0, 1.0)
        points = SparseMap(np.ones((4, 3), np.float32), np.ones((4, 3), np.uint8))
        return Result(segment.trajectory, points, 2, 0, {}, (segment,), (Break(1.0, None, 3, "black image"),))


class Run:
    """A recorder that is fed frame by frame."""

    def __init__(self, folder: Path, odometry: Any = None, **options: Any) -> None:
        self.folder, self.clock, self.warned = folder, Clock(), []
        self.odometry = odometry or Silent()
        self.recorder = Recorder(
            folder, self.odometry, {"seed": 7}, warn=self.warned.append, clock=self.clock, **options
        )
        self.count = 0

    def feed(self, segment: int = 0, *, lost: bool = False, skipped: bool = False, after: float = 0.05) -> None:
        self.clock.now += after
        frame = Frame(self.count, 0.1 * self.count, IMAGE, CAMERA)
        pose = POSE * [1 + segment, 1, 1, 1, 1, 1, 1]
        if skipped:
            estimate = None
        elif lost:
            estimate = Estimate(frame.timestamp, None, Status.LOST, 0.0, segment, "black image")
        else:
            estimate = Estimate(frame.timestamp, pose, Status.TRACKING, 1.0, segment)
        self.recorder.update(frame, estimate)
        self.count += 1

    def rows(self, name: str = "trajectory.txt") -> list[int]:
        """Numbers of the frames in a file."""
        lines = (self.folder / name).read_text().splitlines()
        if len(lines) == 1 and lines[0].startswith("#"):
            return []
        return np.round(read_tum(self.folder / name).timestamps * 10).astype(int).tolist()

    def summary(self) -> dict:
        return json.loads((self.folder / "run.json").read_text())


@pytest.fixture
def small_files() -> Iterator[Any]:
    """``small_files(size)`` lets no file grow beyond ``size`` bytes, as on a full disk; None lifts the limit."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def limit(size: int | None) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, before if size is None else (size, before[1]))

    yield limit
    limit(None)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_every_row_is_there_as_soon_as_its_frame_is_tracked(tmp_path):
    run = Run(tmp_path)
    for number in range(30):
        run.feed(after=3.0 if number == 9 else 0.01)
        assert run.rows() == list(range(number + 1))
    assert names(tmp_path) == ["run.json", "trajectory.txt"]
    np.testing.assert_allclose(read_tum(tmp_path / "trajectory.txt").poses_wc, np.tile(POSE, (30, 1)), atol=1e-9)


def test_frames_without_a_pose_have_no_row(tmp_path):
    run = Run(tmp_path, interval=0.0)
    run.feed(lost=True)
    assert run.rows() == [] and run.summary()["finished"] is False
    run.feed()
    run.feed(skipped=True)
    run.feed(lost=True)
    run.feed()
    assert run.rows() == [1, 4]
    assert run.summary()["frames"] == {"read": 5, "fed": 4, "tracked": 2, "lost": 2}


def test_run_json_is_renewed_at_intervals(tmp_path):
    run = Run(tmp_path, interval=10.0)
    seen = []
    for _ in range(25):
        run.feed(after=1.0)
        seen.append(run.summary()["frames"]["read"])
    assert sorted(set(seen)) == [1, 11, 21]
    written = run.summary()
    assert written["finished"] is False and written["interrupted"] is False and written["seed"] == 7
    assert written["seconds"] == {"elapsed": 21.0} and written["fps"] == pytest.approx(1.0)


def test_the_map_is_written_for_an_odometry_that_tells_its_result_so_far(tmp_path):
    assert isinstance(Telling(), Interim) and not isinstance(Silent(), Interim)
    run = Run(tmp_path, Telling(), interval=10.0)
    for _ in range(15):
        run.feed(after=1.0)
    assert run.odometry.asked == 2, "at the first frame and after ten seconds"
    assert b"element vertex 4" in (tmp_path / "map.ply").read_bytes()
    written = run.summary()
    assert written["map_points"] == 4 and written["breaks"][0]["reason"] == "black image"
    assert written["frames"]["read"] == 11, "counts are frames of the source"


def test_a_lost_frame_that_has_a_row_in_the_result_so_far_is_not_lost(tmp_path):
    run = Run(tmp_path, Telling(), interval=0.0)
    run.feed(lost=True)
    run.feed()
    assert run.summary()["frames"] == {"read": 2, "fed": 2, "tracked": 2, "lost": 0}


def test_segments_have_files_and_the_longest_is_the_trajectory(tmp_path):
    run = Run(tmp_path)
    for _ in range(3):
        run.feed(0)
    assert names(tmp_path) == ["run.json", "trajectory.txt"]
    run.feed(1)
    assert run.rows() == run.rows("trajectory-0.txt") == [0, 1, 2] and run.rows("trajectory-1.txt") == [3]
    run.feed(1)
    run.feed(1)
    assert run.rows() == [0, 1, 2], "as long is not longer"
    run.feed(1)
    assert run.rows() == run.rows("trajectory-1.txt") == [3, 4, 5, 6] and run.rows("trajectory-0.txt") == [0, 1, 2]
    run.feed(0)
    run.feed(0)
    assert run.rows() == run.rows("trajectory-0.txt") == [0, 1, 2, 7, 8], "an earlier segment may go on"
    assert (tmp_path / "trajectory.txt").read_bytes() == (tmp_path / "trajectory-0.txt").read_bytes()
    run.recorder.stop(interrupted=False, reason="")
    segments = run.summary()["segments"]
    assert [(s["frames"], s["file"]) for s in segments] == [(5, "trajectory-0.txt"), (4, "trajectory-1.txt")]


def test_results_of_an_earlier_run_go_at_the_first_frame(tmp_path):
    old = ("trajectory.txt", "trajectory-0.txt", "trajectory-12.txt", "map.ply", "trajectory.png", "frames.csv")
    for name in (*old, "summary.html"):  # the last one is not of that run
        (tmp_path / name).write_text("old")
    facts = {"odometry": "old", "versions": {"dvo": "0"}, "finished": True, "files": ["run.json", *old]}
    (tmp_path / "run.json").write_text(json.dumps(facts))
    (tmp_path / "notes.txt").write_text("mine")
    run = Run(tmp_path)
    assert len(names(tmp_path)) == 9, "a run that fails before its first frame changes nothing"
    run.feed()
    assert names(tmp_path) == ["notes.txt", "run.json", "summary.html", "trajectory.txt"]


def test_a_stop_before_the_first_frame_writes_nothing(tmp_path):
    Run(tmp_path).recorder.stop(interrupted=True, reason="no")
    assert names(tmp_path) == []


def test_a_stop_says_what_happened(tmp_path):
    run = Run(tmp_path)
    run.feed()
    run.feed()
    run.recorder.stop(interrupted=True, reason="aborted")
    written = run.summary()
    assert (written["interrupted"], written["finished"], written["warnings"]) == (True, False, ["aborted"])
    assert written["frames"]["tracked"] == 2


@pytest.mark.parametrize("size", range(900, 1100, 37))
def test_a_full_disk_is_warned_of_once_and_cuts_no_row(tmp_path, small_files, size):
    """The system writes part of a row and then fails: that part must go. With space again, every row is written."""
    run = Run(tmp_path, interval=1e9)
    run.feed()
    small_files(size)
    for _ in range(20):
        run.feed()
        assert run.rows() == list(range(len(run.rows()))), "whole rows in order, nothing else"
    assert 5 < len(run.rows()) < 15
    (warning,) = run.warned
    assert str(tmp_path) in warning and "tracking goes on" in warning and "\n" not in warning
    small_files(None)
    run.feed()
    assert run.rows() == list(range(22)) and run.recorder.warnings == [warning]
    run.recorder.stop(interrupted=False, reason="end")
    assert run.summary()["warnings"] == [warning, "end"]


def test_a_full_disk_when_another_segment_begins(tmp_path, small_files):
    run = Run(tmp_path, interval=1e9)
    for _ in range(4):
        run.feed(0)
    small_files(100)
    for _ in range(6):
        run.feed(1)
    assert run.rows() == [0, 1, 2, 3] and len(run.warned) == 1, "a replacement that fails leaves the old rows"
    small_files(None)
    run.feed(1)
    assert len(run.warned) == 1
    assert run.rows() == run.rows("trajectory-1.txt") == list(range(4, 11))
    assert run.rows("trajectory-0.txt") == [0, 1, 2, 3]


def test_a_file_that_fails_does_not_keep_the_others_from_their_rows(tmp_path):
    run = Run(tmp_path, interval=1e9)
    for segment in (0, 0, 1):
        run.feed(segment)
    (tmp_path / "trajectory.txt").unlink()
    (tmp_path / "trajectory.txt").mkdir()
    for _ in range(3):
        run.feed(1)
    assert run.rows("trajectory-1.txt") == [2, 3, 4, 5] and len(run.warned) == 1


def test_a_row_that_was_cut_off_is_overwritten(tmp_path):
    """As after an interruption in the middle of a write."""
    run = Run(tmp_path)
    run.feed()
    with open(tmp_path / "trajectory.txt", "a") as file:
        file.write("0.100000000 1.00")
    run.feed()
    assert run.rows() == [0, 1]


def test_no_file_handle_is_free(tmp_path):
    """EMFILE: other parts of the program hold all of them; then they are released."""
    run = Run(tmp_path)
    run.feed()
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, before[1]))
        run.feed()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert len(run.warned) == 1 and "open files" in run.warned[0].lower()
    run.feed()
    assert run.rows() == [0, 1, 2]


def test_the_folder_disappears(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    run = Run(folder)
    run.feed()
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    run.feed()
    assert len(run.warned) == 1 and "tracking goes on" in run.warned[0]
