"""What a Gauss-Newton step is told besides tensors with gradients."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.edges import EdgePlan
from dvo.ba.normal_equations import Gate


@dataclass(frozen=True)
class BADamping:
    """Damping of one Gauss-Newton step; the same constants serve training and tracking.

    Attributes:
        pose: added to the diagonal of the reduced pose system, in weighted pixels squared per unit squared.
        relative: this fraction of that diagonal is added too.
        depth: added to the curvature of each inverse depth.
    """

    pose: float = 0.1
    relative: float = 1e-4
    depth: float = 1e-4


@dataclass(frozen=True)
class StepSetting:
    """What a step is told besides tensors with gradients; see :func:`dvo.ba.layer.bundle_adjust`."""

    plan: EdgePlan
    gate: Gate
    slot: Tensor
    free: int
    damping: BADamping
    move_poses: bool
    move_depths: bool

    def spread(self, dp: Tensor) -> Tensor:
        """Tangents of the free frames ``(B, 6n)`` to tangents of all ``(B, N, 6)``, zero for the fixed ones."""
        rows = torch.nn.functional.pad(dp.view(len(dp), -1, 6), (0, 0, 0, self.free + 1 - dp.shape[1] // 6))
        return rows.index_select(1, self.slot)
