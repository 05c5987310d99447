"""Robust kernels as weights of iteratively reweighted least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from dvo.errors import DvoError

KernelName = Literal["none", "huber", "cauchy"]


@dataclass(frozen=True)
class Kernel:
    """Robust kernel of a factor.

    Attributes:
        name: ``none``; ``huber`` (quadratic, then linear); ``cauchy`` (grows with the logarithm).
        width: whitened residual norm ``sqrt(sum w r^2)`` at which the kernel leaves the quadratic.

    Raises:
        DvoError: unknown name, or a width that is not positive.
    """

    name: KernelName = "none"
    width: float = 1.0

    def __post_init__(self) -> None:
        if self.name not in get_args(KernelName):
            known = ", ".join(get_args(KernelName))
            raise DvoError(f"unknown kernel {self.name!r}", field="kernel", remedy=f"use one of {known}")
        if not self.width > 0:
            raise DvoError(f"is {self.width}, not positive", field="kernel.width", remedy="give a positive width")

    def weights(self, residual: Tensor, weight: Tensor, dim: int) -> Tensor | None:
        """Factor of the weight of each row, without gradient; None for no kernel.

        Args:
            residual: residuals, and ``weight`` their weights, of the same shape.
            dim: dimension of the residual's components; it is kept with size 1.
        """
        if self.name == "none":
            return None
        square = (weight.detach() * residual.detach().square()).sum(dim, keepdim=True) / self.width**2
        if self.name == "huber":
            return torch.where(square > 1, square.clamp(min=1).rsqrt(), 1.0)
        return 1 / (1 + square)
