"""Priors and relative poses as factors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor

from dvo.ba.blocks import INVERSE_DEPTHS, POSES
from dvo.ba.kernels import Kernel
from dvo.ba.problem import Factor, Linearisation
from dvo.geometry import se3, sim3


def _everything(value: Tensor, index: Tensor | None) -> Tensor:
    """Elements of a block ``(B, N, ...)`` that a prior concerns."""
    return torch.arange(value.shape[1], device=value.device) if index is None else index


@dataclass(frozen=True)
class DepthPrior(Factor):
    """Prior ``weight (value - d)^2`` of inverse depths, for example measured by a depth camera.

    Attributes:
        value, weight: ``(B, F)`` or broadcastable to it; inverse depth and its inverse variance.
        index: ``(F,)`` patches; None for all of them in order.
        kernel: robust kernel of the whitened residual.
    """

    value: Tensor
    weight: Tensor
    index: Tensor | None = None
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        depth = values[INVERSE_DEPTHS]
        index = _everything(depth, self.index)
        if self.index is not None:
            depth = depth.index_select(1, index)
        weight = self.weight.expand(depth.shape)[..., None]
        residual = (self.value - depth)[..., None]
        scale = self.kernel.weights(residual, weight, -1)
        weight = weight if scale is None else weight * scale
        return Linearisation(residual, weight, (INVERSE_DEPTHS,), (index,), (torch.ones_like(depth)[..., None, None],))


@dataclass(frozen=True)
class DepthDamping(Factor):
    """Damping of each inverse depth: ``weight step^2``, for example predicted by a network (Teed and Deng, 2021).

    Attributes:
        weight: ``(B, K)`` or broadcastable to it.
    """

    weight: Tensor

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        depth = values[INVERSE_DEPTHS]
        weight, one = self.weight.expand(depth.shape)[..., None], torch.ones_like(depth)[..., None, None]
        index = _everything(depth, None)
        return Linearisation(torch.zeros_like(weight), weight, (INVERSE_DEPTHS,), (index,), (one,))


@dataclass(frozen=True)
class PosePrior(Factor):
    """Prior ``weight . Log(prior T^-1)^2`` of poses.

    Attributes:
        poses_cw: ``(B, F, 7)`` or broadcastable to it; world to camera.
        weight: ``(B, F, 6)`` or broadcastable to it, inverse variances of ``[tau, phi]``.
        index: ``(F,)`` frames; None for all of them in order.
    """

    poses_cw: Tensor
    weight: Tensor
    index: Tensor | None = None

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        poses = values[POSES]
        index = _everything(poses, self.index)
        if self.index is not None:
            poses = poses.index_select(1, index)
        residual = se3.log(se3.relative(poses, self.poses_cw.expand_as(poses)))
        jacobian = torch.linalg.inv(se3.left_jacobian(-residual))
        return Linearisation(residual, self.weight.expand(residual.shape), (POSES,), (index,), (jacobian,))


@dataclass(frozen=True)
class VectorPrior(Factor):
    """Prior ``weight . (value - x)^2`` of the vectors of a block, for example of biases, or of a velocity at rest.

    Attributes:
        block: name of a :func:`dvo.ba.blocks.vector_block`.
        value, weight: ``(B, F, D)`` or broadcastable to it; vectors and their inverse variances.
        index: ``(F,)`` elements; None for all of them in order.
        kernel: robust kernel of the whitened residual.
    """

    block: str
    value: Tensor
    weight: Tensor
    index: Tensor | None = None
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        vectors = values[self.block]
        index = _everything(vectors, self.index)
        if self.index is not None:
            vectors = vectors.index_select(1, index)
        residual = self.value - vectors
        weight = self.weight.expand(residual.shape)
        scale = self.kernel.weights(residual, weight, -1)
        weight = weight if scale is None else weight * scale
        jacobian = torch.eye(residual.shape[-1]).to(residual).expand(*residual.shape, -1)
        return Linearisation(residual, weight, (self.block,), (index,), (jacobian,))


@dataclass(frozen=True)
class RelativePose(Factor):
    """Measured relative motions of pairs of poses: ``r = Log(measured (T_j T_i^-1)^-1)``.

    The state block holds SE(3) poses ``(B, N, 7)`` or Sim(3) poses ``(B, N, 8)``; the measurements are of that kind.

    Attributes:
        measured: ``(B, F, 7)`` or ``(B, F, 8)``, or broadcastable to it: ``T_j T_i^-1`` of world-to-camera poses.
        weight: inverse variances ``(B, F, D)`` or broadcastable to it, or positive definite information matrices
            ``(B or 1, F, D, D)``, of the residual, a tangent of ``D = 6`` or 7 numbers in frame j.
        ii, jj: ``(F,)`` the two poses.
        kernel: robust kernel of the whitened residual.
        block: name of the state block.
    """

    measured: Tensor
    weight: Tensor
    ii: Tensor
    jj: Tensor
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)
    block: str = POSES

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        poses = values[self.block]
        group: ModuleType = sim3 if poses.shape[-1] == 8 else se3
        pose_i, pose_j = poses.index_select(1, self.ii), poses.index_select(1, self.jj)
        motion = group.compose(pose_j, group.inverse(pose_i))
        residual = group.log(group.compose(self.measured, group.inverse(motion)))
        jac_j = torch.linalg.inv(group.left_jacobian(-residual))
        jac_i = -jac_j @ group.adjoint(motion)
        weight = self.weight
        if weight.dim() == 4:
            root = torch.linalg.cholesky(weight).mT
            residual = (root @ residual[..., None])[..., 0]
            jac_i, jac_j, weight = root @ jac_i, root @ jac_j, torch.ones_like(residual)
        weight = weight.expand(residual.shape)
        scale = self.kernel.weights(residual, weight, -1)
        weight = weight if scale is None else weight * scale
        return Linearisation(residual, weight, (self.block,) * 2, (self.ii, self.jj), (jac_i, jac_j))
