"""Inertial samples and noise that a caller gives."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.inertial import ImuNoise, InertialSamples, checked_samples


@pytest.mark.parametrize("name", ["gyro", "accel_walk", "gyro_bias"])
@pytest.mark.parametrize("value", [0, 0.0, -1e-3, 1e-200, 1e200, float("nan"), float("inf"), "phone", None, True])
def test_noise_that_cannot_be_is_refused(name, value):
    with pytest.raises(DvoError, match=f"noise.{name}"):
        ImuNoise(**{name: value})


def samples(**changes: object) -> InertialSamples:
    whole: dict[str, object] = {"timestamps": [0.0, 0.1, 0.2], "gyro": np.zeros((3, 3)), "accel": np.ones((3, 3))}
    return InertialSamples(**(whole | changes))  # type: ignore[arg-type]


BAD = {
    "not a number": (
        {"gyro": [[0, 0, 0], [0, np.nan, 0], [0, 0, 0]]},
        "inertial: gyro: is .*nan.* at sample 1.*not finite",
    ),
    "no measurement": ({"accel": [[1e300, 0, 0]] * 3}, "inertial: accel: is .*1e.300.* at sample 0"),
    "nanoseconds": ({"timestamps": [1.7e18, 1.7e18 + 1e7, 1.7e18 + 2e7]}, "inertial: timestamps: is .*sample 0"),
    "out of order": (
        {"timestamps": [0, 2, 1]},
        "timestamps: times do not increase: 2.0* and 1.0* s at samples 1 and 2",
    ),
    "repeated": ({"timestamps": [0, 0, 1]}, "timestamps: times do not increase: 0.0* and 0.0* s at samples 0 and 1"),
    "millimetres": ({"T_camera_imu": [40.0, 3, 0, 0, 0, 0, 1]}, "T_camera_imu: the sensor is 40.11 m from the camera"),
    "no rotation": ({"T_camera_imu": [0, 0, 0, 0, 0, 0, 0]}, "T_camera_imu: .* is not a pose"),
}


@pytest.mark.parametrize("case", BAD)
def test_samples_that_cannot_be_are_refused_with_their_place(case):
    changes, message = BAD[case]
    with pytest.raises(DvoError, match=message):
        checked_samples(samples(**changes))


def test_no_samples_are_samples():
    assert len(checked_samples(InertialSamples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))))) == 0
    assert len(checked_samples(samples())) == 3
