"""Preintegrated samples between the keyframes of a window, once the scale is known.

A window alone holds its unit by the parallax of a few keyframes, which a fast turn replaces within half a second.
Samples hold it longer: the velocity of the first keyframe whose pose moves is known by the smoother, from the seconds
before, and how it changes from there on by the samples (:class:`dvo.ba.inertial_factor.InertialFactor`). Scale and
vertical are those of the aligned world. The scale is no assumption, but the unit that the window is led to: forces are
in metres. What is not known of the vertical acts as a bias of the accelerometer.

Velocities are in the unit of the window, in which an error of the scale is none. Poses that are held take no part: a
difference of two neighbours is too noisy to tell a velocity. Turns have a noise beyond that of the samples: the images
go on to tell the bias of the gyroscope to the smoother.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.blocks import IMU_BIAS, VELOCITY, StateBlock, inertial_blocks
from dvo.ba.factors import VectorPrior
from dvo.ba.kernels import Kernel
from dvo.ba.problem import Factor
from dvo.data.frame import Frame
from dvo.geometry import se3
from dvo.geometry.poses import pose_from
from dvo.map.window import Window
from dvo.odometry.inertial.estimator import InertialEstimator, Similarity
from dvo.odometry.inertial.factors import inertial_factors
from dvo.odometry.inertial.preintegration import Preintegration, preintegrate
from dvo.odometry.inertial.smoother import GRAVITY, NODE, Smoothed

LEAST_TURN_SIGMA = 5e-4
"""Deviation of the rotation of an interval at least, rad; that of visual rotations is about 1e-3."""
LEAST_SHIFT = 2e-4
"""Deviation of the time offset at least, seconds."""
WIDTH = 6.0
"""Of the robust kernel of an interval, deviations."""


@dataclass(frozen=True)
class _Intervals:
    """What a solution and the times of keyframes give."""

    motion: Preintegration  # in the unit of the window, of the intervals that samples cover
    first: np.ndarray  # (K,) keyframe at the start of each
    velocity: np.ndarray  # (3,) at the start of the first, in the world and unit of the window, known beforehand
    velocity_variance: float
    bias: np.ndarray  # (6,) likewise
    bias_variance: np.ndarray  # (6,)
    gravity: np.ndarray  # (3,) in the world and unit of the window
    extrinsics: np.ndarray  # (7,) sensor to camera, in the unit of the window


class InertialCoupling:
    """Inertial samples as a sensor of a window (:class:`dvo.odometry.window.sensors.WindowSensor`).

    Args:
        estimator: of scale, vertical and biases; without an alignment there are no measurements.
        similarity: from the present world of the window to the metric one; None: not known.
        variance: of a visual measurement of weight 1, feature pixels squared.
        optimised: number of newest keyframes whose poses move; the others are too noisy to tell a velocity.
    """

    def __init__(
        self, estimator: InertialEstimator, similarity: Callable[[], Similarity | None], variance: float, optimised: int
    ) -> None:
        self.estimator, self.similarity, self.variance, self.optimised = estimator, similarity, variance, optimised
        self._made: tuple[Smoothed, list[float], _Intervals | None] | None = None

    def observe(self, frame: Frame) -> None:
        """Nothing: the estimator has the samples."""

    def blocks(self, window: Window) -> Mapping[str, StateBlock]:
        """Velocity, units a second, and biases of each keyframe; see :class:`WindowSensor`."""
        made = self._intervals(window)
        if made is None:
            return {}
        times = np.array([frame.timestamp for frame in window.frames])
        centres = se3.inverse(window.poses_cw.double()).cpu().numpy()[:, :3]
        moving, device = torch.from_numpy(np.gradient(centres, times, axis=0)), window.poses_cw.device
        known = [frame.states.get(VELOCITY, other) for frame, other in zip(window.frames, moving, strict=True)]
        velocity = torch.stack([value.to(device, torch.float64) for value in known])[None]
        bias = torch.from_numpy(made.bias).to(device).expand(1, len(window), 6)
        # Unknown are the velocities in the chain of intervals, and biases that all of its keyframes share.
        chain, free = torch.zeros(len(window), dtype=torch.bool, device=device), len(made.first) + 1
        chain[int(made.first[0]) : int(made.first[0]) + free] = True
        blocks = inertial_blocks(velocity, bias)
        places = {VELOCITY: (chain.cumsum(0) - 1, free), IMU_BIAS: (torch.zeros_like(chain, dtype=torch.long), 1)}
        return {
            name: replace(blocks[name], slot=torch.where(chain, place, count), free=count)
            for name, (place, count) in places.items()
        }

    def factors(self, window: Window) -> tuple[Factor, ...]:
        """Motion between consecutive keyframes, and what is known of velocity and biases; see
        :class:`WindowSensor`."""
        made = self._intervals(window)
        if made is None:
            return ()
        first = torch.from_numpy(made.first)
        sigma = float(np.sqrt(self.variance))
        motion, _ = inertial_factors(
            made.motion, self.estimator.noise, made.extrinsics, gravity=made.gravity, ii=first, jj=first + 1,
            kernel=Kernel("cauchy", WIDTH * sigma),
        )  # fmt: skip
        known = [
            VectorPrior(
                name,
                torch.from_numpy(value)[None, None],
                torch.from_numpy(self.variance / variance)[None, None],
                first[:1],
            )  # fmt: skip
            for name, value, variance in (
                (VELOCITY, made.velocity, np.full(3, made.velocity_variance)),
                (IMU_BIAS, made.bias, made.bias_variance),
            )
        ]
        # Weights of a window are confidences, of which 1 stands for `variance`.
        found = replace(motion, root=motion.root * sigma), *known
        return found if window.poses_cw.device.type == "cpu" else tuple(_on(f, window.poses_cw.device) for f in found)

    def _intervals(self, window: Window) -> _Intervals | None:
        """Intervals between the keyframes of a window; None without an alignment, or without samples."""
        solution, similarity = self.estimator.solution, self.similarity()
        if not self.estimator.leads or solution is None or similarity is None or window.guests or len(window) < 3:
            return None
        times = [frame.timestamp for frame in window.frames]
        if self._made is None or self._made[0] is not solution or self._made[1] != times:
            self._made = solution, times, self._made_of(solution, similarity, np.array(times))
        return self._made[2]

    def _made_of(self, solution: Smoothed, similarity: Similarity, times: np.ndarray) -> _Intervals | None:
        begin = max(len(times) - self.optimised, 0)
        start, newest = self.estimator.state_at(times[begin]), self.estimator.last_state()
        samples = self.estimator.stream.near(times[begin] - 1.0, times[-1] + 1.0)
        if start is None or newest is None or samples is None or len(samples) < 2 or not (np.diff(times) > 0).all():
            return None
        bias = start.gyro_bias, start.accel_bias
        motion = preintegrate(samples, times[begin:] + solution.time_offset, *bias, self.estimator.noise)
        covered = np.cumprod(motion.covered).astype(bool)
        if not covered.any():
            return None
        first, scale = begin + np.flatnonzero(covered), similarity.scale
        motion = motion.where(covered)
        late = max(float(np.sqrt(solution.covariance[NODE, NODE])), LEAST_SHIFT)
        change = late * (motion.rates[:, 1] - motion.rates[:, 0])
        covariance = motion.covariance.copy()
        covariance[:, :3, :3] += change[:, :, None] * change[:, None] + LEAST_TURN_SIGMA**2 * np.eye(3)
        unit = np.repeat([1.0, 1 / scale, 1 / scale], 3)
        motion = replace(
            motion, velocity=motion.velocity / scale, position=motion.position / scale,
            covariance=covariance * unit[:, None] * unit, forces=motion.forces / scale,
            velocity_by_gyro=motion.velocity_by_gyro / scale, velocity_by_accel=motion.velocity_by_accel / scale,
            position_by_gyro=motion.position_by_gyro / scale, position_by_accel=motion.position_by_accel / scale,
        )  # fmt: skip
        # An error of the scale is none of the velocity in units.
        by = np.zeros((3, len(solution.covariance)))
        by[:, 6:9], by[:, NODE - 1], by[:, -4] = np.eye(3), -solution.velocity[-1], -solution.velocity[-1]
        speed = np.trace(by @ solution.covariance @ by.T + (start.covariance - newest.covariance)[6:9, 6:9]) / 3
        bias_variance = np.concatenate([np.diag(solution.covariance)[9:12], solution.force_variance])
        extrinsics = pose_from(solution.rotation_camera_imu, self.estimator.translation_camera_imu / scale)
        return _Intervals(
            motion, first, similarity.rotation.T @ start.velocity / scale, float(speed) / scale**2,
            np.concatenate(bias), bias_variance, similarity.rotation.T @ GRAVITY / scale, extrinsics,
        )  # fmt: skip


def _on(factor: Factor, device: torch.device) -> Factor:
    moved = {name: value.to(device) for name, value in vars(factor).items() if isinstance(value, Tensor)}
    there: Factor = replace(factor, **moved)  # type: ignore[type-var]
    return there
