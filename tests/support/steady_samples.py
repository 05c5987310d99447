"""Samples of a sensor that moves at constant speed, upright, for frames of a tracker; and an alignment with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dvo.data.frame import Frame
from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import so3_exp
from dvo.odometry.inertial.estimator import Similarity
from dvo.odometry.inertial.smoother import GRAVITY, Similarities, Smoothed
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.protocol import ScaleState

UPRIGHT = so3_exp(np.array([-np.pi / 2, 0.0, 0.0]))  # y down to z up
SPEED = np.array([0.4, 0.0, 0.0])
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


def align(odometry: PatchOdometry, time: float) -> None:
    """Give the estimator an alignment: two metres a unit, upright."""
    estimator = odometry.inertial.estimator
    estimator.state, estimator.reason = ScaleState.ALIGNED, ""
    estimator.worlds = {0: Similarity(2.0, UPRIGHT, np.zeros(3))}
    worlds = Similarities(np.log([2.0]), UPRIGHT[None], np.zeros((1, 3)))
    rows, zero = np.zeros((1, 3)), np.zeros((1, 3))
    covariance = 1e-6 * np.eye(19 + 8)
    estimator.solution = Smoothed(
        np.array([time]), np.zeros(1, int), UPRIGHT[None], rows, SPEED[None], zero, zero, np.log([2.0]), worlds, 0.0,
        np.eye(3), np.zeros(3), 1.0, covariance, 0.0, 0.0, np.zeros(2),
    )  # fmt: skip
    estimator.update = lambda nodes, worlds: None  # type: ignore[method-assign]
    estimator.settle = lambda nodes, worlds, confirm: estimator.solution  # type: ignore[method-assign]
