"""State blocks: the variables of a least-squares problem, and their place among its unknowns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from dvo.ba.limits import LARGEST


@dataclass(frozen=True)
class StateBlock:
    """Variables of one kind, and which of them are unknowns.

    Attributes:
        value: ``(B, N, ...)``.
        dim: size of the tangent of one element.
        retract: ``(value (B, N, ...), tangent (B, N, dim)) -> value``; the tangent of an eliminated block is
            ``(B, N)``.
        slot: ``(N,)`` unknown of each element; fixed elements have the value ``free``, elements with the same unknown
            move by the same tangent. None: each element is an unknown of its own.
        free: number of unknowns among the elements.
        held: the whole block stays in this call; it has no unknowns, whatever the value of ``slot``.
        eliminated: removed by Schur complement; at most one block, the last, with ``dim`` 1 and ``slot`` None.
        longest: a Gauss-Newton step with a larger number is not taken.
        difference: ``(value, other) -> tangent`` with ``retract(value, tangent) = other``; None: a prior of
            :func:`dvo.ba.marginal.marginalise` cannot hold it.
    """

    value: Tensor
    dim: int
    retract: Callable[[Tensor, Tensor], Tensor]
    slot: Tensor | None
    free: int
    held: bool = False
    eliminated: bool = False
    longest: float = LARGEST
    difference: Callable[[Tensor, Tensor], Tensor] | None = None

    @property
    def unknowns(self) -> int:
        """Number of unknowns in this call."""
        return 0 if self.held else self.free

    @cached_property
    def _stays(self) -> Tensor | None:
        """Mask of the fixed elements, to be broadcast over values; None if all are unknowns of their own."""
        if self.slot is None:
            return None
        return (self.slot == self.free).view(-1, *(1,) * (self.value.dim() - 2))

    def with_value(self, value: Tensor) -> StateBlock:
        """The same block with another value. Done in every step, hence without the cost of dataclasses.replace."""
        block = object.__new__(StateBlock)
        block.__dict__.update(self.__dict__, value=value)
        return block

    def spread(self, steps: Tensor) -> Tensor:
        """Tangents of the unknowns ``(B, free, dim)`` to tangents of all elements ``(B, N, dim)``, zero if fixed."""
        if self.slot is None:
            return steps
        return torch.nn.functional.pad(steps, (0, 0, 0, 1)).index_select(1, self.slot)

    def moved(self, steps: Tensor) -> StateBlock:
        """The block after steps of its unknowns ``(B, free, dim)``; fixed elements keep their value bit for bit."""
        if self.unknowns == 0:
            return self
        value = self.retract(self.value, self.spread(steps))
        if self._stays is not None:
            value = torch.where(self._stays, self.value, value)
        return self.with_value(value)


@dataclass(frozen=True)
class State:
    """State blocks by name, in the order of the unknowns: globals, poses, and last the eliminated block if any.

    Attributes:
        blocks: by name; a dict keeps its order.
        offsets: first row of each block in the reduced system.
        size: unknowns of the reduced system.
        landmarks: name of the eliminated block, or None.
    """

    blocks: Mapping[str, StateBlock]
    offsets: Mapping[str, int] = field(init=False)
    size: int = field(init=False)
    landmarks: str | None = field(init=False)

    def __post_init__(self) -> None:
        offsets: dict[str, int] = {}
        row, landmarks = 0, None
        for name, block in self.blocks.items():
            if block.eliminated:
                landmarks = name
                continue
            offsets[name] = row
            row += block.unknowns * block.dim
        for name, value in (("offsets", offsets), ("size", row), ("landmarks", landmarks)):
            object.__setattr__(self, name, value)

    def __getitem__(self, name: str) -> StateBlock:
        return self.blocks[name]

    def values(self) -> dict[str, Tensor]:
        """Value of each block."""
        return {name: block.value for name, block in self.blocks.items()}

    def with_values(self, values: Mapping[str, Tensor]) -> State:
        """The same blocks with other values."""
        return self._with({name: block.with_value(values[name]) for name, block in self.blocks.items()})

    def _with(self, blocks: Mapping[str, StateBlock]) -> State:
        state = object.__new__(State)
        state.__dict__.update(self.__dict__, blocks=blocks)
        return state

    def rows(self, name: str, index: Tensor) -> Tensor:
        """Rows ``(F, dim)`` of the reduced system for the elements ``index (F,)`` of a block that is not eliminated.

        ``size`` (one past the last row) where there is no unknown: a fixed element, or index -1.
        """
        block = self.blocks[name]
        if block.unknowns == 0:
            return torch.full((len(index), block.dim), self.size, dtype=torch.long, device=index.device)
        slot = index if block.slot is None else block.slot[index]
        row = self.offsets[name] + slot[:, None] * block.dim + torch.arange(block.dim, device=index.device)
        return torch.where(((index < 0) | (slot >= block.free))[:, None], self.size, row)

    def part(self, name: str, reduced: Tensor) -> Tensor:
        """The unknowns ``(B, unknowns, dim)`` of one block in a vector ``(B, size)`` of the reduced system."""
        block, start = self.blocks[name], self.offsets[name]
        return reduced[:, start : start + block.unknowns * block.dim].view(len(reduced), block.unknowns, block.dim)

    @property
    def longest(self) -> float:
        """The least :attr:`StateBlock.longest`."""
        return min(block.longest for block in self.blocks.values())

    def is_short(self, reduced: Tensor) -> Tensor:
        """``(B, 1)`` bool, elements of the batch with a step ``(B, size)`` within :attr:`StateBlock.longest`."""
        size = reduced.abs()
        short = torch.ones(len(size), 1, dtype=torch.bool, device=size.device)
        for name in self.offsets:
            short = short & (self.part(name, size) <= self.blocks[name].longest).flatten(1).all(1, keepdim=True)
        return short

    def moved(self, reduced: Tensor, landmarks: Tensor) -> State:
        """The state after a step ``(B, size)`` of the reduced system and ``(B, K)`` of the eliminated block."""
        changed = {
            name: block.moved(landmarks if block.eliminated else self.part(name, reduced))
            for name, block in self.blocks.items()
        }
        return self._with(changed)
