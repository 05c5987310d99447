"""Balance of losses by their gradients (V2V): flow against pose, and rotation against translation.

Every so often the norms of the gradients of two terms are measured on one parameter, and the weight of the second term
is moved towards their ratio:

    beta <- mean over the last K of clamp(||g_pose|| / ||g_flow||, beta / 10, 10 beta)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

FLOOR = 1e-6
"""Lowest gradient norm: smaller ones count as this."""

PARAMETER = "update.gru.1.res.0.weight"
"""Parameter on which V2V measures: the first linear layer of the first gated residual of the update operator."""


@dataclass
class Coefficient:
    """Weight that follows the ratio of two gradient norms, slowly.

    Attributes:
        value: present weight.
        window: measurements in the mean.
        reach: one measurement counts as at most ``reach`` times, at least ``1 / reach`` of the present value.
        recent: the last measurements, clamped.

    Example:
        >>> beta = Coefficient()
        >>> norms = [float(gradient(loss, parameter).norm()) for loss in (pose_loss, flow_loss)]
        >>> total = pose_loss + beta.follow(*norms) * flow_loss
    """

    value: float = 1.0
    window: int = 50
    reach: float = 10.0
    recent: tuple[float, ...] = ()

    def follow(self, leading: float, balanced: float) -> float:
        """Take a measurement and return the new value.

        Args:
            leading: gradient norm of the term whose weight stays.
            balanced: gradient norm, unweighted, of the term whose weight this is.

        Returns:
            the mean of the last clamped ratios ``leading / balanced``.
        """
        ratio = max(leading, FLOOR) / max(balanced, FLOOR)
        clamped = min(max(ratio, self.value / self.reach), self.value * self.reach)
        self.recent = (*self.recent, clamped)[-self.window :]
        self.value = sum(self.recent) / len(self.recent)
        return self.value

    def state_dict(self) -> dict[str, Any]:
        """Plain values, for checkpoints."""
        return {"value": self.value, "recent": list(self.recent)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`; measurements beyond the window are dropped."""
        self.value, self.recent = float(state["value"]), tuple(state["recent"])[-self.window :]


def gradient(loss: Tensor, parameter: Tensor) -> Tensor:
    """Gradient of a loss with respect to one parameter.

    The graph is kept and nothing is accumulated. Under distributed training it is the mean over all processes, so that
    its norm is that of the gradient which the optimiser would see.

    Args:
        loss: scalar.
        parameter: any shape.

    Returns:
        tensor of the shape of the parameter, detached; zero if the loss does not depend on it.
    """
    found = None
    if loss.requires_grad:
        (found,) = torch.autograd.grad(loss, parameter, retain_graph=True, allow_unused=True)
    result = torch.zeros_like(parameter) if found is None else found.detach()
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        result = result.contiguous()
        torch.distributed.all_reduce(result)
        result = result / torch.distributed.get_world_size()
    return result
