"""``dvo run`` with options about its input."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.data.extrinsics import base_trajectory
from dvo.data.trajectory import read_tum
from tests.support.command_line import arguments, errors, summary


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


SEGMENT = {"segment": 0, "source": "height", "factor": 1.6, "deviation": 0.02, "observations": 9}


@pytest.mark.parametrize("scale", [None, {"source": "height", "unit": "metres", "segments": [SEGMENT]}])
def test_extrinsics(given, images, tmp_path, capsys, monkeypatch, scale):
    odometry = given()
    finish = odometry.finish

    def known():
        result = finish()
        return replace(result, info=result.info | ({} if scale is None else {"scale": scale}))

    odometry.finish = known
    (tmp_path / "rig.txt").write_text("0 0 1.5  0 0 0 1\n")
    out = tmp_path / "out"
    assert main(arguments(images, out, "--extrinsics", str(tmp_path / "rig.txt"))) == 0
    cameras, bases = read_tum(out / "trajectory.txt"), read_tum(out / "trajectory_base.txt")
    wanted = base_trajectory(cameras, np.array([0, 0, 1.5, 0, 0, 0, 1]))
    assert np.array_equal(bases.timestamps, cameras.timestamps) and np.allclose(bases.poses_wc[0], [0] * 6 + [1])
    assert np.allclose(bases.poses_wc, wanted.poses_wc, atol=1e-7)
    assert np.abs(bases.positions - (cameras.positions - cameras.positions[0])).max() > 0.1
    said = errors(capsys.readouterr().err)
    assert sum("lever arm of 1.5 m" in line for line in said) == (scale is None)
    assert ("scale of the trajectory is not known" in (out / "trajectory_base.txt").read_text()) == (scale is None)
    assert sum("lever arm of 1.5 m" in warning for warning in summary(out)["warnings"]) == (scale is None)
    assert summary(out)["extrinsics"] == str(tmp_path / "rig.txt") and summary(out)["finished"]
    assert main(arguments(images, out, "--overwrite")) == 0
    assert not (out / "trajectory_base.txt").exists()


def test_extrinsics_that_are_none_end_before_tracking(given, images, tmp_path, capsys):
    odometry = given()
    (tmp_path / "rig.txt").write_text("0 0 1.5  0 0 0 3\n")
    assert main(arguments(images, tmp_path / "out", "--extrinsics", str(tmp_path / "rig.txt"))) == 2
    (line,) = errors(capsys.readouterr().err)
    assert "quaternion has the length 3" in line and not odometry.frames and not (tmp_path / "out").exists()


def test_extrinsics_beside_the_source(given, images, tmp_path, capsys):
    """A relative path is looked up from the working directory, then from the folder of the source."""
    given()
    (images.parent / "rig.txt").write_text("0 0 0  0 0 0 1\n")
    assert main(arguments(images, tmp_path / "out", "--extrinsics", "../rig.txt")) == 0
    assert len(read_tum(tmp_path / "out" / "trajectory_base.txt")) == 20
    assert main(arguments(images, tmp_path / "other", "--extrinsics", "rig.txt")) == 2
    (line,) = errors(capsys.readouterr().err)
    assert "rig.txt: extrinsics: no such file. Give an existing file to --extrinsics" in line


def test_a_mask(given, images, tmp_path):
    odometry = given()
    mask = np.zeros((48, 64), np.uint8)
    mask[:10] = 255
    assert cv2.imwrite(str(tmp_path / "m.png"), mask)
    more = ["--mask", str(tmp_path / "m.png"), "--mask-invert", "--end", "3f"]
    assert main(arguments(images, tmp_path / "out", *more)) == 0
    assert all(np.array_equal(frame.mask, mask == 0) for frame in odometry.frames) and len(odometry.frames) == 3
    assert summary(tmp_path / "out")["mask"] == {"file": str(tmp_path / "m.png"), "inverted": True}


def test_large_images_are_reduced(given, images, tmp_path):
    """The frames are smaller; the trajectory, the calibration and the camera of run.json are those of the images."""
    written = []
    for number, (limit, size) in enumerate([(1000, (24, 32, 3)), (0, (48, 64, 3))]):
        odometry = given()
        assert main(arguments(images, tmp_path / str(number), "--max-pixels", str(limit))) == 0
        assert {frame.image.shape for frame in odometry.frames} == {size}
        camera = summary(tmp_path / str(number))["camera"]
        assert (camera["fx"], camera["cx"], camera["width"], camera["height"]) == (50, 31.5, 64, 48)
        assert camera["reduced_by"] == (1 if limit == 0 else 2)
        assert odometry.frames[0].camera.fx == (50 if limit == 0 else 25)
        written.append((tmp_path / str(number) / "trajectory.txt").read_bytes())
    assert written[0] == written[1]


def test_span_rate_and_origin_of_the_calibration(given, images, tmp_path, capsys):
    given()
    (images.parent / "times.txt").write_text("".join(f"{i:03d} {100 * i + 7} 4.{i}\n" for i in range(20)))
    assert main(["run", str(images.parent), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "20 images in 1.9 s, 10 a second" in said and "taken for milliseconds" in said
    assert summary(tmp_path / "out")["calibration"] == str(images.parent / "calib.txt")


def test_a_folder_whose_name_is_no_utf8(given, images, tmp_path, capsys):
    given()
    odd = images.rename(images.parent / b"caf\xe9".decode("utf-8", "surrogateescape"))
    (odd / b"00\xe9.png".decode("utf-8", "surrogateescape")).write_bytes(b"no image")
    out = tmp_path / "out"
    assert main(arguments(odd, out, "--calib", "../calib.txt", "--times", str(_times(tmp_path)))) == 0
    assert (out / "summary.html").exists() and (out / "trajectory.png").exists()
    assert any("00\\xe9.png" in text for text in summary(out)["warnings"])


def _times(folder):
    file = folder / "t.txt"
    file.write_text("".join(f"{0.1 * i}\n" for i in range(21)))
    return file


def test_inertial_samples_that_frames_carry_are_told(given, images, tmp_path, capsys):
    given()
    data = tmp_path / "s" / "mav0" / "cam0" / "data"
    data.parent.mkdir(parents=True)
    images.rename(data)
    images.parent.joinpath("times.txt").unlink()
    (data.parent.parent / "imu0").mkdir()
    rows = "".join(f"{k * 5_000_000},0,0,0,0,0,9.8\n" for k in range(100))
    (data.parent.parent / "imu0" / "data.csv").write_text(rows)
    calib = str(images.parent / "calib.txt")
    assert main(["run", str(tmp_path / "s"), "--out", str(tmp_path / "out"), "--calib", calib, "--fps", "10"]) == 0
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("inertial:"))
    assert "100 samples, 200 a second, of imu0/data.csv" in line and "that of a phone is assumed" in line
    facts = json.loads((tmp_path / "out" / "run.json").read_text())
    assert facts["inertial"] == {"origin": "imu0/data.csv", "count": 100, "rate": pytest.approx(200), "noise": None,
                                 "T_camera_imu": None} and facts["gps"] is None  # fmt: skip
    assert main(["run", str(tmp_path / "s"), "--out", str(tmp_path / "none"), "--calib", calib, "--fps", "10",
                 "--imu", "none"]) == 0  # fmt: skip
    assert "inertial" not in capsys.readouterr().err
    assert json.loads((tmp_path / "none" / "run.json").read_text())["inertial"] is None
