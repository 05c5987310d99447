"""Estimates in metres, with what inertial samples have told."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dvo.odometry.protocol import Estimate


class ScaleState(StrEnum):
    """What inertial samples have told of scale and vertical."""

    NONE = "none"
    INITIALISING = "initialising"
    ALIGNED = "aligned"
    REFINED = "refined"


@dataclass(frozen=True)
class InertialEstimate:
    """What is known beside a pose in metres.

    Attributes:
        velocity_w: ``(3,)`` of the sensor in the world, m/s.
        gyro_bias, accel_bias: ``(3,)`` rad/s and m/s^2.
        scale_sigma: standard deviation of the scale, relative.
        covariance: ``(9, 9)`` of the errors of position in the world (m), orientation (right tangent, rad) and velocity
            in the world (m/s), where heading and position of the world are held.
    """

    velocity_w: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    scale_sigma: float
    covariance: np.ndarray


@dataclass(frozen=True, repr=False)
class MetricEstimate(Estimate):
    """Estimate in metres.

    Attributes:
        scale_state: of the pose.
        inertial: velocity, biases and more, once they are known.
    """

    scale_state: ScaleState = ScaleState.NONE
    inertial: InertialEstimate | None = None
