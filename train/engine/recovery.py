"""A way back from weights that went bad."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import nn


def weights_finite(modules: list[nn.Module]) -> torch.Tensor:
    """Boolean scalar: no parameter holds a nan or an infinity."""
    parameters = [p.detach() for module in modules for p in module.parameters()]
    return torch.isfinite(torch.stack(torch._foreach_norm(parameters))).all()


class LastGood:
    """Weights and optimiser state in memory, to return to.

    Every process of a distributed run keeps its own copy; they are equal because the weights are.
    """

    def __init__(self) -> None:
        self._weights: list[dict[str, Any]] | None = None
        self._optimizer: dict[str, Any] | None = None

    def keep(self, modules: list[nn.Module], optimizer: torch.optim.Optimizer) -> None:
        """Remember the present state."""
        self._weights = [copy.deepcopy(module.state_dict()) for module in modules]
        self._optimizer = copy.deepcopy(optimizer.state_dict())

    def restore(self, modules: list[nn.Module], optimizer: torch.optim.Optimizer) -> bool:
        """Return to the remembered state, at the present learning rates; False if there is none."""
        if self._weights is None or self._optimizer is None:
            return False
        for module, weights in zip(modules, self._weights, strict=True):
            module.load_state_dict(weights)
        rates = [group["lr"] for group in optimizer.param_groups]
        optimizer.load_state_dict(copy.deepcopy(self._optimizer))
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        return True
