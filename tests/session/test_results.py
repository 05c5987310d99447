"""The results folder: its files, its segments, and what happens when it cannot be written."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.files import output
from dvo.data.frame import Frame
from dvo.data.trajectory import read_tum
from dvo.geometry.camera import Camera
from dvo.odometry.protocol import Break, SparseMap
from dvo.session import files, results, session

CAMERA = Camera(50, 50, 31.5, 23.5, 64, 48)


def frames(count: int) -> Iterator[Frame]:
    image = np.zeros((48, 64, 3), np.uint8)
    return (Frame(index, 0.1 * index, image, CAMERA) for index in range(count))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def summary(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text())


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
    files.write_ply(tmp_path / "map.ply", SparseMap(points, colors))
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


def test_a_new_default_folder_is_reserved(tmp_path, monkeypatch):
    """Of two runs that begin in the same second, each has its folder, though the other's is still empty."""
    monkeypatch.chdir(tmp_path)
    with results.results_folder(None, "clip") as first, results.results_folder(None, "clip") as second:
        assert first.is_dir() and second.is_dir() and first != second


def test_a_long_name_of_a_clip_still_makes_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert results.make_folder(None, 250 * "x").is_dir()


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.EMFILE, errno.EACCES])
def test_a_folder_that_cannot_be_written_is_found_at_once(tmp_path, monkeypatch, code):
    def fail(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(results, "check_writable", fail)
    with pytest.raises(DvoError, match=os.strerror(code)) as caught, results.results_folder(tmp_path / "out", "clip"):
        pytest.fail("must not begin")
    assert caught.value.field == "--out" and not (tmp_path / "out").exists()


def test_the_probe_finds_a_full_disk_and_leaves_nothing(tmp_path, monkeypatch):
    output.check_writable(tmp_path)
    assert names(tmp_path) == []

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="full"):
        output.check_writable(tmp_path)
    assert names(tmp_path) == []


def test_a_failed_run_removes_only_a_folder_that_is_new_and_empty(tmp_path):
    (tmp_path / "old").mkdir()
    for name in ("old", "new", "used"):
        with pytest.raises(ZeroDivisionError), results.results_folder(tmp_path / name, "clip") as folder:
            if name == "used":
                (folder / "trajectory.txt").write_text("")
            raise ZeroDivisionError
    assert names(tmp_path) == ["old", "used"]


def test_several_segments_have_a_file_each(fake_odometry, tmp_path):
    done = session.run(fake_odometry(lost=(5, 6), new_segment=(6, 15)), frames(20))
    result = done.result
    joined = replace(result.segments[2], joined_to=0)
    done = replace(done, result=replace(result, segments=(*result.segments[:2], joined)))
    results.write_results(tmp_path, done, {}, segment_facts=[{"ate_rmse": 0.1 * k} for k in range(3)])
    for number, segment in enumerate(result.segments):
        back = read_tum(tmp_path / f"trajectory-{number}.txt")
        np.testing.assert_allclose(back.poses_wc, segment.trajectory.poses_wc, atol=1e-8)
    assert (tmp_path / "trajectory.txt").read_bytes() == (tmp_path / "trajectory-1.txt").read_bytes(), "the longest"
    written = summary(tmp_path)
    assert written["finished"] is True and written["frames"] == {"read": 20, "fed": 20, "tracked": 18, "lost": 2}
    assert [(s["number"], s["frames"], s["joined_to"], s["file"]) for s in written["segments"]] == [
        (0, 5, None, "trajectory-0.txt"),
        (1, 8, None, "trajectory-1.txt"),
        (2, 5, 0, "trajectory-2.txt"),
    ]
    assert written["segments"][1]["start"] == pytest.approx(0.7) and written["segments"][2]["ate_rmse"] == 0.2
    first, second = written["breaks"]
    assert (first["from"], first["to"]) == (pytest.approx(0.4), pytest.approx(0.7))
    assert (first["frames"], first["reason"], first["new_segment"]) == (2, "black image", True)
    assert (second["frames"], second["new_segment"]) == (0, True)


def test_one_segment_has_no_file_of_its_own_and_stale_ones_go(fake_odometry, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "trajectory-best.txt").write_text("mine")
    three = session.run(fake_odometry(new_segment=(3, 6)), frames(9))
    one = session.run(fake_odometry(), frames(9))
    results.write_results(tmp_path, three, {})
    assert {"trajectory-0.txt", "trajectory-2.txt"} <= set(names(tmp_path))
    results.write_results(tmp_path, one, {})
    assert names(tmp_path) == ["map.ply", "notes.txt", "run.json", "trajectory-best.txt", "trajectory.txt"]
    assert summary(tmp_path)["segments"][0]["file"] == "trajectory.txt" and summary(tmp_path)["breaks"] == []


def test_a_break_at_the_ends_has_no_time(fake_odometry, tmp_path):
    done = session.run(fake_odometry(), frames(4))
    done = replace(done, result=replace(done.result, breaks=(Break(None, 0.3, 3, "noise", new_segment=False),)))
    results.write_results(tmp_path, done, {})
    assert summary(tmp_path)["breaks"][0]["from"] is None


def test_a_file_that_fails_leaves_its_old_content_and_the_others_are_written(fake_odometry, tmp_path):
    results.write_results(tmp_path, session.run(fake_odometry(), frames(5)), {}, draw=lambda path: touch(path, b"old"))

    def full(path: Path) -> None:
        touch(path, b"half a pict")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    with pytest.raises(DvoError, match="No space left on device") as caught:
        results.write_results(tmp_path, session.run(fake_odometry(), frames(9)), {"seed": 1}, draw=full)
    assert caught.value.file == tmp_path / "trajectory.png" and "\n" not in str(caught.value)
    assert (tmp_path / "trajectory.png").read_bytes() == b"old"
    assert len(read_tum(tmp_path / "trajectory.txt")) == 9
    written = summary(tmp_path)
    assert written["finished"] is False and "trajectory.png" in written["warnings"][0]
    assert names(tmp_path) == ["map.ply", "run.json", "trajectory.png", "trajectory.txt"], "no half files"


def touch(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert path.suffix == ".png", "the extension selects the format of a picture"
