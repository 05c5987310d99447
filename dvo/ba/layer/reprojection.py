"""Patch reprojection as a factor of the generic kind; the specification of :mod:`dvo.ba.layer.grouped`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES
from dvo.ba.kernels import Kernel
from dvo.ba.limits import LARGEST
from dvo.ba.problem import Factor, Linearisation
from dvo.geometry import se3
from dvo.geometry.bounds import MIN_Z_VALID

MARGIN = 64.0
"""A projection counts while it lies within the feature map enlarged by this many pixels on each side."""


@dataclass(frozen=True)
class PatchReprojection(Factor):
    """Residuals ``target - project(T_j T_i^-1 backproject(patch k))`` in pixels, edge by edge.

    With several cameras, the poses are those of a body, and ``T_i`` is replaced by ``S_a T_i`` with the extrinsics
    ``S_a`` of the sensor that the edge starts from, likewise ``T_j`` by ``S_b T_j``. An edge from a frame into itself
    moves no pose; between two sensors it measures depth.

    Attributes:
        centres: ``(B, K, 2)`` pixels x, y of the patch centres.
        targets: ``(B, E, 2)`` pixels in frame j.
        weights: ``(B, E, 2)`` confidence per axis, pixels^-2. An edge with a weight or a target that is not finite
            does not count.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch.
        camera_i, camera_j: ``(E,)`` rows of the block of intrinsics, and of ``extrinsics``.
        extrinsics: ``(B, S, 7)`` body to sensor; None for a single camera.
        max_residual: pixels; an edge with a longer residual does not count.
        bounds: ``(width, height)`` in pixels; a projection farther outside than ``MARGIN`` does not count.
        kernel: robust kernel of the weighted residual.
        focal_only: the block of intrinsics has one unknown (see :func:`dvo.ba.blocks.intrinsics_block`).
    """

    centres: Tensor
    targets: Tensor
    weights: Tensor
    ii: Tensor
    jj: Tensor
    kk: Tensor
    camera_i: Tensor
    camera_j: Tensor
    extrinsics: Tensor | None = None
    max_residual: float = 128.0
    bounds: tuple[float, float] | None = None
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)
    focal_only: bool = False

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        poses, depth = values[POSES], values[INVERSE_DEPTHS].index_select(1, self.kk)
        pose_i, pose_j = poses.index_select(1, self.ii), poses.index_select(1, self.jj)
        by_body_i = by_body_j = None
        if self.extrinsics is not None:
            sensor_i, sensor_j = (self.extrinsics.index_select(1, x) for x in (self.camera_i, self.camera_j))
            pose_i, pose_j = se3.compose(sensor_i, pose_i), se3.compose(sensor_j, pose_j)
            by_body_i, by_body_j = se3.adjoint(sensor_i), se3.adjoint(sensor_j)
        motion = se3.relative(pose_i, pose_j)
        focal_i, centre_i = values[INTRINSICS].index_select(1, self.camera_i).split(2, -1)
        focal_j, centre_j = values[INTRINSICS].index_select(1, self.camera_j).split(2, -1)
        source = (self.centres.index_select(1, self.kk) - centre_i) / focal_i
        ray = torch.cat((source, torch.ones_like(source[..., :1]), depth[..., None]), -1)
        px, py, pz, h = se3.act_homogeneous(motion, ray).unbind(-1)
        seen = pz > MIN_Z_VALID
        z = torch.where(seen, pz, 1.0)
        xy = torch.stack((px / z, py / z), -1)
        pixel = focal_j * xy + centre_j
        residual = self.targets - pixel
        use = seen & (residual.norm(dim=-1) < self.max_residual)
        if self.bounds is not None:
            limit = pixel.new_tensor(self.bounds) + MARGIN
            use = use & (pixel > -MARGIN).all(-1) & (pixel < limit).all(-1)
        use = use & torch.isfinite(self.weights).all(-1) & (self.targets.abs() <= LARGEST).all(-1)
        # What does not count gets a point ahead: products of a huge Jacobian with zero weights would be NaN.
        px, py, pz, h = (torch.where(use, x, ahead) for x, ahead in ((px, 0.0), (py, 0.0), (pz, 1.0), (h, 0.0)))
        z = torch.where(use, z, 1.0)
        xy = torch.where(use[..., None], xy, 0.0)
        residual = torch.where(use[..., None], residual, 0.0)
        weight = torch.where(use[..., None], self.weights, 0.0)

        fx, fy = (focal_j * use[..., None]).unbind(-1)
        o = torch.zeros_like(z)
        by_point = torch.stack((fx / z, o, -fx * px / z**2, o, fy / z, -fy * py / z**2), -1).unflatten(-1, (2, 3))
        move = torch.stack((h, o, o, o, pz, -py, o, h, o, -pz, o, px, o, o, h, py, -px, o), -1).unflatten(-1, (3, 6))
        jac_j = by_point @ move
        jac_i = -jac_j @ se3.adjoint(motion)
        if by_body_i is not None and by_body_j is not None:
            jac_i, jac_j = jac_i @ by_body_i, jac_j @ by_body_j
        matrix = se3.matrix(motion)
        jac_d = by_point @ matrix[..., :3, 3:]
        # Tangents of the intrinsics are (log fx, log fy, cx / fx, cy / fy): a ray moves by (-x, -y, -1, -1), a
        # projection by focal lengths times (x, y, 1, 1).
        turned = by_point @ matrix[..., :3, :2]
        focal = torch.stack((fx, fy), -1)
        jac_from = torch.cat((-turned * source[..., None, :], -turned), -1)
        jac_to = torch.cat((torch.diag_embed(focal * xy), torch.diag_embed(focal)), -1)
        if self.focal_only:
            jac_from, jac_to = (x[..., :2].sum(-1, keepdim=True) for x in (jac_from, jac_to))

        scale = self.kernel.weights(residual, weight, -1)
        return Linearisation(
            residual,
            weight if scale is None else weight * scale,
            (POSES, POSES, INVERSE_DEPTHS, INTRINSICS, INTRINSICS),
            (self.ii, self.jj, self.kk, self.camera_i, self.camera_j),
            (jac_i, jac_j, jac_d, jac_from, jac_to),
        )

    def cost(self, values: Mapping[str, Tensor]) -> Tensor:
        """``(B,)`` sum of the robust squared residuals; an edge that does not count costs as the longest residual.

        So a step gains nothing by moving points behind a camera.
        """
        plain = replace(self, kernel=Kernel()).linearise(values)
        s = (plain.weight * plain.residual.square()).sum(-1)
        weight = torch.where(torch.isfinite(self.weights), self.weights, 0.0)
        s = torch.where((plain.weight > 0).any(-1), s, weight.amax(-1) * self.max_residual**2)
        return self.kernel.cost(s).sum(1)
