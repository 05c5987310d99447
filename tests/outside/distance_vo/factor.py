"""Known distance between two camera centres as a factor of bundle adjustment: it fixes the scale."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.blocks import POSES
from dvo.ba.problem import Factor, Linearisation
from dvo.geometry import se3, so3


@dataclass(frozen=True)
class KnownDistance(Factor):
    """Residual ``distance - |c_i - c_j|`` of the camera centres of frames i and j.

    Attributes:
        distance, weight: ``(B, F)`` metres, and inverse variances.
        i, j: ``(F,)`` frames.
    """

    distance: Tensor
    weight: Tensor
    i: Tensor
    j: Tensor

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        first, second = (values[POSES].index_select(1, index) for index in (self.i, self.j))
        between = se3.inverse(first)[..., :3] - se3.inverse(second)[..., :3]
        length = between.norm(dim=-1, keepdim=True)
        direction = (between / length)[..., None, :]  # (B, F, 1, 3)
        # A left perturbation tau moves the centre by -R^T tau.
        zero = torch.zeros_like(direction)
        jacobian_i = torch.cat([-direction @ so3.matrix(first[..., 3:]).mT, zero], -1)
        jacobian_j = torch.cat([direction @ so3.matrix(second[..., 3:]).mT, zero], -1)
        return Linearisation(
            self.distance[..., None] - length, self.weight[..., None], (POSES, POSES), (self.i, self.j),
            (jacobian_i, jacobian_j),
        )  # fmt: skip
