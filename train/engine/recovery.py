"""Recovery from weights that are not finite."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import nn


def weights_finite(modules: list[nn.Module]) -> torch.Tensor:
    """Boolean scalar, true if no parameter holds a nan or an infinity."""
    parameters = [p.detach() for module in modules for p in module.parameters()]
    return torch.isfinite(torch.stack(torch._foreach_norm(parameters))).all()


class LastGood:
    """Copy of weights and optimiser state in memory.

    Every process of a distributed run keeps its own copy; they are equal because the weights are.
    """

    def __init__(self) -> None:
        self._weights: list[dict[str, Any]] | None = None
        self._optimizer: dict[str, Any] | None = None

    def keep(self, modules: list[nn.Module], optimizer: torch.optim.Optimizer) -> None:
        """Copy the present state, over the copy before."""
        self._weights = [copy.deepcopy(module.state_dict()) for module in modules]
        self._optimizer = copy.deepcopy(optimizer.state_dict())

    def restore(self, modules: list[nn.Module], optimizer: torch.optim.Optimizer) -> bool:
        """Restore the copy, at the present learning rates.

        Returns:
            False if there is no copy.
        """
        if self._weights is None or self._optimizer is None:
            return False
        for module, weights in zip(modules, self._weights, strict=True):
            module.load_state_dict(weights)
        rates = [group["lr"] for group in optimizer.param_groups]
        optimizer.load_state_dict(copy.deepcopy(self._optimizer))
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        return True
