"""Bundle adjustment of images and inertial samples together, at the end of a recording.

The smoother (:mod:`dvo.odometry.inertial.smoother`) takes a visual trajectory as it is, but for a unit that
drifts. Where the images alone hold that unit loosely, as in a large hall, it drifts by some percent a second, and the
scale is told as loosely. Here the measurements of the patches and the preintegrated samples are solved for at once: for
poses and depths of all frames in metres, and velocities and biases at nodes a fraction of a second apart (the full
visual-inertial adjustment of Campos et al., "ORB-SLAM3", 2021). Heading and place of the first camera are held.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.blocks import GRAVITY as DOWN
from dvo.ba.blocks import IMU_BIAS, POSES, TIME_OFFSET, VELOCITY, inertial_blocks
from dvo.ba.factors import VectorPrior
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor, StateBlock
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions, GlobalBAResult, SparseProblem
from dvo.ba.sparse.levenberg import LMOptions
from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry import se3, so3
from dvo.geometry.poses import pose_from, split
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter
from dvo.odometry.inertial.factors import inertial_factors
from dvo.odometry.inertial.preintegration import preintegrate
from dvo.odometry.inertial.smoother import GRAVITY, Smoothed, spaced

MOST_FRAMES = 3000
"""Frames that are solved for at once; of more the kept keyframes alone, and of more of these none."""
ROUNDS, ITERATIONS, TOLERANCE, SAME = 3, 12, 1e-5, 10
"""Solutions, each with samples integrated with the biases of the one before and rows corrected for its motion; steps
of each at most, relative decrease of the cost at which it ends, and times that from one to the next at which all do."""
DAMPING = 1e-13
"""At the start. Images hold each pose so much better than samples hold the size of all together that a usual damping,
a fraction of the diagonal, would hold that."""
VISUAL = 10.0
"""Variance of a measurement beyond that of the covariances of poses: aligned ones have ten times the network's weight,
with errors that last from frame to frame."""
DEPTHS = (1e-5, 1e3)
"""Range of inverse depths, 1/m."""
OFFSET_SIGMA = 5e-3
"""Of the time offset, about that of the smoother, seconds."""
FASTEST = 1e3
"""Deviation of a velocity that nothing may measure, between two gaps of the samples, m/s."""
LEAST_TURN_SIGMA = 1e-5
"""Deviation of the rotation of an interval at least, rad."""


@dataclass(frozen=True)
class VisualInertialSolution:
    """Solution of images and samples.

    Attributes:
        identifiers: ``(N,)`` of the frames.
        poses_cw: ``(N, 7)`` world to camera, metres; the z axis of the world points up.
        depths: ``(N, M)`` inverse depths of the patches, 1/m.
        states: the start with the states of the nodes replaced, all in one segment with a scale of 1.
        change: logarithm of the size of the trajectory over that of the start.
        scale_sigma: deviation of the logarithm of the size; nan where it is not told.
        inertial_error: mean squared whitened residual of the preintegrated motion.
    """

    identifiers: Tensor
    poses_cw: Tensor
    depths: Tensor
    states: Smoothed
    change: float
    scale_sigma: float
    inertial_error: float


def adjust_with_samples(
    part: PatchProblem,
    times: np.ndarray,
    start: Smoothed,
    samples: InertialSamples,
    noise: ImuNoise,
    *,
    variance: float,
    spacing: float,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
    shutter: Shutter | None = None,
    tolerance: float = TOLERANCE,
) -> VisualInertialSolution | None:
    """Solve for a world by its images and samples.

    Args:
        part: measurements of all frames of the world, with poses and inverse depths in metres, upright, to start from.
        times: ``(N,)`` increasing, of the frames, seconds, clock of the camera.
        start: velocities, biases, time offset and extrinsic calibration to start from; the last stays.
        samples: of the sensor.
        noise: of the samples.
        variance: of a visual measurement of weight 1, feature pixels squared.
        spacing: of the nodes, seconds.
        options: of the final adjustment: its last kernel, and the longest residual.
        shutter: timing of the rows; None for a global shutter.
        tolerance: relative decrease of the cost at which a solution ends.

    Returns:
        The solution; None if samples do not cover two nodes, or nothing was found.
    """
    count = len(times)
    nodes = np.array(spaced(times, [0] * count, spacing))
    stamps = times[nodes] + start.time_offset
    nodes = nodes[(stamps >= samples.timestamps[0]) & (stamps <= samples.timestamps[-1])]
    if len(nodes) < 3:
        return None
    states = _States.of(start, times[nodes])
    fixed = torch.arange(count) == 0
    settings = GlobalBAOptions(
        fixed, options.kernels[-1], options.max_residual, depth_range=DEPTHS,
        solver=LMOptions(max_iterations=ITERATIONS, tolerance=tolerance, damping=DAMPING),
    )  # fmt: skip
    sigma = float(np.sqrt(VISUAL * variance))
    extrinsics = pose_from(start.rotation_camera_imu, -start.rotation_camera_imu @ start.lever)
    poses, depths, frames = part.poses_cw, part.inverse_depths.view(count, -1), torch.arange(count)
    problem: PatchProblem = part
    found: GlobalBAResult | None = None
    before = np.inf
    for _ in range(ROUNDS):
        problem = part
        if shutter is not None and shutter.readout > 0:
            track = PoseTrack.through(torch.from_numpy(times), poses, shutter)
            problem = as_global_shutter(part, poses, depths, frames, track, shutter)
        given = states.measured(samples, times[nodes], nodes, noise, extrinsics, sigma)
        if given is None:
            return None
        factors, blocks = given
        problem = problem.with_values(poses_cw=poses, inverse_depths=depths.flatten(), factors=factors, blocks=blocks)
        found = solve(problem, settings)
        poses, depths = se3.normalise(found.poses_cw), found.patches[:, 2, 0, 0].view(count, -1)
        states = states.after(found)
        if abs(before - found.cost) <= SAME * tolerance * before:
            break
        before = found.cost
    assert found is not None
    problem = problem.with_values(poses_cw=poses, patches=found.patches, blocks=_moved(problem.blocks, found))
    if not math.isfinite(found.cost):
        return None
    error = _inertial_error(problem) / sigma**2
    upright = states.upright()
    poses_wc = se3.compose(upright.expand(count, 7), se3.inverse(poses))
    smoothed = states.smoothed(start, times[nodes], split(poses_wc.numpy()[nodes]), split(upright.numpy())[0])
    change = float(torch.log(_size(se3.inverse(poses)) / _size(se3.inverse(part.poses_cw))))
    sigma_scale = sigma * _scale_deviation(problem, settings)
    return VisualInertialSolution(
        part.identifiers, se3.inverse(poses_wc), depths, smoothed, change, sigma_scale, error
    )  # fmt: skip


@dataclass(frozen=True)
class _States:
    """States of the nodes, in the axes of the start."""

    velocity: Tensor  # (S, 3)
    bias: Tensor  # (S, 6)
    down: Tensor  # (3,)
    offset: float

    @classmethod
    def of(cls, start: Smoothed, times: np.ndarray) -> _States:
        known = np.concatenate([start.velocity, start.gyro_bias, start.accel_bias], 1)
        values = np.stack([np.interp(times, start.times, column) for column in known.T], 1)
        return cls(
            torch.from_numpy(values[:, :3]), torch.from_numpy(values[:, 3:]), torch.from_numpy(GRAVITY),
            start.time_offset,
        )  # fmt: skip

    def after(self, found: GlobalBAResult) -> _States:
        blocks = found.blocks
        return _States(
            blocks[VELOCITY][0], blocks[IMU_BIAS][0], blocks[DOWN][0, 0] * self.down.norm(),
            float(blocks[TIME_OFFSET]),
        )  # fmt: skip

    def measured(
        self, samples: InertialSamples, times: np.ndarray, nodes: np.ndarray, noise: ImuNoise, extrinsics: np.ndarray,
        sigma: float,
    ) -> tuple[tuple[Factor, ...], dict[str, StateBlock]] | None:  # fmt: skip
        """Factors in units of measurements whose deviation is ``sigma``, and blocks; None without samples."""
        bias = self.bias.numpy()
        motion = preintegrate(samples, times + self.offset, bias[:-1, :3], bias[:-1, 3:], noise)
        covered = motion.covered
        if not covered.any():
            return None
        motion = motion.where(covered)
        covariance = motion.covariance.copy()
        covariance[:, :3, :3] += LEAST_TURN_SIGMA**2 * np.eye(3)
        first, at = torch.from_numpy(np.flatnonzero(covered)), torch.from_numpy(nodes)
        moves, walk = inertial_factors(
            replace(motion, covariance=covariance), noise, extrinsics, gravity=self.down.numpy(),
            time_offset=self.offset, ii=at[first], jj=at[first + 1], state_i=first, state_j=first + 1,
        )  # fmt: skip
        # Nothing ties the biases after a gap to those before it.
        begins = torch.from_numpy(np.flatnonzero(np.concatenate([[True], ~covered])))
        usual = np.repeat([noise.gyro_bias, noise.accel_bias], 3)
        priors = (
            VectorPrior(IMU_BIAS, torch.zeros(1, 1, 6).double(), _row(sigma**2 / usual**2), begins),
            VectorPrior(VELOCITY, self.velocity[None, begins], _row(np.full(3, sigma**2 / FASTEST**2)), begins),
            VectorPrior(TIME_OFFSET, _row([self.offset]), _row([sigma**2 / OFFSET_SIGMA**2]), torch.zeros(1).long()),
        )
        blocks = inertial_blocks(
            self.velocity[None], self.bias[None], gravity=self.down[None],
            time_offset=torch.tensor([self.offset], dtype=torch.float64),
        )  # fmt: skip
        moves, walk = replace(moves, root=moves.root * sigma), replace(walk, weight=walk.weight * sigma**2)
        return (moves, walk, *priors), blocks

    def upright(self) -> Tensor:
        """``(7,)`` turn of the world by which gravity points down again."""
        down = self.down / self.down.norm()
        axis = torch.linalg.cross(down, down.new_tensor([0.0, 0.0, -1.0]))
        length = axis.norm()
        turn = so3.exp(axis * (torch.atan2(length, -down[2]) / length.clamp(min=1e-12)))
        return torch.cat([turn.new_zeros(3), turn])

    def smoothed(
        self, start: Smoothed, times: np.ndarray, cameras: tuple[np.ndarray, np.ndarray], turn: np.ndarray
    ) -> Smoothed:
        """The start with these states, and poses of cameras ``(S, 3, 3)``, ``(S, 3)``, in an upright world."""
        rotation = cameras[0] @ start.rotation_camera_imu
        position = cameras[1] - (rotation @ start.lever[:, None])[..., 0]
        count, bias = len(times), self.bias.numpy()
        return replace(
            start, times=times, segment=np.zeros(count, int), rotation=rotation, position=position,
            velocity=self.velocity.numpy() @ turn.T, gyro_bias=bias[:, :3], accel_bias=bias[:, 3:],
            log_scale=np.zeros(count), time_offset=self.offset, past=None,
        )  # fmt: skip


def _row(values: np.ndarray | list[float]) -> Tensor:
    return torch.tensor(np.asarray(values, np.float64))[None, None]


def _moved(blocks: Mapping[str, StateBlock], found: GlobalBAResult) -> dict[str, StateBlock]:
    return {name: block.with_value(found.blocks[name]) for name, block in blocks.items()}


def _inertial_error(problem: PatchProblem) -> float:
    values = {POSES: problem.poses_cw[None], **{name: block.value for name, block in problem.blocks.items()}}
    return float(problem.factors[0].linearise(values).residual.square().mean())


def _size(poses_wc: Tensor) -> Tensor:
    """Root mean square distance of cameras from their middle."""
    return (poses_wc[:, :3] - poses_wc[:, :3].mean(0)).square().sum(1).mean().sqrt()


def _scale_deviation(problem: PatchProblem, options: GlobalBAOptions) -> float:
    """Deviation of the logarithm of :func:`_size`, where that of a measurement of weight 1 is 1.

    With the derivative ``a`` of the logarithm the variance is ``a^T H^-1 a``.
    """
    system = SparseProblem(problem, options)
    equations = system.linearise(system.state)
    poses_wc = se3.inverse(problem.poses_cw)
    away = poses_wc[:, :3] - poses_wc[:, :3].mean(0)
    # A left tangent of T_cw moves the centre by -R_wc tau.
    by = -(away[:, None] @ so3.matrix(poses_wc[:, 3:]))[:, 0] / away.square().sum()
    (slots,) = system.parts.slots(system.state, POSES, torch.arange(len(by)))
    gradient = torch.zeros_like(equations.g_p)
    free = slots < system.parts.count
    gradient[slots[free], :3] = by[free]
    solved = replace(equations, g_p=gradient, g_l=torch.zeros_like(equations.g_l)).step(0.0, options.solver)[0][0]
    return float((gradient * solved).sum().sqrt())
