"""Bundle adjustment with an inertial sensor as a layer: learn its bias from the error of the scale alone.

    python examples/train_inertial.py [--steps 45]

A scene is seen from five cameras with an inertial sensor, whose biases depend on its temperature. The camera alone does
not tell the scale; with the preintegrated samples `dvo.bundle_adjust` solves for it and for the velocities, wrongly if
the biases are wrong. A small network maps the temperature to the biases, and the gradient of the errors of scale and
velocity flows back through the solver.
"""

import argparse

import numpy as np
import torch
from torch import nn

import dvo
from dvo.ba.blocks import IMU_BIAS, LOG_SCALE, VELOCITY, inertial_blocks, vector_block
from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import invert_poses
from dvo.geometry.projection import reproject
from dvo.odometry.inertial.factors import inertial_factors
from dvo.odometry.inertial.preintegration import preintegrate
from dvo.synth.motion.motion import Sway
from dvo.synth.sensors.imu import GRAVITY, measure_imu

FRAMES, PATCHES, METRES = 5, 6, 2.0  # METRES are one unit of the poses
NOISE = ImuNoise(gyro_bias=1e-9, accel_bias=1e-9)
EXTRINSICS = np.array([0.0, 0, 0, 0, 0, 0, 1])  # the sensor is at the camera


def problem(rng: np.random.Generator):
    """Poses, patches, intrinsics and targets; edges; the inertial factor; true velocities; the temperature."""
    path = Sway(np.zeros(3), rng.normal(0, 0.3, 3), rng.normal(0, 0.3, (2, 3)), 4.0, rng.uniform(0, 6), 0.0,
                rng.normal(0, 0.3), rng.normal(0, 0.05, 3))  # fmt: skip
    stamps, times = np.arange(0, 1.2, 0.005), 0.1 + 0.2 * np.arange(FRAMES)
    imu = measure_imu(path, stamps, noise=NOISE, seed=int(rng.integers(1 << 30)))
    heat = rng.uniform(-1, 1)
    wrong = np.array([0.02, -0.01, 0.01, 0.3, -0.2, 0.25]) * np.tanh(3 * heat)
    samples = InertialSamples(stamps, imu.gyro + wrong[:3], imu.accel + wrong[3:], EXTRINSICS)
    intervals = preintegrate(samples, times, np.zeros(3), np.zeros(3), NOISE)
    inertial, _ = inertial_factors(intervals, NOISE, EXTRINSICS, gravity=GRAVITY)

    def at(moments):
        return torch.from_numpy(path.poses_wc(moments)[:, :3])

    poses = torch.from_numpy(invert_poses(path.poses_wc(times)))[None]
    poses[..., :3] /= METRES
    count = FRAMES * PATCHES
    xy = 8 + 48 * torch.from_numpy(rng.uniform(size=(1, count, 2, 1, 1)))
    patches = torch.cat([xy, 0.4 + 0.3 * torch.from_numpy(rng.uniform(size=(1, count, 1, 1, 1)))], 2)
    intrinsics = torch.tensor([60.0, 60.0, 32.0, 32.0], dtype=torch.float64).expand(1, FRAMES, 4)
    kk = torch.arange(count).repeat_interleave(FRAMES)
    jj = torch.arange(FRAMES).repeat(count)
    edges = [index[kk // PATCHES != jj] for index in (kk // PATCHES, jj, kk)]
    targets = reproject(poses, patches, intrinsics, *edges).coords[:, :, 0, 0]
    velocities = (at(times + 1e-3) - at(times - 1e-3))[None] / 2e-3
    return (poses, patches, intrinsics, targets), edges, inertial, velocities, torch.tensor([[heat]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=45)
    steps = parser.parse_args().steps
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    bias_of = nn.Sequential(nn.Linear(1, 16), nn.Tanh(), nn.Linear(16, 6))
    size = torch.tensor([0.05] * 3 + [0.5] * 3)
    optimizer = torch.optim.Adam(bias_of.parameters(), 4e-2)
    history = []
    for step in range(steps):
        (poses, patches, intrinsics, targets), (ii, jj, kk), inertial, velocities, heat = problem(rng)
        bias = (size * bias_of(heat)).double().expand(1, FRAMES, 6)
        blocks = inertial_blocks(torch.zeros_like(velocities), bias, log_scale=torch.zeros(1, dtype=torch.float64))
        blocks[IMU_BIAS] = vector_block(bias, held=True)
        options = dvo.BAOptions(fixed=2, iterations=3, damping=dvo.BADamping(1e-6, 0.0, 1e-6))
        weights = torch.full_like(targets, 10.0)
        found = dvo.bundle_adjust(poses, patches, intrinsics, targets, weights, ii, jj, kk, options,
                                  factors=(inertial,), blocks=blocks)  # fmt: skip
        scale = found.blocks[LOG_SCALE].flatten() - np.log(METRES)
        error = scale.abs().mean() + (found.blocks[VELOCITY] - velocities).norm(dim=-1).mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        history.append(error.item())
        if step % 10 == 0:
            print(f"step {step}: error {error.item():.4f}")
    third = max(1, steps // 3)
    print(f"error, first third {sum(history[:third]) / third:.4f}, last third {sum(history[-third:]) / third:.4f}")


if __name__ == "__main__":
    main()
