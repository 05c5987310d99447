"""Check of an inertial sensor: its samples by themselves, and against the orientations of a camera.

Initialisation fails for four reasons that look alike: stamps, noise values, extrinsics, and too little motion. This
check tells them apart before anything is tracked.
"""

from __future__ import annotations

import numpy as np

from dvo.data.inertial import InertialSamples
from dvo.odometry.inertial.findings import Finding, Level, SensorReport
from dvo.odometry.inertial.sample_checks import check_axes, check_stamps, check_values
from dvo.odometry.inertial.vision_checks import check_against_vision

_MIN_FRAMES = 20


def check_sensor(
    samples: InertialSamples,
    timestamps: np.ndarray | None = None,
    rotations_wc: np.ndarray | None = None,
    positions_wc: np.ndarray | None = None,
) -> SensorReport:
    """Check inertial samples.

    Args:
        samples: in the order of the file, as they stand there: times may repeat and need not increase, units may be
            wrong.
        timestamps: ``(N,)`` increasing times of frames with a pose in one world, seconds; None without vision.
        rotations_wc: ``(N, 3, 3)`` their orientations, camera to world.
        positions_wc: ``(N, 3)`` their places in any unit; None: the sign of the accelerometer is not checked, and its
            bias against what usual motion leaves.

    Returns:
        Numbers and findings.
    """
    samples, stamps = check_stamps(samples)
    values, findings = dict(stamps.values), list(stamps.findings)
    if len(samples) < 3:
        return SensorReport(values, tuple(findings))
    samples, found = check_values(samples)
    values |= found.values
    findings += found.findings
    alignment = None
    if timestamps is not None and rotations_wc is not None and len(timestamps) >= _MIN_FRAMES:
        alignment, found = check_against_vision(samples, timestamps, rotations_wc, positions_wc)
        values |= found.values
        findings = _joined(findings, found.findings)
    else:
        text = "time offset and axes are not checked without orientations of the camera"
        if timestamps is not None:
            text = f"time offset and axes are not checked: {len(timestamps)} frames have a pose in one segment"
        remedy = f"give images of which {_MIN_FRAMES} or more can be tracked"
        findings.append(Finding("no vision", Level.NOTE, text, remedy))
        if samples.T_camera_imu is None:
            text = "the pose of the sensor in the camera is not stated"
            remedy = "state T_camera_imu in --imu-calib, or calibrate with Kalibr"
            findings.append(Finding("no extrinsics", Level.WARNING, text, remedy))
    axes = None if {"axes", "accelerometer axes"} & {one.name for one in findings} else check_axes(samples)
    findings += [] if axes is None else [axes]
    if samples.noise is None:
        text = "the noise of the sensor is not stated, that of a phone is assumed"
        remedy = "state noise, or a preset (euroc, action, phone), in --imu-calib"
        findings.append(Finding("no noise", Level.NOTE, text, remedy))
    return SensorReport(values, tuple(findings), alignment)


def _joined(alone: list[Finding], seen: tuple[Finding, ...]) -> list[Finding]:
    """Findings of the samples alone and of vision; of the same name those of vision only if they are graver."""
    ranks = {one.name: one.rank for one in alone}
    graver = {one.name for one in seen if one.rank < ranks.get(one.name, len(Level))}
    return [one for one in alone if one.name not in graver] + [one for one in seen if one.name in graver]
