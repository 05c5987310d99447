"""A factor that sums in single precision, in a problem whose state is of double precision."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from dvo.ba.problem import AdjointConstants, Factor, Linearisation, NormalEquations, State


@dataclass(frozen=True)
class SinglePrecision(Factor):
    """Measurements whose noise is far above the rounding of float32, such as those of patches.

    Next to them a state and factors of double precision lose nothing: the values are rounded for this factor, and its
    sums are added to theirs.

    Attributes:
        factor: whose parameters are float32.
    """

    factor: Factor

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        linear = self.factor.linearise({name: x.float() for name, x in values.items()})
        jacobians = tuple(x.double() for x in linear.jacobians)
        return replace(
            linear, residual=linear.residual.double(), weight=linear.weight.double(), jacobians=jacobians
        )  # fmt: skip

    def cost(self, values: Mapping[str, Tensor]) -> Tensor:
        return self.factor.cost({name: x.float() for name, x in values.items()}).double()

    def tensors(self) -> tuple[Tensor, ...]:
        return self.factor.tensors()

    def indices(self) -> tuple[Tensor, ...]:
        return self.factor.indices()

    def with_tensors(self, tensors: Sequence[Tensor]) -> Factor:
        return SinglePrecision(self.factor.with_tensors(tensors))

    def exact(self) -> Factor:
        return self.factor.exact()

    def normal_equations(self, state: State) -> tuple[NormalEquations, Any]:
        equations, memo = self.factor.normal_equations(_rounded(state))
        doubled: dict[str, Tensor] = {f.name: getattr(equations, f.name).double() for f in fields(equations)}
        return NormalEquations(**doubled), memo

    def phi(self, state: State, constants: AdjointConstants, memo: Any) -> Iterator[Tensor]:
        numbers: dict[str, Any] = {f.name: getattr(constants, f.name) for f in fields(constants)}
        single = replace(constants, **{name: x.float() for name, x in numbers.items() if x is not None})
        return self.factor.phi(_rounded(state), single, memo)


def _rounded(state: State) -> State:
    return state.with_values({name: x.to(torch.float32) for name, x in state.values().items()})
