"""Inertial factors: Jacobians, agreement with an analytic motion, the layer, the sparse solver."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dvo.ba.blocks import (
    GRAVITY,
    IMU_BIAS,
    LOG_SCALE,
    POSES,
    T_CAMERA_IMU,
    TIME_OFFSET,
    VELOCITY,
    direction_block,
    extrinsics_block,
    inertial_blocks,
    pose_block,
)  # fmt: skip
from dvo.ba.factors import VectorPrior
from dvo.ba.inertial_factor import BiasWalk, InertialFactor
from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import make_problem
from dvo.ba.layer.single import SinglePrecision
from dvo.ba.options import BADamping, BAOptions, BAResult
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import State, StateBlock
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.geometry import se3, so3
from tests.support.inertial_motion import InertialWindow, disturbed, inertial_window
from tests.support.jacobians import assert_jacobians, generator_of

F64 = torch.float64
seeds = st.integers(0, 2**32 - 1)


def random_case(seed: int, *, turn: float = 0.5, frames: int = 3) -> tuple[InertialFactor, dict[str, StateBlock]]:
    """A factor of two intervals that fits the states but for some noise, and all of its blocks."""
    randn = generator_of(seed)
    ii, jj = torch.tensor([0, 2]), torch.tensor([2, 1])
    poses = se3.exp(torch.cat((randn(1, frames, 3), turn * randn(1, frames, 3)), -1))
    extrinsics = se3.exp(0.5 * randn(1, 6))
    root = torch.eye(9, dtype=F64) + 0.2 * randn(1, 2, 9, 9).tril()
    factor = InertialFactor(
        duration=0.2 + randn(1, 2).abs(), rotation=so3.exp(turn * randn(1, 2, 3)), velocity=randn(1, 2, 3),
        position=randn(1, 2, 3), by_bias=randn(1, 2, 9, 6), root=root, bias=0.1 * randn(1, 2, 6),
        rates=randn(1, 2, 2, 3), forces=randn(1, 2, 2, 3), offset=0.1 * randn(1, 2), gravity=3 * randn(1, 3),
        extrinsics=extrinsics, ii=ii, jj=jj,
    )  # fmt: skip
    blocks = inertial_blocks(
        randn(1, frames, 3), 0.1 * randn(1, frames, 6), gravity=randn(1, 3), log_scale=0.3 * randn(1),
        time_offset=0.1 * randn(1), T_camera_imu=se3.retract(extrinsics, 0.1 * randn(1, 6)),
    )  # fmt: skip
    return factor, {**blocks, POSES: pose_block(poses, 0)}


@pytest.mark.long
@settings(max_examples=4, deadline=None)
@given(seeds, st.sampled_from([1e-6, 0.1, 0.5]))
def test_jacobians_of_all_blocks(seed: int, turn: float) -> None:
    factor, blocks = random_case(seed, turn=turn)
    assert_jacobians(factor, State(blocks))
    quaternion = blocks[T_CAMERA_IMU].value[..., 3:]
    assert_jacobians(factor, State({**blocks, T_CAMERA_IMU: extrinsics_block(quaternion)}))


@settings(max_examples=2, deadline=None)
@given(seeds)
def test_jacobians_of_some_blocks(seed: int) -> None:
    factor, blocks = random_case(seed)
    some = {name: blocks[name] for name in (VELOCITY, IMU_BIAS, POSES)}
    assert_jacobians(factor, State(some))
    assert_jacobians(replace(factor, kernel=Kernel("none")), State({n: blocks[n] for n in (POSES, VELOCITY)}))
    del blocks[VELOCITY]  # the rotation alone
    assert_jacobians(factor, State(blocks))
    assert factor.linearise({POSES: blocks[POSES].value}).residual.shape == (1, 2, 3)
    other = replace(factor, state_i=torch.tensor([1, 0]), state_j=torch.tensor([0, 2]))
    assert_jacobians(other, State({**some, POSES: blocks[POSES]}))


def test_the_marginal_rotation_is_the_head_of_the_whitened_residual() -> None:
    factor, blocks = random_case(0)
    state = State({name: blocks[name] for name in (VELOCITY, IMU_BIAS, POSES)})
    full = factor.linearise(state.values())
    alone = factor.linearise({name: state[name].value for name in (IMU_BIAS, POSES)})
    torch.testing.assert_close(full.residual[..., :3], alone.residual)


@settings(max_examples=5, deadline=None)
@given(seeds)
def test_jacobians_of_the_bias_walk(seed: int) -> None:
    randn = generator_of(seed)
    walk = BiasWalk(randn(1, 2, 6).exp(), torch.tensor([0, 2]), torch.tensor([2, 1]))
    blocks = inertial_blocks(randn(1, 3, 3), randn(1, 3, 6))
    assert_jacobians(walk, State({IMU_BIAS: blocks[IMU_BIAS]}))
    still = VectorPrior(VELOCITY, torch.zeros(3, dtype=F64), randn(1, 2, 3).exp(), torch.tensor([2, 0]))
    assert_jacobians(still, State({VELOCITY: blocks[VELOCITY]}))


@settings(max_examples=10, deadline=None)
@given(seeds, st.sampled_from([0.0, 1e-9, 0.3, 2.5]))
def test_differences_undo_retractions(seed: int, size: float) -> None:
    randn = generator_of(seed)
    unit = torch.nn.functional.normalize(randn(1, 4, 3), dim=-1)
    blocks = (direction_block(unit), extrinsics_block(se3.exp(randn(1, 1, 6))), pose_block(se3.exp(randn(1, 4, 6)), 0),
              extrinsics_block(so3.exp(randn(1, 1, 3))))  # fmt: skip
    for block in blocks:
        step = size * torch.nn.functional.normalize(randn(1, block.value.shape[1], block.dim), dim=-1)
        there = block.retract(block.value, step)
        assert block.difference is not None
        torch.testing.assert_close(block.difference(block.value, there), step, atol=1e-9, rtol=1e-9)


OPTIONS = BAOptions(fixed=2, iterations=8, damping=BADamping(1e-6, 0.0, 1e-6))
UNIT = 2.0  # metres in one unit of the poses


def started(window: InertialWindow, dtype: torch.dtype = F64) -> tuple[PatchProblem, Tensor]:
    """A problem that starts beside the truth, with all globals, and the true poses in its units."""
    p = window.problem
    true = torch.cat((p.poses_cw[..., :3] / UNIT, p.poses_cw[..., 3:]), -1)
    turn = torch.tensor([[0.02, -0.01, 0.01]], dtype=F64)
    blocks = inertial_blocks(
        window.velocity + 0.1, 0 * window.biases, gravity=window.gravity + torch.tensor([[0.5, -0.3, 0.0]]),
        log_scale=torch.tensor([0.5], dtype=F64), time_offset=torch.tensor([5e-4], dtype=F64),
        T_camera_imu=so3.multiply(so3.exp(turn), window.factor.extrinsics[:, 3:]),
    )  # fmt: skip
    start = p.with_values(poses_cw=disturbed(true, 0.02, fixed=2), inverse_depths=p.inverse_depths * UNIT * 1.05)
    start = replace(start, factors=(window.factor, window.walk), blocks=blocks)
    names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
    return start.with_values(**{name: getattr(start, name).to(dtype) for name in names}), true


def assert_found(window: InertialWindow, found: dict[str, Tensor], exact: bool = True) -> None:
    """The blocks are at the truth."""
    near = 1.0 if exact else 10.0
    turn = so3.log(so3.multiply(found[T_CAMERA_IMU][:, 0], so3.conjugate(window.factor.extrinsics[:, 3:])))
    assert float(turn.abs().max()) < 1e-5 * near
    down = torch.nn.functional.normalize(window.gravity, dim=-1)
    torch.testing.assert_close(found[GRAVITY][:, 0], down, atol=1e-5 * near, rtol=0)
    torch.testing.assert_close(
        found[LOG_SCALE].exp().flatten(), torch.tensor([UNIT]).double(), atol=0, rtol=1e-4 * near
    )
    assert float(found[TIME_OFFSET].abs().max()) < 2e-6 * near
    torch.testing.assert_close(found[VELOCITY], window.velocity, atol=5e-4 * near, rtol=0)
    torch.testing.assert_close(found[IMU_BIAS][..., :3], window.biases[..., :3], atol=1e-5 * near, rtol=0)
    torch.testing.assert_close(found[IMU_BIAS][..., 3:], window.biases[..., 3:], atol=1e-3 * near, rtol=0)


@pytest.mark.long
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_a_window_finds_scale_gravity_biases_time_offset_and_extrinsics(dtype: torch.dtype) -> None:
    window = inertial_window(1, late=0.001)
    problem, true = started(window, dtype)
    made = make_problem(problem, OPTIONS)
    assert isinstance(made.factors[0], SinglePrecision) == (dtype == torch.float32)
    assert made.state[POSES].value.dtype == F64
    with torch.no_grad():
        result = solve(problem, OPTIONS)
    assert isinstance(result, BAResult) and result.poses_cw.dtype == dtype and result.blocks[VELOCITY].dtype == F64
    torch.testing.assert_close(result.poses_cw.double(), true, atol=1e-4, rtol=0)
    assert_found(window, dict(result.blocks), exact=dtype == F64)


@pytest.mark.long
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_the_global_adjustment_finds_them_too(dtype: torch.dtype) -> None:
    window = inertial_window(1, late=0.001)
    problem, true = started(window, dtype)
    names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
    one = problem.with_values(**{name: getattr(problem, name)[0] for name in names})
    options = GlobalBAOptions(fixed=2, solver=LMOptions(max_iterations=40, damping=1e-8, tolerance=1e-10))
    result = solve(one, options)
    assert result.poses_cw.dtype == dtype
    torch.testing.assert_close(result.poses_cw[None].double(), true, atol=1e-4, rtol=0)
    assert_found(window, dict(result.blocks), exact=dtype == F64)


def test_gradients_through_the_layer() -> None:
    window = inertial_window(2, frames=3, per_frame=3)
    problem, _ = started(window)
    names = ("velocity", "position", "bias", "offset", "gravity", "extrinsics", "root", "by_bias", "rotation")
    options = BAOptions(fixed=1, iterations=2, damping=BADamping(1e-2, 1e-6, 1e-3))
    g = torch.Generator().manual_seed(0)
    directions = [torch.randn(getattr(window.factor, name).shape, generator=g, dtype=F64) for name in names]
    start = {name: block.value for name, block in problem.blocks.items()}
    rise = {name: torch.randn(x.shape, generator=g, dtype=F64) for name, x in start.items()}

    def solved(amounts: Tensor) -> Tensor:
        """As a function of a step along a direction for each parameter and for each block at the start."""
        changed = {
            name: getattr(window.factor, name) + amounts[k] * directions[k] for k, name in enumerate(names)
        }  # fmt: skip
        factor = replace(window.factor, **changed)
        factor = replace(factor, rotation=so3.normalise(factor.rotation), root=factor.root.tril() / 1e2)
        walk = replace(window.walk, weight=window.walk.weight * 1e-4 * (1 + amounts[len(names)]))
        blocks = {
            name: block.with_value(block.value + amounts[len(names) + 1 + k] * 0.01 * rise[name])
            for k, (name, block) in enumerate(problem.blocks.items()) if name not in (GRAVITY, T_CAMERA_IMU)
        }  # fmt: skip
        blocks |= {name: problem.blocks[name] for name in (GRAVITY, T_CAMERA_IMU)}
        result = solve(replace(problem, factors=(factor, walk), blocks=blocks), options)
        parts = [result.poses_cw, *(result.blocks[name] for name in (VELOCITY, IMU_BIAS, GRAVITY, LOG_SCALE))]
        whole = torch.cat([x.flatten() for x in parts])
        return (whole * torch.linspace(1, 2, len(whole), dtype=F64).sin()).sum()

    at = torch.zeros(len(names) + 1 + len(problem.blocks), dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(solved, (at,), eps=1e-7, atol=2e-4, rtol=1e-3)
