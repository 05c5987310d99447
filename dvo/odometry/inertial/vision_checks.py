"""Checks of inertial samples against the poses of a camera: clock, axes, units, biases and the sign of forces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.geometry.poses import matrix_to_quaternion, quaternion_to_matrix, rotation_vector
from dvo.odometry.inertial.findings import Finding, Found, Level
from dvo.odometry.inertial.mean_forces import MeanForces, bias_and_gravity
from dvo.odometry.inertial.sample_checks import SIGNED_AXES, gravity_error, gyro_bias, in_radians, named_axes
from dvo.odometry.inertial.smoother import OPPOSED, Smoother, VisualNodes, acceleration_sign
from dvo.odometry.inertial.temporal import ImuAlignment, align_imu

Array = np.ndarray
OFFSET = (0.005, 0.05)
"""Time offset that is told, and that makes samples unusable until it is stated, seconds."""
DRIFT = (2e-4, 1e-3)
"""Drift of the clock that is told, and that makes samples unusable: a constant offset cannot follow it."""
ANGLE = (3.0, 10.0)
"""Difference of the rotation from the stated one that is told, and that makes samples unusable, degrees."""
ACCEL_BIAS = (0.5, 2.0)
"""Bias of the accelerometer that is told, and that makes samples unusable, m/s^2."""
_WIDE = 3.0  # seconds on either side of a second search, where the first one finds no offset
_WINDOW = 4.0  # seconds of vision for one point of the line of offsets
_MIN_WINDOWS, _MIN_MEANS = 3, 8
_AXES = ("axes", "accelerometer axes")
_TELLS = 0.5  # share of the variance that other axes of the accelerometer must leave


@dataclass(frozen=True)
class ClockLine:
    """Time offset as a line over time.

    Attributes:
        offset: seconds, ``t_imu - t_camera`` at ``middle``.
        middle: seconds on the clock of the frames.
        drift: seconds a second.
        sigma_drift: its standard deviation.
        points: ``(W, 3)`` middle of a window, its offset and the deviation of it, seconds.
    """

    offset: float
    middle: float
    drift: float
    sigma_drift: float
    points: Array

    @property
    def is_drifting(self) -> bool:
        """The slope is larger than :data:`DRIFT` and than three deviations."""
        return abs(self.drift) > max(DRIFT[0], 3 * self.sigma_drift)

    def corrected(self, stamps: Array) -> Array:
        """Stamps of the sensor on the clock of the frames.

        Args:
            stamps: seconds.
        """
        return (stamps - self.offset + self.drift * self.middle) / (1 + self.drift)


def clock_line(
    timestamps: Array, rotations_wc: Array, imu_times: Array, gyro: Array, rotation_camera_imu: Array
) -> ClockLine | None:
    """Fit a line to the time offsets of windows.

    Args:
        timestamps: ``(N,)`` of the frames.
        rotations_wc: ``(N, 3, 3)`` camera to world.
        imu_times: ``(K,)`` stamps of the samples.
        gyro: ``(K, 3)`` rad/s.
        rotation_camera_imu: ``(3, 3)``.

    Returns:
        None if fewer than three windows tell an offset.
    """
    span = float(timestamps[-1] - timestamps[0])
    spacing = float(np.median(np.diff(timestamps)))
    length = max(_WINDOW, span / 10, 20 * spacing)
    points = []
    for start in timestamps[0] + length * np.arange(int(span / length + 0.2)):
        chosen = (timestamps >= start) & (timestamps < start + length)
        near = (imu_times > start - 1) & (imu_times < start + length + 1)
        if chosen.sum() < 5:
            continue
        found = align_imu(
            timestamps[chosen], rotations_wc[chosen], imu_times[near], gyro[near], rotation_camera_imu, fixed=True
        )
        if found.is_offset_told:
            points.append((start + length / 2, found.time_offset, max(found.sigma_offset, 2e-4)))
    if len(points) < _MIN_WINDOWS:
        return None
    table = np.array(points)
    middle = float(np.average(table[:, 0], weights=table[:, 2] ** -2))
    rows = np.stack([np.ones(len(table)), table[:, 0] - middle], 1) / table[:, 2:]
    covariance = np.linalg.inv(rows.T @ rows)
    line = covariance @ rows.T @ (table[:, 1] / table[:, 2])
    error = rows @ line - table[:, 1] / table[:, 2]
    excess = max(1.0, float(error @ error) / (len(table) - 2))
    return ClockLine(float(line[0]), middle, float(line[1]), float(np.sqrt(excess * covariance[1, 1])), table)


def check_against_vision(
    samples: InertialSamples, timestamps: Array, rotations_wc: Array, positions_wc: Array | None = None
) -> tuple[ImuAlignment, Found]:
    """Check samples against poses of a camera.

    Args:
        samples: with increasing times, in rad/s and m/s^2; a gyroscope in deg/s is told.
        timestamps: ``(N,)`` increasing times of frames.
        rotations_wc: ``(N, 3, 3)`` camera to world.
        positions_wc: ``(N, 3)`` of the camera in any unit; None: the sign of the accelerometer is not checked, and
            its bias against what usual motion leaves.

    Returns:
        The alignment, and what was found.
    """
    stated = None if samples.T_camera_imu is None else quaternion_to_matrix(samples.T_camera_imu[3:])
    findings = []
    covered = (timestamps >= samples.timestamps[0]) & (timestamps <= samples.timestamps[-1])
    if covered.mean() < 0.9:
        text = f"samples cover {100 * covered.mean():.0f} % of the frames"
        remedy = "give times of the frames and of the samples on one clock"
        level = Level.UNUSABLE if covered.mean() < 0.5 else Level.WARNING
        findings.append(Finding("other times", level, text, remedy))
    samples, told = _rates(samples, timestamps, rotations_wc)
    findings += told
    found = align_imu(timestamps, rotations_wc, samples.timestamps, samples.gyro, stated)
    if found.correlation > 0 and not found.is_offset_told and not found.mirrored:
        wide = align_imu(timestamps, rotations_wc, samples.timestamps, samples.gyro, stated, max_offset=_WIDE)
        found = wide if wide.is_offset_told or wide.mirrored else found
    values: dict[str, object] = {"frames with a pose": len(timestamps), "correlation": found.correlation}
    line = None
    if found.correlation > 0 and not found.mirrored:
        shift = found.time_offset if found.is_offset_told else 0.0
        stamps = samples.timestamps - shift
        line = clock_line(timestamps, rotations_wc, stamps, samples.gyro, found.rotation_camera_imu)
        line = None if line is None else replace(line, offset=line.offset + shift)
    if line is not None and line.is_drifting:
        samples = replace(samples, timestamps=line.corrected(samples.timestamps))
        steady = align_imu(timestamps, rotations_wc, samples.timestamps, samples.gyro, stated)
        found = replace(steady, time_offset=line.offset + steady.time_offset)
        samples = replace(samples, timestamps=samples.timestamps + found.time_offset)
    clock = _clock(found, line)
    parts = [clock, _axes(found, stated)]
    if found.is_offset_told:
        parts.append(_biases(samples, found, timestamps, rotations_wc, positions_wc))
    is_told = found.is_offset_told and (stated is not None or found.is_rotation_told)
    if positions_wc is not None and is_told and not any(one.name in _AXES for part in parts for one in part.findings):
        parts.append(_sign(samples, found, timestamps, rotations_wc, positions_wc))
    for part in parts:
        values |= part.values
        findings += part.findings
    if found.reason and not found.mirrored:
        remedy = "turn the device about all three axes for some seconds while the camera sees a textured scene"
        is_wrong = "do not agree" in found.reason or "not within" in found.reason
        level = Level.WARNING if is_wrong else Level.NOTE
        findings.append(Finding("not told", level, found.reason, remedy))
    return found, Found(values, tuple(findings))


def _rates(samples: InertialSamples, timestamps: Array, rotations_wc: Array) -> tuple[InertialSamples, list[Finding]]:
    """Samples in rad/s, by the size of the rates that vision sees."""
    steps = np.diff(timestamps)
    turns = rotation_vector(np.swapaxes(rotations_wc[:-1], -1, -2) @ rotations_wc[1:]) / steps[:, None]
    inside = (samples.timestamps >= timestamps[0]) & (samples.timestamps <= timestamps[-1])
    if inside.sum() < 10 or len(steps) < 10:
        return samples, []
    sizes = [
        float(np.median(np.linalg.norm(rates - np.median(rates, 0), axis=1))) for rates in (samples.gyro[inside], turns)
    ]
    ratio = sizes[0] / max(sizes[1], 1e-9)
    if sizes[1] < 0.02 or not 15 < ratio < 200:
        return samples, []
    converted, finding = in_radians(samples, f"its rates are {ratio:.3g} times those of the camera")
    both = [align_imu(timestamps, rotations_wc, s.timestamps, s.gyro) for s in (samples, converted)]
    return (converted, [finding]) if both[1].correlation > both[0].correlation else (samples, [])


def _clock(found: ImuAlignment, line: ClockLine | None) -> Found:
    """Offset and drift of the clock."""
    values: dict[str, object] = {}
    findings = []
    if line is not None:
        values |= {"clock drift, ppm": 1e6 * line.drift, "deviation of the drift, ppm": 1e6 * line.sigma_drift}
        if line.is_drifting:
            text = f"the clock of the samples drifts by {1e3 * line.drift:+.3g} ms a second against the frames"
            remedy = f"divide the times of the samples by {1 + line.drift:.6f}, or check the frame rate"
            level = Level.UNUSABLE if abs(line.drift) > DRIFT[1] else Level.WARNING
            findings.append(Finding("clock drift", level, text, remedy))
    if found.is_offset_told:
        offset = found.time_offset
        values |= {"time offset, ms": 1e3 * offset, "deviation of the offset, ms": 1e3 * found.sigma_offset}
        if abs(offset) > max(OFFSET[0], 3 * found.sigma_offset):
            where = " in the middle" if line is not None and line.is_drifting else ""
            text = f"t_imu = t_camera {offset:+.4f} s{where} (deviation {1e3 * found.sigma_offset:.2g} ms)"
            level = Level.UNUSABLE if abs(offset) > OFFSET[1] else Level.WARNING
            remedy = f"state time_offset: {offset:.4f} in --imu-calib, beside what is stated there"
            findings.append(Finding("time offset", level, text, remedy))
    elif found.mirrored:
        values["time offset, ms"] = 1e3 * found.time_offset
    return Found(values, tuple(findings))


def _axes(found: ImuAlignment, stated: Array | None) -> Found:
    """Rotation against the stated one; swapped and mirrored axes."""
    if found.mirrored and found.axes is not None:
        text = "no rotation explains the gyroscope, a reflection does: axes are swapped or have the wrong sign"
        named = None if stated is None else named_axes(stated.T @ found.axes)
        remedy = f"give the samples as {named}" if named else "correct the order and the signs of the axes"
        return Found({}, (Finding("axes", Level.UNUSABLE, text, remedy),))
    if not found.is_rotation_told:
        missing = Finding("no extrinsics", Level.WARNING, "the pose of the sensor in the camera is not stated",
                          "state T_camera_imu in --imu-calib, or calibrate with Kalibr")  # fmt: skip
        return Found({}, () if stated is not None else (missing,))
    rotation = found.rotation_camera_imu
    quaternion = np.round(matrix_to_quaternion(rotation), 5).tolist()
    values = {
        "rotation imu to camera, qx qy qz qw": quaternion,
        "deviation of the rotation, degrees": found.sigma_rotation.tolist(),
    }
    pose = f"[0, 0, 0, {', '.join(f'{value:g}' for value in quaternion)}]"
    if stated is None:
        remedy = f"state T_camera_imu: {pose} in --imu-calib (its position is not measured here)"
        text = "the pose of the sensor in the camera is not stated"
        return Found(values, (Finding("no extrinsics", Level.WARNING, text, remedy),))
    angle = float(np.degrees(np.linalg.norm(rotation_vector(stated.T @ rotation))))
    values["from the stated rotation, degrees"] = angle
    sigma = float(np.linalg.norm(found.sigma_rotation))
    if angle <= max(ANGLE[0], 4 * sigma):
        return Found(values)
    named = named_axes(stated.T @ rotation)
    text = f"the rotation from sensor to camera is {angle:.3g} degrees off the stated one"
    remedy = f"state the rotation of {pose}"
    if float(np.degrees(np.linalg.norm(rotation_vector(stated @ rotation)))) < ANGLE[0] + 4 * sigma:
        remedy = "state the inverse: T_camera_imu takes points of the sensor into the camera"
    elif named is not None:
        text, remedy = f"{text}: axes are swapped", f"give the samples as {named}"
    level = Level.UNUSABLE if angle > ANGLE[1] else Level.WARNING
    return Found(values, (Finding("axes", level, text, remedy),))


def _biases(
    samples: InertialSamples, found: ImuAlignment, timestamps: Array, rotations_wc: Array, positions_wc: Array | None
) -> Found:
    """Bias of the gyroscope; bias and axes of the accelerometer against gravity in the world of the camera."""
    values: dict[str, object] = {}
    findings = []
    if np.isfinite(found.sigma_bias).all():
        values["gyroscope bias, rad/s"] = found.gyro_bias.tolist()
        findings += [finding for finding in (gyro_bias(found.gyro_bias, "against vision"),) if finding]
    means = MeanForces.of(samples, found, timestamps, rotations_wc)
    if len(means.forces) < _MIN_MEANS:
        return Found(values, tuple(findings))
    spread = [float(means.in_world(option).var(0).sum()) for option in SIGNED_AXES]
    best, same = int(np.argmin(spread)), spread[_identity()]
    if spread[best] < _TELLS * same and same > 0.5:
        remedy = f"give the accelerometer as {named_axes(SIGNED_AXES[best])}"
        text = "the accelerometer does not see gravity where the gyroscope turns it: their axes differ"
        findings.append(Finding("accelerometer axes", Level.UNUSABLE, text, remedy))
        return Found(values, tuple(findings))
    arm = np.zeros(3) if samples.T_camera_imu is None else samples.T_camera_imu[:3]
    walk = (samples.noise or NOISE_PRESETS["phone"]).accel_walk
    solution, sigma = bias_and_gravity(means, walk, positions_wc, arm)
    bias, gravity = solution[:3], float(np.linalg.norm(solution[3:]))
    if sigma[:3].max() < ACCEL_BIAS[0] / 2:
        values |= {"accelerometer bias, m/s^2": bias.tolist(), "deviation of the bias, m/s^2": sigma[:3].tolist(),
                   "gravity against vision, m/s^2": gravity}  # fmt: skip
        size = float(np.linalg.norm(bias))
        if size > max(ACCEL_BIAS[0], 4 * float(np.linalg.norm(sigma[:3]))):
            text = f"{size:.3g} m/s^2 against vision, as of a sensor that was dropped"
            remedy = f"calibrate it in six positions, or subtract {np.array2string(bias, precision=2, separator=', ')}"
            level = Level.UNUSABLE if size > ACCEL_BIAS[1] else Level.WARNING
            findings.append(Finding("accelerometer bias", level, text, remedy))
        elif (finding := gravity_error(gravity, "against vision")) is not None and sigma[3:].max() < 0.1:
            findings.append(finding)
    return Found(values, tuple(findings))


def _sign(
    samples: InertialSamples, found: ImuAlignment, timestamps: Array, rotations_wc: Array, positions_wc: Array
) -> Found:
    """Sign of all three axes of the accelerometer, by the accelerations of the camera."""
    none, depth = np.zeros(len(timestamps), int), np.ones(len(timestamps))
    problem = Smoother(
        VisualNodes(timestamps, none, rotations_wc, positions_wc, depth), samples,
        samples.noise or NOISE_PRESETS["phone"], found.rotation_camera_imu, np.zeros(3), gyro_bias=found.gyro_bias,
        offset=found.time_offset,
    )  # fmt: skip
    correlation = acceleration_sign(problem)
    values = {"correlation of accelerations": correlation} if correlation else {}
    if correlation > OPPOSED:
        return Found(values)
    text = "its accelerations are opposed to those of the camera: all three axes have the wrong sign"
    remedy = "give the accelerometer as (-x, -y, -z): at rest, the axis that points up reads +9.8 m/s^2"
    return Found(values, (Finding("accelerometer axes", Level.UNUSABLE, text, remedy),))


def _identity() -> int:
    return next(k for k, option in enumerate(SIGNED_AXES) if np.array_equal(option, np.eye(3)))
