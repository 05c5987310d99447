"""Benchmark of a long video."""

from types import SimpleNamespace

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.map.archive import Archive
from eval.benchmarks.long_run import PARTS, STEP, Row, draw, measure, read_csv, table, there_and_back, write_csv

CAMERA = Camera(1.0, 1.0, 2.0, 1.0, width=4, height=2)


def frames(count):
    return [Frame(k, 0.1 * k, np.full((2, 4, 3), k, np.uint8), CAMERA) for k in range(count)]


def test_the_walk_is_played_forwards_and_backwards():
    found = list(there_and_back(frames(4), 10, 0.5))
    assert [int(frame.image[0, 0, 0]) for frame in found] == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    assert [frame.index for frame in found] == list(range(10))
    np.testing.assert_allclose([frame.timestamp for frame in found], 0.5 * np.arange(10))


def rows(count):
    return [Row(STEP * k, 50.0 + k, 70.0, 200.0, 500.0 + 2 * k, float(k), 20 * k, k) for k in range(1, count + 1)]


def test_rows_are_the_same_when_they_are_read_again(tmp_path):
    write_csv(tmp_path / "rows.csv", rows(7))
    assert read_csv(tmp_path / "rows.csv") == rows(7)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DvoError, match="no rows"):
        read_csv(tmp_path / "other.csv")


def test_growth_is_that_of_a_keyframe():
    lines = table(rows(10)).splitlines()
    assert len(lines) == 2 + PARTS
    assert [line.split("|")[5].strip() for line in lines[2:]] == ["–", *["100"] * 4]  # 2 MB for 20 keyframes
    draw_lines = lines[-1].split("|")
    assert draw_lines[1].strip() == f"to {10 * STEP}"


def test_the_drawing_is_an_svg(tmp_path):
    pytest.importorskip("matplotlib")
    draw(tmp_path / "a.svg", rows(5))
    assert (tmp_path / "a.svg").read_text().lstrip().startswith("<?xml")


def test_a_row_is_of_the_frames_since_the_last_one():
    archive = Archive()
    odometry = SimpleNamespace(
        track=lambda frame: None, graph=SimpleNamespace(archive=archive), loops=SimpleNamespace(loops=[])
    )
    found = list(measure(odometry, there_and_back(frames(5), 2 * STEP + 7, 0.1)))
    assert [row.frame for row in found] == [STEP, 2 * STEP] and all(row.archive_mb == 0.0 for row in found)
    assert all(0 <= row.median_ms <= row.p95_ms <= row.worst_ms and row.keyframes == 0 for row in found)
