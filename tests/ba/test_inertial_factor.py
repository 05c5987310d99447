"""Inertial factors: Jacobians, agreement with an analytic motion, the layer, the sparse solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dvo.ba.blocks import (
    GRAVITY, IMU_BIAS, POSES, T_CAMERA_IMU, VELOCITY, direction_block, extrinsics_block, inertial_blocks, pose_block,
)  # fmt: skip
from dvo.ba.inertial_factor import BiasWalk, InertialFactor
from dvo.ba.kernels import Kernel
from dvo.ba.problem import State, StateBlock
from dvo.geometry import se3, so3
from tests.ba.test_factors import assert_jacobians, generator_of

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
