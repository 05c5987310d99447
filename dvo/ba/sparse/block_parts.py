"""Unknowns of any state block in the block-sparse normal equations, whose blocks have one size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from dvo.ba.blocks import State
from dvo.ba.layer.linearisation import Linearisation

PART = 6
"""Numbers of a part: those of a pose."""


@dataclass(frozen=True)
class BlockParts:
    """Parts of the unknowns of a state, in the order of its blocks.

    An element of ``dim`` numbers has ``ceil(dim / 6)`` parts, the last filled up with numbers that nothing measures.

    Attributes:
        first: first part of each block that is not eliminated.
        count: parts ``n``; this number also stands for an element that does not move.
        filled: ``(n, 6)`` 1 where a number is filled up, else 0.
    """

    first: Mapping[str, int]
    count: int
    filled: Tensor

    @classmethod
    def of(cls, state: State) -> BlockParts:
        """Parts of a state."""
        first: dict[str, int] = {}
        filled, count = [], 0
        for name, block in state.blocks.items():
            if not block.eliminated:
                first[name] = count
                each = -(-block.dim // PART)
                row = pad(block.value.new_zeros(block.dim), (0, each * PART - block.dim), value=1.0)
                filled.append(row.view(each, PART).repeat(block.unknowns, 1))
                count += block.unknowns * each
        return cls(first, count, torch.cat(filled))

    def slots(self, state: State, name: str, index: Tensor) -> list[Tensor]:
        """Parts ``(F,)`` of the elements ``index (F,)`` of a block; ``count`` for fixed ones and the index -1."""
        block = state[name]
        if block.unknowns == 0:
            return []
        each = -(-block.dim // PART)
        slot = index if block.slot is None else block.slot[index]
        moves = (index >= 0) & (slot < block.free)
        return [torch.where(moves, self.first[name] + slot * each + k, self.count) for k in range(each)]

    def of_factor(
        self, linear: Linearisation, state: State
    ) -> tuple[list[tuple[Tensor, Tensor]], list[tuple[Tensor, Tensor]]]:
        """Parts ``(F,)`` that a factor touches with ``J (F, D, 6)``; eliminated elements ``(F,)`` with ``J (F, D)``."""
        parts: list[tuple[Tensor, Tensor]] = []
        landmarks = []
        for name, index, jacobian in zip(linear.blocks, linear.indices, linear.jacobians, strict=True):
            if name == state.landmarks:
                landmarks.append((index, jacobian[0, ..., 0]))
                continue
            slots = self.slots(state, name, index)
            columns = pad(jacobian[0], (0, len(slots) * PART - jacobian.shape[-1])).split(PART, -1) if slots else ()
            parts += zip(slots, columns, strict=True)
        return parts, landmarks

    def moved(self, state: State, step: tuple[Tensor, Tensor]) -> State:
        """The state after a step ``(n, 6)`` of the parts and ``(K,)`` of the eliminated block."""
        reduced, landmarks = step
        values = {}
        for name, block in state.blocks.items():
            if block.eliminated:
                values[name] = block.moved(landmarks[None]).value
                continue
            each, start = -(-block.dim // PART), self.first[name]
            own = reduced[start : start + block.unknowns * each]
            values[name] = block.moved(own.reshape(1, block.unknowns, each * PART)[..., : block.dim]).value
        return state.with_values(values)
