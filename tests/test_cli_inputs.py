"""``dvo run`` with options about its input."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.data.trajectory import read_tum
from tests.command_line import arguments, errors, summary


@pytest.fixture
def images(tmp_path):
    """Twenty images at 10 Hz with calibration and times beside them."""
    folder, draw = tmp_path / "clip" / "images", np.random.default_rng(0)
    folder.mkdir(parents=True)
    for index in range(20):
        assert cv2.imwrite(str(folder / f"{index:03d}.png"), draw.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    (folder.parent / "calib.txt").write_text("50 50 31.5 23.5\n")
    (folder.parent / "times.txt").write_text("".join(f"{5 + 0.1 * i}\n" for i in range(20)))
    return folder


def test_an_interval(given, images, tmp_path):
    odometry = given()
    more = ["--start", "0.4", "--end", "15f", "--stride", "2"]
    assert main(arguments(images, tmp_path / "out", *more)) == 0
    assert [frame.index for frame in odometry.frames] == [4, 6, 8, 10, 12, 14]
    times = read_tum(tmp_path / "out" / "trajectory.txt").timestamps
    assert np.allclose(times, 5 + 0.1 * np.arange(4, 15))
    written = summary(tmp_path / "out")
    assert written["interval"] == {"start": "0.4", "end": "15f"} and written["frames"]["read"] == 11


def test_an_empty_interval_is_one_line(given, images, tmp_path, capsys):
    given()
    assert main(arguments(images, tmp_path / "out", "--start", "3")) == 2
    (line,) = errors(capsys.readouterr().err)
    assert "no frame from 3 s; read were 20 frames, 1.900 s" in line and not (tmp_path / "out").exists()
