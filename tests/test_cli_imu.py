"""``dvo imu check``: what it opens, prints, writes and returns."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.data.calibration.focal_guess import guess_from_angle
from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.geometry.poses import invert_poses, pose_matrices
from dvo.odometry.calibration.camera_estimate import SelfCalibration
from tests.support.fake_odometry import FakeOdometry
from tests.support.hand_motion import T_CAMERA_IMU, hand_motion, samples

SECONDS = 8.0
MOTION = hand_motion(31)


@pytest.fixture(scope="module")
def imu() -> InertialSamples:
    return samples(MOTION, SECONDS, noise=NOISE_PRESETS["euroc"])


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """EuRoC layout with small images at 20 Hz, without samples."""
    camera = tmp_path / "s" / "mav0" / "cam0"
    (camera / "data").mkdir(parents=True)
    (camera.parent / "imu0").mkdir()
    image = np.random.default_rng(0).integers(0, 255, (24, 32), dtype=np.uint8)
    for k in range(round(20 * SECONDS)):
        cv2.imwrite(str(camera / "data" / f"{10**18 + k * 50_000_000}.png"), image)
    matrix = pose_matrices(invert_poses(T_CAMERA_IMU)).ravel().tolist()
    (camera / "sensor.yaml").write_text(
        f"T_BS:\n  rows: 4\n  cols: 4\n  data: {matrix}\ncamera_model: pinhole\nresolution: [32, 24]\n"
        "intrinsics: [30, 30, 15.5, 11.5]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [0, 0, 0, 0]\n"
    )
    identity = np.eye(4).ravel().tolist()
    (camera.parent / "imu0" / "sensor.yaml").write_text(f"T_BS:\n  rows: 4\n  cols: 4\n  data: {identity}\n")
    return tmp_path / "s"


def write(sequence: Path, imu: InertialSamples, stamps: np.ndarray | None = None) -> Path:
    """Samples as EuRoC's data.csv."""
    table = np.hstack([imu.gyro, imu.accel])
    times = np.round((imu.timestamps if stamps is None else stamps) * 1e9).astype(np.int64) + 10**18
    rows = [",".join([str(t), *(f"{value:.9g}" for value in row)]) for t, row in zip(times, table, strict=True)]
    file = sequence / "mav0" / "imu0" / "data.csv"
    header = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    header += "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    file.write_text("\n".join([header, *rows]) + "\n")
    return file


def checked(capsys: pytest.CaptureFixture[str], *line: str) -> tuple[int, str, str]:
    code = main(["imu", "check", *line])
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.mark.long
def test_a_sequence_against_its_camera(sequence, imu, monkeypatch, tmp_path, capsys):
    odometries = []

    def load(*_: object, **__: object) -> FakeOdometry:
        odometries.append(FakeOdometry(lambda time: MOTION.poses_wc(np.array([time - 1e9]))[0], new_segment=(155,)))
        return odometries[-1]

    monkeypatch.setattr("dvo.load", load)
    write(sequence, imu, imu.timestamps + 0.1)
    file = tmp_path / "report.json"
    code, out, _ = checked(capsys, str(sequence), "--json", str(file), "--device", "cpu", "--frames", "158")
    assert code == 1 and "unusable: time offset: t_imu = t_camera +0.1" in out and "not usable as it is" in out
    facts = json.loads(file.read_text())
    assert not facts["usable"] and facts["values"]["frames with a pose"] == 155
    assert facts["alignment"]["time_offset"] == pytest.approx(0.1, abs=2e-3)
    assert [finding["name"] for finding in facts["findings"] if finding["level"] == "unusable"] == ["time offset"]
    assert all(frame.inertial is None for frame in odometries[0].frames)
    calibration = tmp_path / "imu.yaml"
    calibration.write_text("time_offset: 0.1\npreset: euroc\n")
    code, out, _ = checked(capsys, str(sequence), "--imu-calib", str(calibration), "--device", "cpu")
    assert code == 0 and out.endswith("usable\n") and "time offset:" not in out
    write(sequence, InertialSamples(imu.timestamps, imu.gyro, -imu.accel), imu.timestamps + 0.1)
    code, out, _ = checked(capsys, str(sequence), "--imu-calib", str(calibration), "--device", "cpu")
    assert code == 1 and "give the accelerometer as (-x, -y, -z)" in out


@pytest.mark.parametrize("is_found", [True, False])
def test_a_camera_whose_focal_length_is_a_guess(sequence, imu, is_found, monkeypatch, tmp_path, capsys):
    source, reason = ("self-calibration", "") if is_found else ("prior", "the motion does not tell")
    found = SelfCalibration(30.0, 8.0, source, 32, 24, 20, reason, guess_from_angle(32, 24))
    monkeypatch.setattr("dvo.commands.imu.calibrate", lambda *_, **__: found)
    fake = FakeOdometry(lambda time: MOTION.poses_wc(np.array([time - 1e9]))[0])
    monkeypatch.setattr("dvo.load", lambda *_, **__: fake)
    file = write(sequence, imu).rename(tmp_path / "imu.csv")
    images = (sequence / "mav0" / "cam0" / "data").rename(tmp_path / "images")
    code, out, _ = checked(capsys, str(images), "--imu", str(file), "--imu-calib", "euroc")
    assert code == 0 and ("warning: guessed camera: " in out) == (not is_found)
    if not is_found:
        assert "the motion does not tell" in out and "--calib" in out
        assert out.index("warning: ") < out.index("note: "), "the gravest first"


def test_samples_that_a_reader_refuses_are_opened_and_named(sequence, imu, capsys):
    stamps = imu.timestamps.copy()
    stamps[[500, 501]] = stamps[[501, 500]]
    stamps[801] = stamps[800]
    write(sequence, imu, stamps)
    code, out, _ = checked(capsys, str(sequence), "--no-vision")
    assert code == 1 and "unusable: refused: dvo run would not read them" in out
    assert "duplicate stamps" in out and "unordered stamps: time goes back 1 times" in out


@pytest.mark.long
def test_a_table_alone_and_one_beside_images(sequence, imu, tmp_path, capsys):
    in_g = InertialSamples(imu.timestamps, imu.gyro, imu.accel / 9.80665)
    file = write(sequence, in_g)
    code, out, _ = checked(capsys, str(file))
    assert code == 1 and "accelerometer unit: the accelerometer is in g" in out and "no vision" in out
    write(sequence, imu)
    other = tmp_path / "other.csv"
    other.write_text(file.read_text())
    file.unlink()
    code, out, _ = checked(capsys, str(sequence), "--imu", str(other), "--imu-calib", "phone", "--no-vision")
    assert code == 0 and "other.csv" in out and "no extrinsics" in out and "no noise" not in out


def test_bad_input_ends_in_one_line(sequence, imu, tmp_path, capsys):
    file = write(sequence, imu)
    for line, words in (
        (["rtsp://host/live"], "a stream cannot be checked"),
        ([str(sequence), "--imu", "none"], "nothing to check"),
        ([str(sequence), "--imu", str(tmp_path / "none.csv")], "none.csv"),
        ([str(file), "--json", str(file)], "would replace"),
        ([str(file), "--imu", str(file)], "a table of samples itself"),
        ([str(file), "--imu-topic", "/imu"], "a table of samples itself"),
    ):
        code, out, err = checked(capsys, *line)
        assert code == 2 and not out and words in err and err.count("\n") == 1
    file.unlink()
    code, _, err = checked(capsys, str(sequence))
    assert code == 2 and "no inertial samples" in err and "--imu FILE" in err
