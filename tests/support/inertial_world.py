"""Tracks and inertial samples of a body that moves through a room, without images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import compose_poses, look_rotation, pose_from, pose_matrices, so3_exp
from dvo.odometry.classical.msckf.start import Observed
from dvo.synth.sensors.imu import measure_imu

T_CAMERA_IMU = np.array([0.05, -0.03, 0.02, 0.5, -0.5, 0.5, 0.5])
SIZE, FOCAL, RATE, FRAMES = np.array([640, 480]), 400.0, 200.0, 20.0
LOW, HIGH = np.array([-5.0, -5, -2]), np.array([5.0, 5, 2.5])


class Hand:
    """Sum of sixteen waves from 0.08 to 2 Hz in every coordinate, after ``rest`` seconds without motion.

    ``speed`` and ``turn`` are root mean squares, m/s and rad/s; ``T`` is a frame that the body carries.
    """

    def __init__(self, seed, rest, speed=0.5, turn=0.5, T=None):
        rng = np.random.default_rng(seed)
        self.rate = 2 * np.pi * np.exp(rng.uniform(np.log(0.08), np.log(2.0), 16))
        self.phase = rng.uniform(0, 2 * np.pi, (16, 6))
        size = rng.normal(size=(16, 6)) / self.rate[:, None] ** 1.5
        own = np.sqrt(((size * self.rate[:, None]) ** 2).sum(0))
        self.size = size / own * np.array([speed, speed, 0.5 * speed, turn, 0.6 * turn, 0.5 * turn])
        self.rest, self.T = rest, T

    def poses_wc(self, times):
        later = np.clip(np.asarray(times, float) - self.rest, 0, None)
        if self.rest:  # sets out within two seconds
            later = np.where(later < 2, later**3 / 4 - later**4 / 16, later - 1)
        waves = np.sin(later[:, None, None] * self.rate[:, None] + self.phase) - np.sin(self.phase)
        x = (waves * self.size).sum(1)
        forward = look_rotation(np.array([0.0, 1, 0]), np.array([0.0, 0, 1]))
        pose = pose_from(forward @ so3_exp(x[:, [4, 3, 5]]), x[:, :3])
        return pose if self.T is None else compose_poses(pose, self.T)


class Straight:
    """Constant velocity without rotation."""

    def __init__(self, T=None):
        self.T = T

    def poses_wc(self, times):
        times = np.asarray(times, float)
        forward = look_rotation(np.array([0.0, 1, 0]), np.array([0.0, 0, 1]))
        pose = pose_from(np.tile(forward, (len(times), 1, 1)), np.outer(times, [0.4, 0.2, 0.05]))
        return pose if self.T is None else compose_poses(pose, self.T)


@dataclass(frozen=True)
class World:
    """What the sensors measure, and the truth.

    Attributes:
        frames: tracks of every image, with the samples since the one before it.
        times: of the images by the clock of the samples.
        body: motion of the sensor.
        noise: of the samples.
    """

    frames: list[tuple[Observed, InertialSamples]]
    times: np.ndarray
    body: Hand | Straight
    noise: ImuNoise

    def truth(self, time):
        """``R, p, v`` of the sensor."""
        poses = pose_matrices(self.body.poses_wc(np.array([time - 1e-4, time, time + 1e-4])))
        return poses[1, :3, :3], poses[1, :3, 3], (poses[2, :3, 3] - poses[0, :3, 3]) / 2e-4


def world(seed, duration, *, rest=0.0, noise=ImuNoise(), pixel=1.0, offset=0.0, readout=0.0, count=90, motion=None):  # noqa: B008
    """Points on the walls of a room; images are taken ``offset`` seconds later than their stamps say."""
    rng = np.random.default_rng([seed, 1])
    camera, body = (motion or Hand(seed, rest)), (type(motion)(T=T_CAMERA_IMU) if motion else None)
    body = body or Hand(seed, rest, T=T_CAMERA_IMU)
    stamps = np.arange(int((duration + 0.3) * RATE)) / RATE
    imu = measure_imu(body, stamps, noise=noise, seed=seed)
    walls = [rng.uniform(LOW, HIGH, (150, 3)) for _ in range(6)]
    for k, wall in enumerate(walls):
        wall[:, k // 2] = (LOW, HIGH)[k % 2][k // 2]
    points = np.concatenate(walls)
    times = np.arange(int(duration * FRAMES)) / FRAMES
    frames, last, tracked, fresh = [], -1.0, {}, 0
    for time, matrix in zip(times, pose_matrices(camera.poses_wc(times + offset)), strict=True):
        local = (points - matrix[:3, 3]) @ matrix[:3, :3]
        for _ in range(2 if readout else 0):
            rows = np.clip(local[:, 1] / np.maximum(local[:, 2], 0.1) * FOCAL / SIZE[1], -0.5, 0.5)
            moved = pose_matrices(camera.poses_wc(time + offset + rows * readout))
            local = np.einsum("kji,kj->ki", moved[:, :3, :3], points - moved[:, :3, 3])
        uv = local[:, :2] / np.maximum(local[:, 2:], 0.1) * FOCAL
        seen = (local[:, 2] > 0.2) & (np.abs(uv) < SIZE / 2 - 5).all(1)
        tracked = {point: track for point, track in tracked.items() if seen[point] and rng.random() > 0.01}
        for point in rng.permutation(np.flatnonzero(seen)).tolist():
            if len(tracked) < count and point not in tracked:
                tracked[point] = fresh
                fresh += 1
        rows = np.array(sorted(tracked, key=tracked.__getitem__), int)
        ids = np.array([tracked[row] for row in rows.tolist()], int)
        xy = (uv[rows] + rng.normal(0, pixel, (len(rows), 2))) / FOCAL
        new = (stamps > last) & (stamps <= time + 1e-9)
        last = time + 1e-9
        samples = InertialSamples(stamps[new], imu.gyro[new], imu.accel[new], T_CAMERA_IMU, noise)
        frames.append((Observed(time, ids, xy, uv[rows, 1] / SIZE[1] * readout), samples))
    return World(frames, times + offset, body, noise)
