"""Robust kernels: their cost, and their weights in iteratively reweighted least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from dvo.ba.checks import check_positive
from dvo.core.errors import DvoError
from dvo.core.settings import shown

KernelName = Literal["none", "huber", "cauchy"]


@dataclass(frozen=True)
class Kernel:
    """Robust kernel of a factor.

    Attributes:
        name: ``none``; ``huber`` (quadratic, then linear); ``cauchy`` (grows with the logarithm).
        width: whitened residual norm ``sqrt(sum w r^2)`` at which the kernel leaves the quadratic.

    Raises:
        DvoError: unknown name, or a width that is not a number from 1e-12 to 1e12.
    """

    name: KernelName = "none"
    width: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or self.name not in get_args(KernelName):
            known = ", ".join(get_args(KernelName))
            raise DvoError(f"unknown kernel {shown(self.name)}", field="kernel", remedy=f"use one of {known}")
        check_positive(self.width, "kernel.width")

    def cost(self, s: Tensor) -> Tensor:
        """``rho(s)`` of squared whitened residuals ``s = r^T W r``; a term of a robust cost is ``rho(s) / 2``.

        "none" is ``s``; "huber" is ``s`` up to ``width^2``, then ``2 width sqrt(s) - width^2``; "cauchy" is
        ``width^2 log(1 + s / width^2)``.

        Args:
            s: of any shape, not negative.

        Returns:
            Values of the same shape.
        """
        square = self.width * self.width
        if self.name == "huber":
            return torch.where(s <= square, s, 2 * self.width * s.clamp(min=square).sqrt() - square)
        if self.name == "cauchy":
            return square * torch.log1p(s / square)
        return s

    def slope(self, s: Tensor) -> Tensor:
        """``rho'(s)``, the weight of iteratively reweighted least squares; see :meth:`cost`.

        Args:
            s: of any shape, not negative.

        Returns:
            Values of the same shape.
        """
        if self.name == "huber":
            return self.width / s.clamp(min=self.width**2).sqrt()
        if self.name == "cauchy":
            return 1 / (1 + s / self.width**2)
        return torch.ones_like(s)

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
