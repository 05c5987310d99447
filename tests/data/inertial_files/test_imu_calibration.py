"""Files that state the calibration of an inertial sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.data.inertial_files.imu_calibration import ImuCalibration, read_imu_calibration, read_noise
from dvo.geometry.poses import compose_poses, invert_poses, so3_exp, split

DENSITIES = """accelerometer_noise_density: 0.002
accelerometer_random_walk: 0.003
gyroscope_noise_density: 0.0001
gyroscope_random_walk: 0.00002
"""
TURN = [[0.0, 1, 0, 0.1], [0, 0, 1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]
CAMCHAIN = f"""cam0:
  T_cam_imu: {TURN}
  timeshift_cam_imu: 0.005
  camera_model: pinhole
  intrinsics: [400, 400, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [0, 0, 0, 0]
  resolution: [640, 480]
  rostopic: /cam0
cam1:
  T_cam_imu: {np.eye(4).tolist()}
  T_cn_cnm1: {np.eye(4).tolist()}
  timeshift_cam_imu: -0.25
"""
POSE = np.array([0.1, 0.2, 0.3])


def write(folder: Path, text: str, name: str = "imu.yaml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def test_kalibr_files_complete_each_other(tmp_path):
    imu = write(tmp_path, f"rostopic: /imu0\nupdate_rate: 200.0\n{DENSITIES}")
    chain = write(tmp_path, CAMCHAIN, "camchain-imucam.yaml")
    both = read_imu_calibration([imu, chain])
    assert both.noise is not None and both.T_camera_imu is not None
    assert (both.noise.gyro, both.noise.accel_walk, both.time_offset) == (0.0001, 0.003, 0.005)
    assert both.T_camera_imu[:3] == pytest.approx(POSE)
    # a point of the body is taken to the camera: x of the sensor is z of the camera
    moved = compose_poses(both.T_camera_imu, np.array([1.0, 0, 0, 0, 0, 0, 1]))
    assert moved[:3] == pytest.approx([0.1, 0.2, 1.3])
    assert read_imu_calibration(f"{chain}:1").time_offset == -0.25


@pytest.mark.parametrize("text", ["time_offset: 0.01\n", "cam0:\n  timeshift_cam_imu: 0.01\n"])
def test_the_clock_of_the_samples_becomes_that_of_the_camera(tmp_path, text):
    samples = InertialSamples(np.array([5.0, 5.01]), np.zeros((2, 3)), np.ones((2, 3)))
    calibration = read_imu_calibration(write(tmp_path, text))
    assert calibration.applied(samples).timestamps == pytest.approx([4.99, 5.0])  # t_imu = t_cam + shift


def test_sensor_yaml_of_euroc(tmp_path):
    text = "sensor_type: imu\ncomment: VI-Sensor\nrate_hz: 200\nT_BS:\n  cols: 4\n  rows: 4\n  data: "
    file = write(tmp_path, f"%YAML:1.0\n{text}{np.eye(4).ravel().tolist()}\n{DENSITIES}")
    assert read_noise(file) == read_imu_calibration(file).noise
    moved = write(tmp_path, f"{text}{np.array(TURN).ravel().tolist()}\n{DENSITIES}", "other.yaml")
    with pytest.raises(DvoError, match="T_BS: places the sensor on a body"):
        read_imu_calibration(moved)


def placed(sensor: str, pose: np.ndarray, rest: str = "") -> str:
    return f"sensor_type: {sensor}\nT_BS:\n  cols: 4\n  rows: 4\n  data: {pose.ravel().tolist()}\n{rest}"


def test_camera_and_sensor_on_one_body(tmp_path):
    turn, camera = np.array(TURN), np.eye(4)
    camera[:3, 3] = 0.1, -0.2, 0.05
    camera[:3, :3] = so3_exp(np.array([0.3, -0.4, 0.2]))
    seen = write(tmp_path, placed("camera", camera, "intrinsics: [400, 400, 300, 200]\n"), "cam0.yaml")
    sensor = write(tmp_path, placed("imu", turn, DENSITIES), "imu0.yaml")
    for pair in ([seen, sensor], [sensor, seen]):
        found = read_imu_calibration(pair)
        assert found.noise is not None and found.T_camera_imu is not None
        rotation, position = split(found.T_camera_imu)
        expected = np.linalg.inv(camera) @ turn
        assert np.allclose(rotation, expected[:3, :3]) and np.allclose(position, expected[:3, 3])
    with pytest.raises(DvoError, match=r"cam0\.yaml: T_BS: places the camera on a body.*sensor\.yaml of the inertial"):
        read_imu_calibration(seen)
    with pytest.raises(DvoError, match=r"T_BS: is stated twice"):
        read_imu_calibration([seen, sensor, write(tmp_path, placed("camera", camera), "cam1.yaml")])
    stated = write(tmp_path, f"T_camera_imu: {turn.ravel().tolist()}\n", "own.yaml")
    with pytest.raises(DvoError, match="T_camera_imu: is stated twice"):
        read_imu_calibration([seen, sensor, stated])
    # Beside a pose in the camera, that on a body is of no use; beside a preset, that of both is.
    assert np.allclose(read_imu_calibration([sensor, stated]).T_camera_imu[:3], turn[:3, 3])
    bare = write(tmp_path, placed("imu", turn), "bare.yaml")
    assert np.allclose(read_imu_calibration(["phone", seen, bare]).T_camera_imu[:3], expected[:3, 3])
    for alone in (bare, write(tmp_path, placed("imu", np.eye(4)), "identity.yaml")):
        with pytest.raises(DvoError, match="states nothing of an inertial sensor"):
            read_imu_calibration(alone)
    camera[0, 3] = 150.0
    far = write(tmp_path, placed("camera", camera), "millimetres.yaml")
    with pytest.raises(DvoError, match=r"T_BS: the sensor is 149.9 m from the camera"):
        read_imu_calibration([far, sensor])


@pytest.mark.parametrize("factor", [1, 10])
def test_the_factor_multiplies_densities(tmp_path, factor):
    found = read_imu_calibration(write(tmp_path, f"{DENSITIES}noise_factor: {factor}\n")).noise
    assert found is not None
    assert found.gyro == pytest.approx(0.0001 * factor) and found.accel_walk == pytest.approx(0.003 * factor)
    assert found.gyro_bias == NOISE_PRESETS["phone"].gyro_bias


def test_exponents_without_a_point(tmp_path):
    found = read_imu_calibration(write(tmp_path, DENSITIES.replace("0.00002", "2e-5"))).noise
    assert found is not None and found.gyro_walk == 2e-5


def test_plain_yaml(tmp_path):
    pose = "T_camera_imu: [0.1, 0.2, 0.3, 0, 0, 0, 1]"
    text = f"preset: action\nnoise:\n  gyro_bias: 0.5\n{pose}\ntime_offset: -0.02\n"
    found = read_imu_calibration(write(tmp_path, text))
    assert found.noise is not None and found.T_camera_imu is not None
    assert (found.noise.gyro, found.noise.gyro_bias) == (NOISE_PRESETS["action"].gyro, 0.5)
    assert found.T_camera_imu == pytest.approx([0.1, 0.2, 0.3, 0, 0, 0, 1]) and found.time_offset == -0.02
    assert read_imu_calibration("phone").noise == NOISE_PRESETS["phone"]


def test_the_inverse_of_kalibr(tmp_path):
    inverse = np.linalg.inv(TURN).tolist()
    one = read_imu_calibration(write(tmp_path, f"T_cam_imu: {TURN}\n")).T_camera_imu
    other = read_imu_calibration(write(tmp_path, f"T_imu_cam: {inverse}\n", "b.yaml")).T_camera_imu
    assert one is not None and other is not None
    assert compose_poses(one, invert_poses(other)) == pytest.approx([0, 0, 0, 0, 0, 0, 1], abs=1e-9)
    with pytest.raises(DvoError, match="differ"):
        read_imu_calibration(write(tmp_path, f"T_cam_imu: {TURN}\nT_imu_cam: {TURN}\n", "c.yaml"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{DENSITIES}T_ic: {TURN}\n", "T_ic: is not used"),
        (f"{DENSITIES}accelerometers:\n  M: [[1, 2], [3, 4]]\n", "accelerometers: is not used"),
        (f"{DENSITIES}Ta: [[1.01, 0, 0], [0, 1, 0], [0, 0, 1]]\n", "Ta: is not used"),
        (f"{DENSITIES}gyro_noise: 0.1\n", "gyro_noise: is not used"),
        ("gyroscope_noise_density: 0.1\n", "is missing"),
        ("preset: car\n", "preset: no preset car"),
        *((f"preset: phone\n{entry}\n", f"{entry.split(':')[0]}: is not used") for entry in (
            f"Tbc: {TURN}", f"body_T_cam0: {TURN}", "td: 0.02", "dt: 0.02", "latency_ms: 5", "q_ic: [0, 0, 0.6, 0.8]",
            "p_ic: [0.1, 0, 0]")),
        (f"preset: phone\ncalibration:\n  T_camera_imu: {TURN}\n", "calibration.T_camera_imu: is not used"),
        (f"preset: phone\ncameras:\n- T_SC: {TURN}\n", "cameras.0.T_SC: is not used"),
        ("T_camera_imu: [100, 20, 30, 0, 0, 0, 1]\n", "T_camera_imu: the sensor is 106.3 m from the camera"),
        ("imu0:\n  time_offset: 0.01\n", "to another sensor, not to the camera"),
        ("noise_factor: 10\n", "no noise that it multiplies"),
        (f"{DENSITIES}noise_factor: -1\n", "noise_factor: is -1"),
        ("noise:\n  gyr: 1\n", "noise.gyr: no name of noise"),
        ("noise: 3\n", "noise: no mapping"),
        (DENSITIES.replace("0.002", ".nan"), "accelerometer_noise_density: is nan"),
        (DENSITIES.replace("0.002", "0"), "imu.yaml: accelerometer_noise_density: is 0. Give a number above 0"),
        (DENSITIES.replace("0.00002", "0.0"), "imu.yaml: gyroscope_random_walk: is 0.0. Give a number above 0"),
        (f"imu0:\n  {DENSITIES.strip().replace('0.003', '0').replace(chr(10), chr(10) + '  ')}\n",
         "imu.yaml: accelerometer_random_walk: is 0"),
        ("preset: phone\nnoise:\n  gyro_bias: 0\n", "imu.yaml: noise.gyro_bias: is 0. Give a number above 0"),
        ("preset: phone\nnoise:\n  accel: 1e7\n", "imu.yaml: noise.accel: is 10000000.0"),
        (f"{DENSITIES}noise_factor: 1e20\n", "imu.yaml: noise.gyro: is 1e"),
        ("time_offset: soon\n", "time_offset: is soon"),
        ("time_offset: -.inf\n", "time_offset: is -inf"),
        ("time_offset: 1e999\n", "time_offset: is inf"),
        (f"time_offset: -{'9' * 99}\n", "time_offset: is -999"),
        ("T_cam_imu: [1, 2, 3]\n", "T_cam_imu: 3 numbers"),
        ("T_camera_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]\n", "mirrors"),
        ("imu0:\n  a: 1\nimu1:\n  a: 1\n", "several inertial sensors"),
        ("rostopic: /imu\n", "states nothing"),
        ("- 1\n", "no mapping"),
    ],
)  # fmt: skip
def test_what_is_not_used_is_refused(tmp_path, text, message):
    with pytest.raises(DvoError, match=message):
        read_imu_calibration(write(tmp_path, text))


def test_what_says_nothing_is_left(tmp_path):
    ideal = f"Tw: {np.eye(3).tolist()}\nTg: {np.zeros((3, 3)).tolist()}\nmodel: kalibr\nT_i_b: {np.eye(4).tolist()}\n"
    indented = "".join(f"  {line}\n" for line in (DENSITIES + ideal).splitlines())
    assert read_imu_calibration(write(tmp_path, f"imu0:\n{indented}")).noise is not None


def test_the_files_of_openvins_complete_each_other(tmp_path):
    indented = "".join(f"  {line}\n" for line in f"{DENSITIES}time_offset: 0.0".splitlines())
    chain = f"cam0:\n  T_imu_cam: {TURN}\n  timeshift_cam_imu: 0.02\n"
    both = [write(tmp_path, f"imu0:\n{indented}"), write(tmp_path, chain, "chain.yaml")]
    assert read_imu_calibration(both).time_offset == 0.02


def test_two_files_that_state_the_same_are_refused(tmp_path):
    with pytest.raises(DvoError, match="noise: is stated twice"):
        read_imu_calibration([write(tmp_path, DENSITIES), "phone"])
    with pytest.raises(DvoError, match="no such file"):
        read_imu_calibration(tmp_path / "absent.yaml")
    with pytest.raises(DvoError, match="no cam7 in it"):
        read_imu_calibration(f"{write(tmp_path, CAMCHAIN, 'chain.yaml')}:7")


@given(st.one_of(st.none(), st.floats(-1, 1)), st.one_of(st.none(), st.floats(-1, 1)))
def test_a_calibration_is_completed_by_another(first, second):
    found = ImuCalibration(time_offset=first).over(ImuCalibration(time_offset=second)).time_offset
    assert found == (second if first is None else first)
