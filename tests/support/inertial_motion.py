"""A body that moves along known curves: its inertial samples, and a window of patches seen by a camera on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.ba.inertial_factor import BiasWalk, InertialFactor
from dvo.ba.patch_problem import PatchProblem
from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry import se3
from dvo.geometry.poses import compose_poses, invert_poses, matrix_to_quaternion, pose_from, so3_exp
from dvo.geometry.projection import reproject
from dvo.odometry.inertial.factors import inertial_factors
from dvo.odometry.inertial.preintegration import preintegrate

DOWN = np.array([0.0, 0.0, -9.81])
NOISE = ImuNoise(1e-3, 1e-5, 1e-2, 1e-4)


class Motion:
    """Rotation by two turns about fixed axes, position by sines: all derivatives are known."""

    def __init__(self, seed: int, speed: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.axes = rng.normal(size=(2, 3))
        self.axes /= np.linalg.norm(self.axes, axis=1, keepdims=True)
        self.turns = rng.uniform(0.5, 1.5, 2) * np.array([1.5, -1.2]) * speed
        self.amount = rng.uniform(0.3, 1.0, (3, 3))
        self.frequency = rng.uniform(0.5, 4.0, (3, 3)) * speed
        self.phase = rng.uniform(0, 6, (3, 3))

    def rotation(self, t: np.ndarray) -> np.ndarray:
        first, second = (so3_exp(np.multiply.outer(w * t, a)) for w, a in zip(self.turns, self.axes, strict=True))
        return first @ second

    def position(self, t: np.ndarray) -> np.ndarray:
        return (self.amount * np.sin(np.multiply.outer(t, self.frequency) + self.phase)).sum(-1)

    def velocity(self, t: np.ndarray) -> np.ndarray:
        return (self.amount * self.frequency * np.cos(np.multiply.outer(t, self.frequency) + self.phase)).sum(-1)

    def samples(self, t: np.ndarray) -> InertialSamples:
        second = so3_exp(np.multiply.outer(self.turns[1] * t, self.axes[1]))
        gyro = (np.swapaxes(second, -1, -2) @ (self.turns[0] * self.axes[0])) + self.turns[1] * self.axes[1]
        swing = np.sin(np.multiply.outer(t, self.frequency) + self.phase)
        force = -(self.amount * self.frequency**2 * swing).sum(-1) - DOWN
        accel = (np.swapaxes(self.rotation(t), -1, -2) @ force[..., None])[..., 0]
        return InertialSamples(t, gyro, accel)

    def truth(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the intervals between times measure: rotation, velocity, position."""
        r, p, v, t = self.rotation(times), self.position(times), self.velocity(times), np.diff(times)[:, None]
        back = np.swapaxes(r[:-1], -1, -2)
        dv = back @ (np.diff(v, axis=0) - DOWN * t)[..., None]
        dp = back @ (np.diff(p, axis=0) - v[:-1] * t - 0.5 * DOWN * t**2)[..., None]
        return back @ r[1:], dv[..., 0], dp[..., 0]


@dataclass(frozen=True)
class InertialWindow:
    """A batch of one graph in double precision, at its true values, and its inertial measurements.

    ``bias`` (6,) is what the samples contain; the factor is linearised without it.
    """

    problem: PatchProblem
    factor: InertialFactor
    walk: BiasWalk
    velocity: Tensor  # (1, N, 3)
    bias: Tensor
    gravity: Tensor  # (1, 3)

    @property
    def biases(self) -> Tensor:
        """``(1, N, 6)``"""
        return self.bias.expand(*self.velocity.shape[:2], 6)


def inertial_window(seed: int = 0, frames: int = 5, per_frame: int = 6, late: float = 0.0) -> InertialWindow:
    """Frames 0.15 s apart; ``late`` is by how much the intervals are integrated later than the frames."""
    rng, g = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    motion, times = Motion(seed, 0.8), 0.3 + 0.15 * np.arange(frames)
    bias = np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.05, 3)])
    samples = motion.samples(np.arange(0, 0.6 + 0.15 * frames, 1 / 500))
    samples = InertialSamples(samples.timestamps, samples.gyro + bias[:3], samples.accel + bias[3:])
    T_camera_imu = pose_from(so3_exp(rng.normal(0, 1, 3)), rng.normal(0, 0.1, 3))
    zero = np.zeros(3)
    intervals = preintegrate(samples, times + late, zero, zero, NOISE)
    factor, walk = inertial_factors(intervals, NOISE, T_camera_imu, gravity=DOWN, time_offset=late)
    poses_wb = np.concatenate([motion.position(times), matrix_to_quaternion(motion.rotation(times))], 1)
    poses_cw = torch.from_numpy(compose_poses(T_camera_imu, invert_poses(poses_wb)))[None]

    count = frames * per_frame
    place = torch.rand(1, count, 2, 1, 1, generator=g, dtype=torch.float64) * torch.tensor([40.0, 30.0])[:, None, None]
    depth = 0.2 + 0.2 * torch.rand(1, count, 1, 1, 1, generator=g, dtype=torch.float64)
    patches = torch.cat([place, depth], 2)
    intrinsics = torch.tensor([30.0, 30.0, 20.0, 15.0], dtype=torch.float64).expand(1, frames, 4).contiguous()
    kk = torch.arange(count).repeat_interleave(frames)
    jj, ii = torch.arange(frames).repeat(count), kk // per_frame
    other = ii != jj
    ii, jj, kk = ii[other], jj[other], kk[other]
    seen = reproject(poses_cw, patches, intrinsics, ii, jj, kk)
    targets = seen.coords[:, :, 0, 0]
    near = ((targets - torch.tensor([20.0, 15.0])).abs() < 60).all(-1, keepdim=True) & (seen.valid.view(1, -1, 1) > 0)
    weights = torch.where(near, 4.0, 0.0).expand_as(targets).double()
    problem = PatchProblem(poses_cw, patches, intrinsics, torch.where(near, targets, 0.0), weights, ii, jj, kk)
    velocity = torch.from_numpy(motion.velocity(times))[None]
    return InertialWindow(problem, factor, walk, velocity, torch.from_numpy(bias), torch.from_numpy(DOWN)[None])


def disturbed(poses_cw: Tensor, size: float, seed: int = 0, fixed: int = 1) -> Tensor:
    """Poses with random steps, but for the first ones."""
    g = torch.Generator().manual_seed(seed)
    step = size * torch.randn(*poses_cw.shape[:2], 6, generator=g, dtype=torch.float64)
    step[:, :fixed] = 0
    return se3.retract(poses_cw, step)
