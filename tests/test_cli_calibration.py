"""``dvo run`` with and without a calibration: what it prints, run.json, and calib.txt of the results folder."""

from __future__ import annotations

import json
import os

import pytest

import dvo
from dvo.cli import main
from dvo.commands import camera
from dvo.data.calibration.calibration import FOUND
from dvo.data.calibration.focal_guess import guess_from_angle
from dvo.odometry.calibration.camera_estimate import SelfCalibration
from tests.support.command_line import without_plots


@pytest.fixture(autouse=True)
def fake(monkeypatch, fake_odometry):
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: fake_odometry())
    without_plots(monkeypatch)


@pytest.fixture
def calibrated(monkeypatch):
    """Stands in for the calibration; the list receives the sources that it is called with."""
    sources = []

    def calibrate(source, **options):
        sources.append(source)
        assert options["weights"] == "small", "the fake odometry keeps no measurements"
        return SelfCalibration(51.0, 1.5, "self-calibration", 64, 48, 20, "", guess_from_angle(64, 48))

    monkeypatch.setattr(camera, "calibrate", calibrate)
    return sources


@pytest.fixture
def guessed(monkeypatch):
    """Stands in for a calibration that cannot tell: a picture between bars, whose guess is not that of the images."""
    kept = SelfCalibration(47.0, 12.0, "prior", 64, 48, 0, "the motion does not tell", guess_from_angle(64, 48))
    monkeypatch.setattr(camera, "calibrate", lambda source, **options: kept)


def test_a_focal_length_that_is_found(image_folder, tmp_path, capsys, calibrated):
    (image_folder.parent / "calib.txt").unlink()
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "focal length 51 +- 2 px (self-calibrated from 20 frames)" in said.out
    assert "no calibration: looking for the focal length in the images" in said.err
    assert calibrated[0].guess.source == "prior"
    facts = json.loads((out / "run.json").read_text())
    assert facts["calibration"] is None
    assert facts["camera"] == {
        "fx": 51.0, "fy": 51.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "model": "none", "coefficients": [],
        "readout": 0.0, "turned": 0, "reduced_by": 1,
    }  # fmt: skip
    told = facts["self_calibration"]
    assert (told["focal"], told["deviation"], told["source"], told["frames"]) == (51.0, 1.5, "self-calibration", 20)
    assert told["image_size"] == [64, 48] and told["guess"]["source"] == "prior"

    again = tmp_path / "again"
    assert main(["run", str(image_folder), "--calib", str(out / "calib.txt"), "--out", str(again)]) == 0
    facts = json.loads((again / "run.json").read_text())
    assert facts["camera"]["fx"] == 51.0 and facts["self_calibration"] is None and len(calibrated) == 1
    assert not (again / "calib.txt").exists()


def test_a_guess_that_is_kept_is_no_calibration_of_the_next_run(image_folder, tmp_path, capsys, guessed):
    """No file is written, that of an earlier run goes, and an export after the run has the camera of the run."""
    (image_folder.parent / "calib.txt").unlink()
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "cannot tell (the motion does not tell): keeps 47 +- 12 px" in said.out
    assert "note: the focal length is a guess: no calib.txt for the next run" in said.err
    facts = json.loads((out / "run.json").read_text())
    assert facts["calibration_file"] is None and "calib.txt" not in facts["files"]
    assert facts["self_calibration"]["source"] == "prior" and not (out / "calib.txt").exists()

    place = tmp_path / "colmap"
    assert main(["export", str(out), str(place), "--to", "colmap-text", "--export-images", "source"]) == 0
    model = (place / "sparse" / "0" / "cameras.txt").read_text().splitlines()[-1].split()
    assert [float(x) for x in model[4:]] == [47, 47, 32, 24]
    assert not dvo.open(image_folder, calib=place / "sparse" / "0" / "cameras.txt").calibrated
    facts["camera"]["model"] = "pinhoel"
    (out / "run.json").write_text(json.dumps(facts))
    assert main(["export", str(out), str(tmp_path / "no"), "--to", "colmap", "--export-images", "source"]) == 2
    assert "run.json: camera" in capsys.readouterr().err


def test_a_guess_removes_the_file_of_an_earlier_run(image_folder, tmp_path, calibrated, request):
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0 and (out / "calib.txt").is_file()
    request.getfixturevalue("guessed")
    assert main(["run", str(image_folder), "--out", str(out), "--overwrite"]) == 0
    assert not (out / "calib.txt").exists()


def test_what_was_found_in_images_stays_so_in_a_file(image_folder, tmp_path, calibrated):
    """The verdict is that of the run which has found it; numbers without the first line are those of the user."""
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0
    assert not dvo.open(image_folder, calib=out / "calib.txt").calibrated
    found = SelfCalibration(51.0, 1.5, "self-calibration", 64, 48, 20, "", guess_from_angle(64, 48))
    assert not dvo.open(image_folder, calib=found.calibration).calibrated
    (out / "calib.txt").write_text("51 51 31.5 23.5\n")
    assert dvo.open(image_folder, calib=out / "calib.txt").calibrated


@pytest.mark.parametrize(("name", "file"), [("colmap-text", "sparse/0/cameras.txt"), ("nerfstudio", "transforms.json")])
def test_what_was_found_in_images_stays_so_in_an_export(name, file, image_folder, tmp_path, calibrated):
    out = tmp_path / "out"
    export = ["--export", name, "--export-images", "source"]
    assert main(["run", str(image_folder), "--out", str(out), *export]) == 0
    later = tmp_path / "later"
    assert main(["export", str(out), str(later), "--to", name, "--export-images", "source"]) == 0
    for place in (out / "export" / name, later):
        source = dvo.open(image_folder, calib=place / file)
        assert not source.calibrated and FOUND not in source.calibration.ignored
    given = tmp_path / "given"
    calib = ["--calib", str(image_folder.parent / "calib.txt")]
    assert main(["run", str(image_folder), "--out", str(given), *calib, *export]) == 0
    assert dvo.open(image_folder, calib=given / "export" / name / file).calibrated


def test_a_calibration_nearby_is_named_and_that_of_somebody_else_is_kept(image_folder, tmp_path, capsys, calibrated):
    (tmp_path / "calib.txt").write_text("1 2 3 4\n")
    assert main(["run", str(image_folder), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert f"({image_folder.parent / 'calib.txt'} is there: is it the one?)" in said
    assert "was not replaced" in said and (tmp_path / "calib.txt").read_text() == "1 2 3 4\n"


def test_the_file_of_an_earlier_run_does_not_stay(image_folder, tmp_path, calibrated):
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0 and (out / "calib.txt").is_file()
    assert main(["run", str(image_folder), "--calib", "../calib.txt", "--out", str(out), "--overwrite"]) == 0
    assert not (out / "calib.txt").exists()


def test_the_file_of_an_earlier_run_stays_if_it_is_given(image_folder, tmp_path, calibrated, monkeypatch):
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0
    assert main(["run", str(image_folder), "--calib", str(out / "calib.txt"), "--out", str(out), "--overwrite"]) == 0
    assert (out / "calib.txt").is_file()
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(image_folder), "--calib", "out/calib.txt", "--out", "out", "--overwrite"]) == 0
    assert (out / "calib.txt").is_file() and len(calibrated) == 1


@pytest.mark.long
def test_images_that_tell_nothing_are_tracked_with_the_guess(image_folder, tmp_path, capsys):
    """With the real network: images of noise."""
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0
    assert "cannot tell (too few frames could be tracked): keeps 51 +- 13 px" in capsys.readouterr().out
    facts = json.loads((out / "run.json").read_text())
    assert facts["self_calibration"]["source"] == "prior" and facts["self_calibration"]["reason"]
    assert facts["camera"]["fx"] == pytest.approx(51.2, abs=0.1)


def test_a_calibration_from_a_pipe(image_folder, tmp_path):
    read, write = os.pipe()
    os.write(write, b"fx=52 fy=52 cx=31.5 cy=23.5\n")
    os.close(write)
    try:
        code = main(["run", str(image_folder), "--calib", f"/dev/fd/{read}", "--out", str(tmp_path / "out")])
    finally:
        os.close(read)
    assert code == 0 and json.loads((tmp_path / "out" / "run.json").read_text())["camera"]["fx"] == 52


DIALECTS = {
    "text": ("calib.txt", "50 51 31 23 -0.1 0.01 0.001 0.002 0.003"),
    "names": ("calib.txt", "fx=50 fy=51 cx=31 cy=23 k1=-0.1 k2=0.01 p1=0.001 p2=0.002 k3=0.003"),
    "euroc": (
        "sensor.yaml",
        "sensor_type: camera\nresolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [50, 51, 31, 23]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 0.001, 0.002, 0.003]\n",
    ),
    "kalibr": (
        "camchain.yaml",
        "cam0:\n  camera_model: pinhole\n  intrinsics: [50, 51, 31, 23]\n  distortion_model: radtan\n"
        "  distortion_coeffs: [-0.1, 0.01, 0.001, 0.002, 0.003]\n  resolution: [64, 48]\n",
    ),
    "opencv": (
        "opencv.yml",
        "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
        "   dt: d\n   data: [ 50., 0., 31., 0., 51., 23., 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n"
        "   rows: 5\n   cols: 1\n   dt: d\n   data: [ -0.1, 0.01, 0.001, 0.002, 0.003 ]\n",
    ),
    "ros": (
        "ost.yaml",
        "image_width: 64\nimage_height: 48\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [50, 0, 31, 0, 51, 23, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.001, 0.002, 0.003]}\n",
    ),
    "orbslam": (
        "orbslam.yaml",
        "%YAML:1.0\nCamera.type: PinHole\nCamera.fx: 50.0\nCamera.fy: 51.0\nCamera.cx: 31.0\nCamera.cy: 23.0\n"
        "Camera.k1: -0.1\nCamera.k2: 0.01\nCamera.p1: 0.001\nCamera.p2: 0.002\nCamera.k3: 0.003\n"
        "Camera.width: 64\nCamera.height: 48\n",
    ),
    "orbslam3": (
        "orbslam3.yaml",
        "%YAML:1.0\nCamera.type: PinHole\nCamera1.fx: 50.0\nCamera1.fy: 51.0\nCamera1.cx: 31.0\nCamera1.cy: 23.0\n"
        "Camera1.k1: -0.1\nCamera1.k2: 0.01\nCamera1.p1: 0.001\nCamera1.p2: 0.002\nCamera1.k3: 0.003\n",
    ),
    "colmap": (
        "cameras.txt",
        "# Camera list\n1 FULL_OPENCV 64 48 50 51 31.5 23.5 -0.1 0.01 0.001 0.002 0.003 0 0 0\n",
    ),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_that_calib_takes(dialect, image_folder, tmp_path):
    name, text = DIALECTS[dialect]
    (tmp_path / name).write_text(text)
    assert main(["run", str(image_folder), "--calib", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 0
    used = json.loads((tmp_path / "out" / "run.json").read_text())["camera"]
    assert [used[key] for key in ("fx", "fy", "cx", "cy")] == [50, 51, 31, 23]
    assert used["model"] == "radtan" and used["coefficients"] == [-0.1, 0.01, 0.001, 0.002, 0.003]


def test_a_camera_of_a_colmap_model_by_its_number(image_folder, tmp_path, capsys):
    cameras = image_folder.parent / "cameras.txt"  # found from the folder of the images, as other calibrations
    cameras.write_text("1 PINHOLE 320 240 200 200 160 120\n7 OPENCV_FISHEYE 64 48 50 51 31.5 23.5 0.1 0 0 0\n")
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--calib", "../cameras.txt", "--out", str(out)]) == 2
    assert "2 cameras in it: 1, 7. Name one: cameras.txt:1." in capsys.readouterr().err
    assert main(["run", str(image_folder), "--calib", "../cameras.txt:1", "--out", str(out)]) == 2
    assert "calibration is for 320x240 images" in capsys.readouterr().err
    assert main(["run", str(image_folder), "--calib", "../cameras.txt:7", "--out", str(out)]) == 0
    used = json.loads((out / "run.json").read_text())["camera"]
    assert (used["model"], used["cx"], used["cy"]) == ("fisheye", 31, 23)
