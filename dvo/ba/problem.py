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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from dvo.ba.blocks import State, StateBlock
from dvo.ba.layer.linearisation import AdjointConstants, Linearisation, NormalEquations, adjoint_term, assemble
from dvo.core.errors import DvoError

__all__ = [
    "AdjointConstants", "Factor", "Linearisation", "NormalEquations", "Problem", "State", "StateBlock", "check_further",
]  # fmt: skip


class Factor(ABC):
    """A batch of measurements of the same kind.

    A subclass is a frozen dataclass whose floating-point tensor fields are its parameters (they receive gradients), and
    implements :meth:`linearise`. The other methods are generic; a fast path may override :meth:`normal_equations` and
    :meth:`phi`.

    Example:
        >>> @dataclass(frozen=True)
        ... class HeightPrior(Factor):  # of the second coordinate of each translation
        ...     height: Tensor  # (B, N)
        ...     def linearise(self, values):
        ...         poses = values["poses"]
        ...         residual = (self.height - poses[..., 1])[..., None]
        ...         jacobian = torch.zeros(*residual.shape, 6)
        ...         jacobian[..., 0, 1], jacobian[..., 0, 3], jacobian[..., 0, 5] = 1, -poses[..., 2], poses[..., 0]
        ...         every = torch.arange(poses.shape[1])
        ...         return Linearisation(residual, torch.ones_like(residual), ("poses",), (every,), (jacobian,))
    """

    @abstractmethod
    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        """Residuals, weights and Jacobians at the values ``(B, N, ...)`` of the state blocks, differentiably."""

    def cost(self, values: Mapping[str, Tensor]) -> Tensor:
        """``(B,)`` what a solution with acceptance of steps lowers: ``sum weight * residual^2``, unless a factor has a
        robust cost of its own, of which the weights are the derivative."""
        return self.linearise(values).cost()

    def tensors(self) -> tuple[Tensor, ...]:
        """Parameters that may need a gradient: the floating-point tensors among the fields."""
        return tuple(getattr(self, name) for name in self._parameters())

    def indices(self) -> tuple[Tensor, ...]:
        """The other tensors that a pass depends on, which must not change before its backward pass."""
        values = (getattr(self, f.name) for f in fields(self))  # type: ignore[arg-type]
        return tuple(x for x in values if isinstance(x, Tensor) and not x.is_floating_point())

    def with_tensors(self, tensors: Sequence[Tensor]) -> Factor:
        """The same factor with other :meth:`tensors`."""
        return replace(self, **dict(zip(self._parameters(), tensors, strict=True)))  # type: ignore[type-var]

    def exact(self) -> Factor:
        """The same factor on the CPU, its parameters detached and in double precision."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        tensors = {name: x.detach().cpu() for name, x in tensors.items() if isinstance(x, Tensor)}
        there: Factor = replace(self, **tensors)  # type: ignore[type-var]
        return there.with_tensors([x.double() for x in there.tensors()])

    def _parameters(self) -> list[str]:
        values = ((f.name, getattr(self, f.name)) for f in fields(self))  # type: ignore[arg-type]
        return [name for name, value in values if isinstance(value, Tensor) and value.is_floating_point()]

    def normal_equations(self, state: State) -> tuple[NormalEquations, Any]:
        """Contribution to the normal equations, and anything that :meth:`phi` needs of this pass."""
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
        yield adjoint_term(self.linearise(state.values()), state, constants)


def check_further(factors: Iterable[object], blocks: object) -> None:
    """Check the types of further measurements and unknowns of a problem.

    Args:
        factors, blocks: of the problem.

    Raises:
        DvoError: one that is no :class:`Factor` or no :class:`StateBlock`, or blocks without names.
    """
    if not isinstance(blocks, Mapping):
        raise DvoError(f"is of type {type(blocks).__name__}", field="blocks", remedy="give state blocks by name")
    for field, values, kind in (("factors", factors, Factor), ("blocks", blocks.values(), StateBlock)):
        for value in values:
            if not isinstance(value, kind):
                message = f"must each be a {kind.__name__}, one is of type {type(value).__name__}"
                raise DvoError(message, field=field, remedy="see dvo.ba.factors and dvo.ba.blocks")


@dataclass(frozen=True)
class Problem:
    """A state and the factors that measure it."""

    state: State
    factors: tuple[Factor, ...]

    def tensors(self) -> list[Tensor]:
        """Everything that a step depends on: values of the blocks, then parameters of the factors."""
        return [*self.state.values().values(), *(x for factor in self.factors for x in factor.tensors())]

    def indices(self) -> list[Tensor]:
        """The other tensors that a step depends on."""
        slots = (block.slot for block in self.state.blocks.values() if block.slot is not None)
        return [*slots, *(x for factor in self.factors for x in factor.indices())]

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
