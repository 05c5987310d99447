"""``dvo calibrate``: files, messages and exit codes; the calibration itself is tested in tests/boards."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.commands import calibrate as command
from dvo.data.calibration.focal_guess import guess_from_angle
from dvo.odometry.calibration.camera_estimate import SelfCalibration


@pytest.fixture
def folder(tmp_path):
    """Ten images of a board of 5x4 inner corners, by homographies: a camera of f 200 without distortion."""
    images = tmp_path / "images"
    images.mkdir()
    squares = np.pad(np.kron(np.indices((5, 6)).sum(0) % 2, np.ones((20, 20))), 20, constant_values=1) * 215 + 20
    matrix = np.array([[200.0, 0, 119.5], [0, 200.0, 89.5], [0, 0, 1]])
    to_board = np.array([[0.05, 0, 0.5 * 0.05 - 4.0], [0, 0.05, 0.5 * 0.05 - 3.5], [0, 0, 1]])  # pixels to squares
    rng = np.random.default_rng(0)
    for index in range(10):
        rotation = cv2.Rodrigues(np.array([*rng.uniform(-0.6, 0.6, 2), 0.1]))[0]
        pose = np.column_stack([rotation[:, :2], [*rng.uniform(-1.5, 1.5, 2), rng.uniform(8, 11)]])
        scale = np.array([[3, 0, 1.0], [0, 3, 1.0], [0, 0, 1]])  # three samples a pixel
        fine = cv2.warpPerspective(squares, scale @ matrix @ pose @ to_board, (720, 540), borderValue=128)
        image = cv2.GaussianBlur(cv2.resize(fine, (240, 180), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
        cv2.imwrite(str(images / f"{index}.png"), image.round().astype(np.uint8))
    return images


@pytest.mark.long
def test_calibrates_and_runs_with_the_file(folder, tmp_path, capsys, monkeypatch, fake_odometry):
    out = tmp_path / "out"
    assert main(["calibrate", str(folder), "--board", "5x4", "--square", "0.03", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "views of a 5x4 checkerboard" in said.out and f"calibration in {out / 'calib.txt'}" in said.out
    assert "no times" not in said.err
    facts = json.loads((out / "calibration.json").read_text())
    assert facts["parameters"]["fx"]["value"] == pytest.approx(200, rel=0.01)
    assert facts["parameters"]["cy"]["value"] == pytest.approx(89.5, rel=0.01)
    assert facts["image_size"] == [240, 180] and len(facts["views"]) + len(facts["rejected"]) == facts["found"]
    picture = cv2.imread(str(out / "calibration.png"))
    assert picture is not None and picture.std() > 10

    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: fake_odometry())
    assert main(["run", str(folder), "--calib", str(out / "calib.txt"), "--out", str(tmp_path / "run")]) == 0
    used = json.loads((tmp_path / "run" / "run.json").read_text())["camera"]
    assert used["fx"] == pytest.approx(facts["parameters"]["fx"]["value"], abs=1e-5) and used["model"] == "radtan"


@pytest.mark.long
def test_a_fisheye_is_written_as_yaml(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["calibrate", str(folder), "--board", "5x4", "--fisheye", "--out", str(out)]) == 0
    assert (out / "calib.yaml").is_file() and not (out / "calib.txt").exists()
    assert dvo.open(folder, calib=out / "calib.yaml").recorded_camera.model == "fisheye"


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--board", "7x6"], "no 7x6 checkerboard was found in 10 frames. A board of 5x4 inner corners is there"),
        (["--board", "7"], "expected COLUMNSxROWS"),
        (["--board", "2x9"], "2x9 is no board"),
        (["--board", "5x4", "--charuco", "5x4"], "not allowed with"),
        (["--board", "5x4", "--fisheye", "--k3"], "k3: is always there"),
        (["--board", "5x4", "--frames", "0"], "frames"),
        (["--charuco", "8x6", "--dictionary", "9X9"], "no dictionary '9X9'"),
        (["--charuco", "8x6"], "no 8x6 ChArUco board (4X4_50) was found in 10 frames. No markers were seen"),
        (["--fisheye"], "--fisheye: needs a board"),
    ],
)
def test_bad_input_is_one_line(options, match, folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["calibrate", str(folder), *options, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert match in said and "Traceback" not in said
    assert not out.exists()


def test_a_part_of_a_recording(folder, tmp_path, capsys):
    """The options of ``dvo run`` about its images: twenty frames, two a second, every other from 1 to 7.5 s."""
    for index in range(10, 20):
        shutil.copy(folder / f"{index - 10}.png", folder / f"{index}.png")
    out = tmp_path / "out"
    line = ["calibrate", str(folder), "--board", "5x4", "--out", str(out)]
    assert main([*line, "--fps", "2", "--start", "1", "--end", "7.5", "--stride", "2"]) == 0
    facts = json.loads((out / "calibration.json").read_text())
    assert facts["examined"] == 7
    assert {view["frame"] for view in facts["views"]} <= {2, 4, 6, 8, 10, 12, 14}


def test_a_part_without_a_board(folder, tmp_path, capsys, monkeypatch):
    def calibrate(frames, **options):
        assert [frame.index for frame in frames] == [3, 5, 7]
        assert all(frame.mask is not None and not frame.mask[:40].any() and frame.mask[41:].all() for frame in frames)
        return SelfCalibration(201.0, 4.5, "self-calibration", 240, 180, 3, "", guess_from_angle(240, 180))

    monkeypatch.setattr(command, "self_calibrate", calibrate)
    cv2.imwrite(str(tmp_path / "mask.png"), np.repeat([0] * 40 + [255] * 140, 240).reshape(180, 240).astype(np.uint8))
    line = ["calibrate", str(folder), "--out", str(tmp_path / "out"), "--mask", str(tmp_path / "mask.png")]
    assert main([*line, "--fps", "10", "--start", "3f", "--end", "0.8", "--stride", "2"]) == 0


@pytest.mark.parametrize("option", [("--mask", "m.png"), ("--max-pixels", "9000")])
def test_a_board_is_searched_in_whole_images(option, folder, tmp_path, capsys):
    assert main(["calibrate", str(folder), "--board", "5x4", *option, "--out", str(tmp_path / "out")]) == 2
    assert f"{option[0]}: a board is searched in whole images" in capsys.readouterr().err


def test_streams_are_refused(capsys):
    assert main(["calibrate", "webcam:0", "--board", "5x4"]) == 2
    assert "Record a clip" in capsys.readouterr().err


@pytest.mark.parametrize(("source", "code"), [("self-calibration", 0), ("prior", 1)])
def test_without_a_board(folder, tmp_path, capsys, monkeypatch, source, code):
    def calibrate(frames, **options):
        assert options["weights"] == "small" and options["seed"] == 4
        reason = "" if code == 0 else "the motion does not tell"
        return SelfCalibration(201.0, 4.5, source, 240, 180, 20, reason, guess_from_angle(240, 180))

    monkeypatch.setattr(command, "self_calibrate", calibrate)
    out = tmp_path / "out"
    assert main(["calibrate", str(folder), "--seed", "4", "--out", str(out)]) == code
    said = capsys.readouterr()
    assert "201 +-" in said.out and ("no calib.txt is written" in said.err) == (code == 1)
    if code:
        assert not (out / "calib.txt").exists(), "a guess is no calibration"
        return
    found = dvo.open(folder, calib=out / "calib.txt")
    assert found.camera.fx == 201 and not found.calibrated
    assert main(["calibrate", "--show", str(out / "calib.txt")]) == 0
    assert "found in the images of a clip" in capsys.readouterr().out


def test_show_tells_how_a_file_is_read(tmp_path, capsys):
    file = tmp_path / "c.yaml"
    file.write_text(
        "Camera.type: KannalaBrandt8\nCamera1.fx: 190.5\nCamera1.fy: 191\nCamera1.cx: 254\nCamera1.cy: 256\n"
        "Camera1.k1: 0.003\nCamera1.k2: 0.0007\nCamera1.k3: -0.002\nCamera1.k4: 0.0002\nCamera.width: 512\n"
        "Camera.height: 510\nCamera.fps: 20\nViewer.PointSize:2\n"
    )
    assert main(["calibrate", "--show", str(file)]) == 0
    said = capsys.readouterr().out.splitlines()
    rows = {line[:13].strip(): line[13:] for line in said}
    assert rows["dialect"] == "yaml" and rows["model"] == "fisheye" and rows["size"] == "512x510"
    assert rows["intrinsics"] == "fx 190.5  fy 191  cx 254  cy 256"
    assert rows["coefficients"] == "k1 0.003  k2 0.0007  k3 -0.002  k4 0.0002"
    assert "Camera.fps" in rows["ignored"] and "Viewer" in rows["ignored"] and "k1" not in rows["ignored"]
    assert list(tmp_path.iterdir()) == [file]


def test_show_refuses_what_a_run_would_refuse(tmp_path, capsys):
    file = tmp_path / "c.yaml"
    file.write_text("fx: 500\nfy: 500\ncx: 320\ncy: 240\nlens_warp: [0.1, 0.2, 0, 0]\n")
    assert main(["calibrate", "--show", str(file)]) == 2
    assert "lens_warp may be lens distortion" in " ".join(capsys.readouterr().err.split())
    assert main(["calibrate", str(tmp_path), "--show", str(file)]) == 2
    assert main(["calibrate"]) == 2
