"""``dvo run`` with and without a calibration: what it prints, run.json, and calib.txt of the results folder."""

from __future__ import annotations

import json
import os

import pytest

import dvo
from dvo.cli import main
from dvo.commands import camera
from dvo.data.focal_guess import guess_from_angle
from dvo.odometry.calibrate import SelfCalibration


@pytest.fixture(autouse=True)
def fake(monkeypatch, fake_odometry):
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: fake_odometry())


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
        "readout": 0.0, "turned": 0,
    }  # fmt: skip
    told = facts["self_calibration"]
    assert (told["focal"], told["deviation"], told["source"], told["frames"]) == (51.0, 1.5, "self-calibration", 20)
    assert told["image_size"] == [64, 48] and told["guess"]["source"] == "prior"

    again = tmp_path / "again"
    assert main(["run", str(image_folder), "--calib", str(out / "calib.txt"), "--out", str(again)]) == 0
    facts = json.loads((again / "run.json").read_text())
    assert facts["camera"]["fx"] == 51.0 and facts["self_calibration"] is None and len(calibrated) == 1
    assert not (again / "calib.txt").exists()


def test_a_calibration_nearby_is_named_and_that_of_somebody_else_is_kept(image_folder, tmp_path, capsys, calibrated):
    (tmp_path / "calib.txt").write_text("1 2 3 4\n")
    assert main(["run", str(image_folder), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert f"({image_folder.parent / 'calib.txt'} is there: is it the one?)" in said
    assert "was not replaced" in said and (tmp_path / "calib.txt").read_text() == "1 2 3 4\n"


def test_the_file_of_an_earlier_run_does_not_stay(image_folder, tmp_path, calibrated):
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0 and (out / "calib.txt").is_file()
    assert main(["run", str(image_folder), "--calib", "../calib.txt", "--out", str(out)]) == 0
    assert not (out / "calib.txt").exists()


def test_the_file_of_an_earlier_run_stays_if_it_is_given(image_folder, tmp_path, calibrated, monkeypatch):
    out = tmp_path / "out"
    assert main(["run", str(image_folder), "--out", str(out)]) == 0
    assert main(["run", str(image_folder), "--calib", str(out / "calib.txt"), "--out", str(out)]) == 0
    assert (out / "calib.txt").is_file()
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(image_folder), "--calib", "out/calib.txt", "--out", "out"]) == 0
    assert (out / "calib.txt").is_file() and len(calibrated) == 1


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
