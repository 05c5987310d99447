"""Jacobians of a factor against autograd."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS
from dvo.ba.problem import Factor, State

F64 = torch.float64


def generator_of(seed: int) -> Callable[..., Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(*shape, dtype=F64, generator=generator)


def numeric_jacobians(factor: Factor, state: State) -> dict[str, Tensor]:
    """Minus the derivative of the residuals ``(B, F, D)`` by the tangents of all elements: ``(F, D, N, dim)`` by block,
    of the first element of the batch."""
    found = {}
    for name, block in state.blocks.items():
        shape = block.value.shape[:2] if block.eliminated else (*block.value.shape[:2], block.dim)

        def residual(tangent: Tensor, name: str = name, block: Any = block) -> Tensor:
            values = {**state.values(), name: block.retract(block.value, tangent)}
            return factor.linearise(values).residual[0]

        jacobian = -torch.autograd.functional.jacobian(residual, torch.zeros(shape, dtype=F64))[:, :, 0]
        found[name] = jacobian[..., None] if block.eliminated else jacobian
    return found


def assert_jacobians(factor: Factor, state: State, tolerance: float = 1e-8) -> None:
    """Slots that refer to the same element add up; elements that no slot refers to have no derivative."""
    linear = factor.linearise(state.values())
    for name, expected in numeric_jacobians(factor, state).items():
        if state[name].held:
            continue
        given_ = torch.zeros_like(expected)
        for slot, index, jacobian in zip(linear.blocks, linear.indices, linear.jacobians, strict=True):
            if slot == name:
                for row, element in enumerate(index.tolist()):
                    given_[row, :, element] += jacobian[0, row]
        if name == INTRINSICS and state[name].slot is not None:  # one common step
            expected, given_ = expected.sum(2), given_.sum(2)
        scale = expected.abs().max().clamp(min=1.0)
        torch.testing.assert_close(given_ / scale, expected / scale, atol=tolerance, rtol=0)
