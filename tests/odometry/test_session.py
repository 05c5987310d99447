"""A session: strides, interruptions, broken frames, and the files of the results folder."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory, read_tum
from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.odometry import results, session
from dvo.odometry.protocol import SparseMap

CAMERA = Camera(50, 50, 31.5, 23.5, 64, 48)


def frames(count: int, broken: int | None = None) -> Iterator[Frame]:
    image = np.zeros((48, 64, 3), np.uint8)
    for index in range(count):
        if index == broken:
            raise DvoError("does not decode", file="clip.mp4", field=f"frame {index}")
        yield Frame(index, 0.1 * index, image, CAMERA)


def test_every_frame_gets_its_row(fake_odometry):
    seen = []
    done = session.run(fake_odometry(), frames(12), on_frame=lambda frame, estimate: seen.append(frame.index))
    assert len(done.result.trajectory) == done.result.frames_read == done.frames_fed == 12
    assert done.result.frames_lost == 0 and done.warnings == () and not done.interrupted
    assert seen == list(range(12))


def test_strided_frames_are_interpolated(fake_odometry):
    odometry = fake_odometry()
    done = session.run(odometry, frames(12), stride=4)
    assert [frame.index for frame in odometry.frames] == [0, 4, 8, 11], "and the last one is fed"
    assert done.frames_fed == 4 and done.result.frames_read == 12
    trajectory = done.result.trajectory
    np.testing.assert_array_equal(trajectory.timestamps, [0.1 * i for i in range(12)])
    truth = np.array([odometry.motion(t) for t in trajectory.timestamps])
    assert np.abs(trajectory.positions - truth[:, :3]).max() < 0.01
    assert np.abs(trajectory.poses_wc[:, 3:] - truth[:, 3:]).max() < 1e-3
    np.testing.assert_array_equal(trajectory.poses_wc[8], truth[8])


def test_a_lost_frame_takes_its_strided_neighbours_along(fake_odometry):
    done = session.run(fake_odometry(lost=(6,)), frames(13), stride=3)
    rows = np.round(done.result.trajectory.timestamps * 10).astype(int)
    assert rows.tolist() == [0, 1, 2, 3, 9, 10, 11, 12]
    assert done.result.frames_lost == 5


def test_stop_keeps_what_was_tracked(fake_odometry):
    odometry = fake_odometry()
    done = session.run(odometry, frames(100), should_stop=lambda: len(odometry.frames) == 7)
    assert done.interrupted and len(done.result.trajectory) == 7
    assert done.warnings == ("interrupted after 7 frames",)


def test_keyboard_interrupt_from_the_source_keeps_what_was_tracked(fake_odometry):
    def interrupted() -> Iterator[Frame]:
        yield from frames(5)
        raise KeyboardInterrupt

    done = session.run(fake_odometry(), interrupted())
    assert done.interrupted and len(done.result.trajectory) == 5


@pytest.mark.parametrize("stride", [1, 2])
def test_broken_frame_keeps_what_was_tracked(fake_odometry, stride):
    done = session.run(fake_odometry(), frames(20, broken=9), stride=stride)
    assert len(done.result.trajectory) == 9 and not done.interrupted
    (warning,) = done.warnings
    assert "stopped at frame 9" in warning and "clip.mp4" in warning


def test_broken_first_frame_is_an_error(fake_odometry):
    with pytest.raises(DvoError, match="does not decode"):
        session.run(fake_odometry(), frames(20, broken=0))


def test_no_frames_is_an_error(fake_odometry):
    with pytest.raises(DvoError, match="no frames"):
        session.run(fake_odometry(), frames(0))


def test_a_bug_is_not_swallowed(fake_odometry):
    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        session.run(fake_odometry(at_frame={3: fail}), frames(5))


def test_results_folder(fake_odometry, tmp_path):
    done = session.run(fake_odometry(lost=(2,)), frames(8))
    results.write_results(tmp_path, done, {"seed": 3, "metrics": {"ate_rmse": float("nan")}})
    back = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(back.poses_wc, done.result.trajectory.poses_wc, atol=1e-8)
    summary = json.loads((tmp_path / "run.json").read_text())
    assert summary["frames"] == {"read": 8, "fed": 8, "tracked": 7, "lost": 1}
    assert summary["seed"] == 3 and summary["config"] == {"patches": 3} and summary["metrics"]["ate_rmse"] is None
    assert {"python", "torch", "dvo", "opencv-python-headless"} <= set(summary["versions"])
    assert summary["fps"] > 0 and 10 < summary["peak_memory_mb"] < 100_000
    assert summary["info"] == {"working_size": [64, 48]}


def test_ply_holds_points_and_colours(tmp_path):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(17, 3)).astype(np.float32)
    colors = rng.integers(0, 255, (17, 3), dtype=np.uint8)
    results.write_ply(tmp_path / "map.ply", SparseMap(points, colors))
    header, body = (tmp_path / "map.ply").read_bytes().split(b"end_header\n")
    assert b"element vertex 17" in header and header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert len(body) == 17 * 15
    first = np.frombuffer(body[:12], "<f4")
    np.testing.assert_array_equal(first, points[0])
    np.testing.assert_array_equal(np.frombuffer(body[12:15], np.uint8), colors[0])


def test_results_folder_that_is_a_file(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(DvoError, match="not a folder"):
        results.make_folder(tmp_path / "taken", "clip")


def test_default_folders_do_not_collide(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert results.make_folder(None, "clip") != results.make_folder(None, "clip")


def test_interpolation_does_not_reach_out_of_the_trajectory():
    trajectory = Trajectory(np.array([1.0, 2.0]), np.tile([0, 0, 0, 0, 0, 0, 1.0], (2, 1)))
    filled = session.fill_skipped(trajectory, np.array([1.0, 2.0]), np.array([0.5, 1.5, 2.5]))
    assert filled.timestamps.tolist() == [1.0, 1.5, 2.0]


def test_strict_raises_instead_of_warning(fake_odometry):
    def stop() -> None:
        raise KeyboardInterrupt

    assert session.run(fake_odometry(), frames(12, broken=5)).warnings
    with pytest.raises(DvoError, match="does not decode"):
        session.run(fake_odometry(), frames(12, broken=5), strict=True)
    with pytest.raises(KeyboardInterrupt):
        session.run(fake_odometry(at_frame={3: stop}), frames(12), strict=True)


def test_every_frame_fed_has_its_time(fake_odometry):
    done = session.run(fake_odometry(), frames(12), stride=4)
    assert len(done.frame_seconds) == done.frames_fed == 4 and min(done.frame_seconds) >= 0
    assert sum(done.frame_seconds) == pytest.approx(done.seconds["tracking"])
