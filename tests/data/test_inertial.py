"""Inertial samples and noise that a caller gives."""

from __future__ import annotations

import pytest

from dvo.core.errors import DvoError
from dvo.data.inertial import ImuNoise


@pytest.mark.parametrize("name", ["gyro", "accel_walk", "gyro_bias"])
@pytest.mark.parametrize("value", [0, 0.0, -1e-3, 1e-200, 1e200, float("nan"), float("inf"), "phone", None, True])
def test_noise_that_cannot_be_is_refused(name, value):
    with pytest.raises(DvoError, match=f"noise.{name}"):
        ImuNoise(**{name: value})
