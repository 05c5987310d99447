"""Tables of a sequence in the ASL layout of EuRoC: calibrations, inertial samples, states.

The body is the inertial sensor, which lies in the camera with its axes: both ``T_BS`` are the identity.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.inertial import ImuNoise
from dvo.geometry.camera import Camera
from dvo.synth.sensors.imu import STEP, Imu
from dvo.synth.sequence import SyntheticSequence

IMU_RATE = 200.0
"""Samples a second, that of EuRoC."""

_MODELS = {"none": "radial-tangential", "radtan": "radial-tangential", "fisheye": "equidistant"}
_IDENTITY = "T_BS:\n  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\n"  # noqa: E501


def check_lens(camera: Camera) -> None:
    """Refuse a lens that ``sensor.yaml`` cannot state.

    Args:
        camera: of the images.

    Raises:
        DvoError: another model than pinhole, radial-tangential with four coefficients, or equidistant.
    """
    if camera.model not in _MODELS or len(camera.coefficients) > 4:
        raise DvoError(f"EuRoC's layout has no lens {camera.model}", field="layout", remedy="choose tum")


def nanoseconds(times: np.ndarray) -> np.ndarray:
    """Times of the tables.

    Args:
        times: ``(N,)`` seconds.

    Returns:
        ``(N,)`` int64.
    """
    return np.rint(np.asarray(times) * 1e9).astype(np.int64)


def write_tables(sequence: SyntheticSequence, noise: ImuNoise | None, out: Path) -> None:
    """Write all files but the images: ``cam0/data.csv``, ``imu0/data.csv``, ``state_groundtruth_estimate0/data.csv`` at
    the times of both, and ``sensor.yaml`` of each.

    Args:
        sequence: with its path.
        noise: of the inertial sensor; None for exact samples, whose ``sensor.yaml`` states no densities.
        out: folder ``mav0``.

    Raises:
        OSError: it cannot be written.
    """
    imu = sequence.imu(IMU_RATE, noise=noise)
    for name in ("cam0", "imu0", "state_groundtruth_estimate0"):
        (out / name).mkdir(exist_ok=True)
    stamps = nanoseconds(sequence.groundtruth.timestamps)
    rows = [f"{stamp},{stamp}.png" for stamp in stamps.tolist()]
    _write(out / "cam0" / "data.csv", "#timestamp [ns],filename", rows)
    camera, interval = sequence.camera, sequence.interval
    coefficients = list(camera.coefficients) or [0.0] * 4
    text = f"sensor_type: camera\ncomment: rendered by dvo\n{_IDENTITY}rate_hz: {1 / interval:.6g}\n"
    text += f"resolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
    text += f"intrinsics: {[float(value) for value in camera.intrinsics]}\n"
    text += f"distortion_model: {_MODELS[camera.model]}\ndistortion_coefficients: {coefficients}\n"
    text += f"readout: {camera.readout!r}\n" if camera.readout > 0 else ""
    (out / "cam0" / "sensor.yaml").write_text(text, encoding="utf-8")
    _write_imu(imu, noise, out / "imu0")
    _write_states(sequence, imu, stamps, out / "state_groundtruth_estimate0")


def _write(file: Path, header: str, rows: list[str]) -> None:
    file.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def _write_imu(imu: Imu, noise: ImuNoise | None, folder: Path) -> None:
    axes = [f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"] + [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
    rows = [
        ",".join([str(stamp), *(repr(value) for value in row)])
        for stamp, row in zip(
            nanoseconds(imu.timestamps).tolist(), np.column_stack([imu.gyro, imu.accel]).tolist(), strict=True
        )
    ]
    _write(folder / "data.csv", ",".join(["#timestamp [ns]", *axes]), rows)
    text = f"sensor_type: imu\ncomment: rendered by dvo\n{_IDENTITY}rate_hz: {IMU_RATE:g}\n"
    if noise is not None:
        text += f"gyroscope_noise_density: {noise.gyro!r}\ngyroscope_random_walk: {noise.gyro_walk!r}\n"
        text += f"accelerometer_noise_density: {noise.accel!r}\naccelerometer_random_walk: {noise.accel_walk!r}\n"
    (folder / "sensor.yaml").write_text(text, encoding="utf-8")


def _write_states(sequence: SyntheticSequence, imu: Imu, stamps: np.ndarray, folder: Path) -> None:
    """Position, orientation ``w x y z``, velocity in the world and biases at all times of frames and samples."""
    samples = nanoseconds(imu.timestamps)
    all_stamps = np.union1d(stamps, samples)
    times = all_stamps / 1e9
    exact = dict(zip(stamps.tolist(), sequence.groundtruth.poses_wc, strict=True))
    poses = sequence.path.poses_wc(times)
    before, after = (sequence.path.poses_wc(times + sign * STEP) for sign in (-1, 1))
    velocity = (after[:, :3] - before[:, :3]) / (2 * STEP)
    biases = [np.interp(times, imu.timestamps, bias[:, k]) for bias in (imu.gyro_bias, imu.accel_bias)
              for k in range(3)]  # fmt: skip
    rows = []
    for k, stamp in enumerate(all_stamps.tolist()):
        pose = exact.get(stamp, poses[k])
        values = [*pose[[0, 1, 2, 6, 3, 4, 5]], *velocity[k], *(bias[k] for bias in biases)]
        rows.append(",".join([str(stamp), *(repr(float(value)) for value in values)]))
    names = [f"p_RS_R_{axis} [m]" for axis in "xyz"] + [f"q_RS_{axis} []" for axis in "wxyz"]
    names += [f"v_RS_R_{axis} [m s^-1]" for axis in "xyz"] + [f"b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"]
    names += [f"b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
    _write(folder / "data.csv", ",".join(["#timestamp [ns]", *names]), rows)
    text = f"sensor_type: visual-inertial\ncomment: exact states of the rendered path\n{_IDENTITY}"
    (folder / "sensor.yaml").write_text(text, encoding="utf-8")
