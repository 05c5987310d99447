"""Samples of a sensor that moves at constant speed, upright, for the frames of a tracker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dvo.data.frame import Frame
from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import so3_exp
from dvo.odometry.inertial.smoother import GRAVITY

UPRIGHT = so3_exp(np.array([-np.pi / 2, 0.0, 0.0]))  # y down to z up
IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])


def with_samples(images: list[Frame]) -> list[Frame]:
    """Frames with samples of a sensor that moves at constant speed, upright."""
    out, before = [], images[0].timestamp - 0.1
    for frame in images:
        times = np.arange(before + 0.005, frame.timestamp + 1e-9, 0.005)
        forces = np.tile(-UPRIGHT.T @ GRAVITY, (len(times), 1))
        samples = InertialSamples(times, np.zeros((len(times), 3)), forces, IDENTITY, ImuNoise())
        out.append(replace(frame, inertial=samples))
        before = float(times[-1])
    return out
