"""Least-squares problems: state blocks and the factors that measure them.

Each Gauss-Newton step solves ``H delta = g`` with ``H = sum J^T W J`` and ``g = sum J^T W r`` over the rows of all
factors. Unknowns are ordered globals (intrinsics, velocities, biases) | poses | inverse depths. The last block may be
``eliminated``: no factor couples two of its elements, hence its part of ``H`` is diagonal and a Schur complement
removes it. Everything else is the *reduced system*, with :attr:`State.size` unknowns.

A new measurement is a subclass of :class:`Factor` that names the blocks it touches and linearises itself; nothing else
changes.

Shapes: ``B`` batch, ``N`` elements of a block, ``F`` rows of a factor (edges, priors), ``D`` residuals per row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class StateBlock:
    """Variables of one kind, and which of them are unknowns.

    Attributes:
        value: ``(B, N, ...)``.
        dim: size of the tangent of one element.
        retract: ``(value (B, N, ...), tangent (B, N, dim)) -> value``.
        slot: ``(N,)`` unknown of each element; fixed elements have the value ``free``, elements with the same unknown
            move by the same tangent. None: each element is an unknown of its own.
        free: number of unknowns among the elements.
        held: the whole block stays in this call; it has no unknowns, whatever ``slot`` says.
        eliminated: removed by Schur complement; at most one block, the last, with ``dim`` 1 and ``slot`` None.
    """

    value: Tensor
    dim: int
    retract: Callable[[Tensor, Tensor], Tensor]
    slot: Tensor | None
    free: int
    held: bool = False
    eliminated: bool = False

    @property
    def unknowns(self) -> int:
        """Number of unknowns in this call."""
        return 0 if self.held else self.free

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
        if self.slot is not None:
            stays = (self.slot == self.free).view(-1, *(1,) * (value.dim() - 2))
            value = torch.where(stays, self.value, value)
        return replace(self, value=value)


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
        changed = {name: replace(block, value=values[name]) for name, block in self.blocks.items()}
        return State(changed)

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

    def moved(self, reduced: Tensor, landmarks: Tensor) -> State:
        """The state after a step ``(B, size)`` of the reduced system and ``(B, K)`` of the eliminated block."""
        changed = {
            name: block.moved(landmarks[..., None] if block.eliminated else self.part(name, reduced))
            for name, block in self.blocks.items()
        }
        return State(changed)


@dataclass(frozen=True)
class Linearisation:
    """Residuals of a factor and their derivatives at a state.

    To first order a step ``delta`` changes the residual to ``r - J delta``: ``J`` is minus the derivative of the
    residual by the left tangents of the blocks.

    Attributes:
        residual: ``(B, F, D)``.
        weight: ``(B, F, D)``, not negative; zero for a row that does not count. Kernel weights are included, computed
            from detached residuals.
        blocks: name of the state block of each slot. At most one slot is of an eliminated block.
        indices: per slot ``(F,)`` element of the block; -1 if the row does not touch it.
        jacobians: per slot ``(B, F, D, dim)``.
    """

    residual: Tensor
    weight: Tensor
    blocks: tuple[str, ...]
    indices: tuple[Tensor, ...]
    jacobians: tuple[Tensor, ...]

    def cost(self) -> Tensor:
        """``(B,)`` sum of ``weight * residual^2``."""
        return (self.weight * self.residual.square()).sum((1, 2))


@dataclass(frozen=True)
class NormalEquations:
    """``h_pp (B, P, P)``, ``h_pl (B, P, K)``, ``h_ll (B, K)``, ``g_p (B, P)``, ``g_l (B, K)``."""

    h_pp: Tensor
    h_pl: Tensor
    h_ll: Tensor
    g_p: Tensor
    g_l: Tensor

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True)
class AdjointConstants:
    """Constants of the adjoint scalar ``phi`` (see :mod:`dvo.ba.adjoint`), none of which is differentiated.

    Attributes:
        lambda_p, delta_p: ``(B, P)`` reduced parts of lambda and delta. lambda_l, delta_l: ``(B, K)`` their parts of
            the eliminated block.
        s: ``(B, P)``; None without relative damping, as are the other two.
        e: ``(B, P, K)``. c: ``(B, K)``.
    """

    lambda_p: Tensor
    delta_p: Tensor
    lambda_l: Tensor
    delta_l: Tensor
    s: Tensor | None = None
    e: Tensor | None = None
    c: Tensor | None = None


class Factor(ABC):
    """A batch of measurements of the same kind.

    A subclass is a frozen dataclass whose floating-point tensor fields are its parameters (they receive gradients), and
    implements :meth:`linearise`. The other methods are generic; a fast path may override :meth:`normal_equations` and
    :meth:`phi`.

    Example:
        >>> @dataclass(frozen=True)
        ... class SpeedLimit(Factor):
        ...     weight: Tensor  # (B, N, 6)
        ...     def linearise(self, values): ...
    """

    @abstractmethod
    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        """Residuals, weights and Jacobians at the values ``(B, N, ...)`` of the state blocks, differentiably."""

    def tensors(self) -> tuple[Tensor, ...]:
        """Parameters that may need a gradient: the floating-point tensors among the fields."""
        return tuple(getattr(self, name) for name in self._parameters())

    def with_tensors(self, tensors: Sequence[Tensor]) -> Factor:
        """The same factor with other :meth:`tensors`."""
        return replace(self, **dict(zip(self._parameters(), tensors, strict=True)))  # type: ignore[type-var]

    def _parameters(self) -> list[str]:
        values = ((f.name, getattr(self, f.name)) for f in fields(self))  # type: ignore[arg-type]
        return [name for name, value in values if isinstance(value, Tensor) and value.is_floating_point()]

    def normal_equations(self, state: State) -> tuple[NormalEquations, Any]:
        """Contribution to the normal equations, and anything that :meth:`phi` needs of this pass."""
        from dvo.ba.assembly import assemble

        return assemble(self.linearise(state.values()), state), None

    def phi(self, state: State, constants: AdjointConstants, memo: Any) -> Iterator[Tensor]:
        """Terms of the adjoint scalar, ``sum w (J lambda) . (r - J delta)`` and those of relative damping.

        Args:
            state: values are leaves of autograd, as are the parameters of this factor.
            constants: see :class:`AdjointConstants`.
            memo: second result of :meth:`normal_equations` at the same state.

        Yields:
            Scalars whose sum is phi; each is differentiated before the next one is made, which bounds memory.
        """
        from dvo.ba.assembly import adjoint_term

        yield adjoint_term(self.linearise(state.values()), state, constants)


@dataclass(frozen=True)
class Problem:
    """A state and the factors that measure it."""

    state: State
    factors: tuple[Factor, ...]

    def tensors(self) -> list[Tensor]:
        """Everything that a step depends on: values of the blocks, then parameters of the factors."""
        return [*self.state.values().values(), *(x for factor in self.factors for x in factor.tensors())]

    def with_tensors(self, tensors: Sequence[Tensor]) -> Problem:
        """The same problem with other :meth:`tensors`."""
        count = len(self.state.blocks)
        state = self.state.with_values(dict(zip(self.state.blocks, tensors[:count], strict=True)))
        factors, at = [], count
        for factor in self.factors:
            size = len(factor.tensors())
            factors.append(factor.with_tensors(tensors[at : at + size]))
            at += size
        return Problem(state, tuple(factors))

    def cost(self) -> Tensor:
        """``(B,)`` sum of weighted squared residuals of all factors."""
        values = self.state.values()
        costs = [factor.linearise(values).cost() for factor in self.factors]
        return torch.stack(costs).sum(0)
