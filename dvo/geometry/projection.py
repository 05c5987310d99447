"""Reprojection of patches from frame i into frame j, with analytic Jacobians at the patch centre.

A pixel ``(x, y)`` with inverse depth ``d`` is the homogeneous point ``X = ((x - cx)/fx, (y - cy)/fy, 1, d)`` of frame
i. In frame j it is ``X' = R X_{1..3} + t d`` with ``(R, t) = T_j T_i^-1``, that is, the true point scaled by ``d``,
which stays finite for points at infinity (Teed et al., "Deep Patch Visual Odometry", 2023). Its third coordinate is
``Z``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.core.context import full_precision
from dvo.core.errors import DvoError
from dvo.core.kernels import is_batched, use_kernels
from dvo.geometry import se3, so3
from dvo.geometry.bounds import MIN_Z_DIVISION, MIN_Z_VALID


@dataclass(frozen=True)
class Reprojection:
    """Projections of patches of frames ``ii`` into frames ``jj``.

    Attributes:
        coords: ``(B, E, p, p, 2)`` pixels x, y in frame j.
        depth: ``(B, E, p, p)`` ``Z``, the depth in frame j over the depth in frame i.
        valid: ``(B, E, p, p)`` bool, ``Z > 0.2``.
        jac_i, jac_j: ``(B, E, 2, 6)`` derivative of the centre pixel by a left perturbation ``[tau, phi]`` of
            ``T_cw[ii]`` and ``T_cw[jj]``, pixels; zero where the centre is not valid. None unless requested.
        jac_d: ``(B, E, 2, 1)`` derivative of the centre pixel by the inverse depth. None unless requested.
    """

    coords: Tensor
    depth: Tensor
    valid: Tensor
    jac_i: Tensor | None = None
    jac_j: Tensor | None = None
    jac_d: Tensor | None = None


def motion_matrices(poses_cw: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor) -> Tensor:
    """Matrices M with ``X' = M (x, y, d, 1)``: from pixels and inverse depth of frame i to points in frame j.

    Args:
        poses_cw: ``(B, N, 7)`` world to camera.
        intrinsics: ``(B, N, 4)`` fx fy cx cy in pixels.
        ii, jj: ``(E,)`` source and target frames.

    Returns:
        ``(B, E, 3, 4)``.
    """
    b, n = poses_cw.shape[:2]
    rotation, t = so3.matrix(poses_cw[..., 3:]), poses_cw[..., :3, None]
    fx, fy, cx, cy = intrinsics.unbind(-1)
    one, zero = torch.ones_like(fx), torch.zeros_like(fx)
    ix, iy = 1 / fx, 1 / fy
    # Back-projection of (x, y, d, 1) to the ray (X, Y, 1), then to the world, where the last row keeps d.
    rows = (ix, zero, zero, -cx * ix, zero, iy, zero, -cy * iy, zero, zero, zero, one)
    k_inv = torch.stack(rows, -1).unflatten(-1, (3, 4))
    d_row = torch.stack((zero, zero, one, zero), -1)[..., None, :]
    back = rotation.mT
    to_world = torch.cat((back @ k_inv - (back @ t) * d_row, d_row), -2)  # (B, N, 4, 4)
    to_camera = torch.cat((rotation, t), -1)
    if n * n > ii.shape[0]:
        return to_camera.index_select(1, jj) @ to_world.index_select(1, ii)
    # All pairs in one product, then one gather: much cheaper than a small product per edge.
    pairs = to_camera.reshape(b, n * 3, 4) @ to_world.permute(0, 2, 1, 3).reshape(b, 4, n * 4)
    pairs = pairs.view(b, n, 3, n, 4).transpose(2, 3).reshape(b, n * n, 12)
    return gather(pairs, jj * n + ii).view(b, -1, 3, 4)


def gather(table: Tensor, index: Tensor) -> Tensor:
    """Rows of a table, gathered over dimension 0 of the flattened batch: the backward pass is far faster.

    Args:
        table: ``(B, N, C)``.
        index: ``(E,)`` along dimension 1, shared by the batch.

    Returns:
        ``(B, E, C)``.
    """
    b, n, c = table.shape
    if b > 1:
        index = (index + torch.arange(b, device=index.device)[:, None] * n).flatten()
    return table.reshape(b * n, c).index_select(0, index).view(b, -1, c)


def centre_jacobians(point: Tensor, inverse_depth: Tensor, translation: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of projected pixels by the target pose and by the inverse depth.

    Args:
        point: ``(..., 3)`` X' in frame j, the true point times its inverse depth in frame i.
        inverse_depth: ``(...)`` in frame i.
        translation: ``(..., 3)`` of the motion from frame i to frame j.
        focal: ``(..., 2)`` fx fy of frame j in pixels.

    Returns:
        ``jac_j (..., 2, 6)`` and ``jac_d (..., 2, 1)``, zero where ``Z <= 0.2``.
    """
    z = point[..., 2:]
    seen = z > MIN_Z_VALID
    inv_z = seen / torch.where(seen, z, 1.0)
    xy = point[..., :2] * inv_z
    x, y = xy.unbind(-1)
    h = inverse_depth * inv_z[..., 0]
    o, s, r = torch.zeros_like(x), seen[..., 0].to(x), x * y
    unit = torch.stack((h, o, -h * x, -r, s + x * x, -y, o, h, -h * y, -s - y * y, r, x), -1).unflatten(-1, (2, 6))
    jac_d = (translation[..., :2] - xy * translation[..., 2:]) * inv_z
    return unit * focal[..., None], (jac_d * focal)[..., None]


def reproject(
    poses_cw: Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    jacobians: bool = False,
) -> Reprojection:
    """Project patches into other frames.

    Args:
        poses_cw: ``(B, N, 7)`` world to camera.
        patches: ``(B, K, 3, p, p)`` rows x, y (pixels), inverse depth; of any height and width, up to whole frames.
        intrinsics: ``(B, N, 4)`` fx fy cx cy in the same pixels.
        ii, jj, kk: ``(E,)`` source frame, target frame, patch; shared by the batch.
        jacobians: also fill ``jac_i``, ``jac_j``, ``jac_d``.

    Returns:
        Pixels of all ``p x p`` points of each edge, their depths and validity; differentiable by poses, patches and
        intrinsics. Where ``Z`` is below 0.1 the division is by 0.1, so that values stay finite; such points are not
        valid. Indices are not checked.

    Raises:
        RuntimeError: shapes that do not belong together (from torch).

    Example:
        >>> seen = reproject(poses_cw, patches, intrinsics, ii, jj, kk)
        >>> flow = seen.coords - patches[:, kk, :2].permute(0, 1, 3, 4, 2)
        >>> flow[~seen.valid] = 0
    """
    if not jacobians and use_kernels(poses_cw, patches, intrinsics, adjoint=True):
        found = by_kernel(poses_cw, patches, intrinsics, ii, jj, kk)
        if found is not None:
            return found
    return _by_twin(poses_cw, patches, intrinsics, ii, jj, kk, jacobians)


def _by_twin(
    poses_cw: Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor, jacobians: bool = False
) -> Reprojection:
    with full_precision(poses_cw.device):
        b, k, _, p, q = patches.shape
        matrices = motion_matrices(poses_cw, intrinsics, ii, jj)
        source = gather(patches.reshape(b, k, 3 * p * q), kk).view(b, -1, 3, p * q)
        focal, principal = gather(intrinsics, jj)[..., None].split(2, 2)
        m = matrices.view(-1, 3, 4)
        point = torch.baddbmm(m[..., 3:], m[..., :3], source.view(-1, 3, p * q)).view(source.shape)
        z = point[..., 2:, :]
        uv = torch.addcmul(principal, focal, point[..., :2, :] / z.clamp(min=MIN_Z_DIVISION))
        shape = (b, ii.shape[0], p, q)
        coords = uv.mT.reshape(*shape, 2)
        depth = z.view(shape)
        valid = depth > MIN_Z_VALID
        if not jacobians:
            return Reprojection(coords, depth, valid)
        centre = (p // 2) * q + q // 2
        jac_j, jac_d = centre_jacobians(point[..., centre], source[..., 2, centre], matrices[..., 2], focal[..., 0])
        g_ij = se3.relative(poses_cw.index_select(1, ii), poses_cw.index_select(1, jj))
        jac_i = -jac_j @ se3.adjoint(g_ij)
        return Reprojection(coords, depth, valid, jac_i, jac_j, jac_d)


def by_kernel(
    poses_cw: Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor
) -> Reprojection | None:
    """:func:`reproject` without Jacobians by a compiled loop; first derivatives by another one.

    Args:
        poses_cw, patches, intrinsics, ii, jj, kk: see :func:`reproject`; what is not an index is float32, on the CPU.

    Returns:
        The projections; None for shapes or indices that do not belong together.
    """
    if (poses_cw.dim(), patches.dim(), ii.dim()) != (3, 5, 1):
        return None
    (b, n, _), (_, k, _, p, q), edges = poses_cw.shape, patches.shape, len(ii)
    shapes = (poses_cw.shape, (b, n, 7)), (patches.shape, (b, k, 3, p, q)), (intrinsics.shape, (b, n, 4))
    indices = [x for x in (ii, jj, kk) if x.dtype == torch.int64 and x.device == poses_cw.device]
    if any(found != wanted for found, wanted in shapes) or [tuple(x.shape) for x in indices] != [(edges,)] * 3:
        return None
    tensors = poses_cw, patches, intrinsics, ii, jj, kk
    if not (torch.is_grad_enabled() and any(x.requires_grad for x in tensors)):
        found = _projected(tensors)
        return None if found is None else Reprojection(*found)
    limits = (ii, n), (jj, n), (kk, k)
    if edges and any(int(x.min()) < 0 or int(x.max()) >= count for x, count in limits):
        return None
    coords, depth, valid = _Projected.apply(*tensors)
    return Reprojection(coords, depth, valid)


def _projected(tensors: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor] | None:
    """``coords``, ``depth`` and ``valid`` of :func:`reproject`; None for an index out of range."""
    from dvo.geometry.projection_kernels import project_patches

    (b, _, _, p, q), edges = tensors[1].shape, len(tensors[3])
    coords, depth = tensors[0].new_empty(b, edges, p, q, 2), tensors[0].new_empty(b, edges, p, q)
    valid = torch.empty(b, edges, p, q, dtype=torch.bool)
    out = coords.flatten(2, 3), depth.flatten(2), valid.flatten(2)
    arguments: tuple[Any, ...] = (*_arrays(tensors), MIN_Z_DIVISION, MIN_Z_VALID, *(x.numpy() for x in out))
    return (coords, depth, valid) if project_patches(*arguments) else None


class _Projected(torch.autograd.Function):
    """:func:`_projected` of indices in range, with a compiled adjoint."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(*tensors)
        found = _projected(tensors)
        assert found is not None
        ctx.mark_non_differentiable(found[2])
        return found

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        tensors, again = ctx.saved_tensors, torch.is_grad_enabled()
        needed = [i for i in range(3) if ctx.needs_input_grad[i]]
        out: list[Tensor | None] = [None] * 6
        found: Sequence[Tensor]
        if again or is_batched(grads[0]) or is_batched(grads[1]):
            with torch.enable_grad():
                leaves = [x.view_as(x) if again else x.detach().requires_grad_() for x in tensors[:3]]
                twin = _by_twin(*leaves, *tensors[3:])
                wanted = [leaves[i] for i in needed]
                found = torch.autograd.grad((twin.coords, twin.depth), wanted, grads[:2], create_graph=again)
        else:
            from dvo.geometry.projection_kernels import project_patches_adjoint

            sums = [np.zeros(x.shape) for x in (tensors[0], tensors[1].flatten(3), tensors[2])]
            given = grads[0].flatten(2, 3).contiguous().numpy(), grads[1].flatten(2).contiguous().numpy()
            arguments: tuple[Any, ...] = (*_arrays(tensors), MIN_Z_DIVISION, *given, *sums)
            project_patches_adjoint(*arguments)
            found = [torch.from_numpy(sums[i]).float().view(tensors[i].shape) for i in needed]
        for i, gradient in zip(needed, found, strict=True):
            out[i] = gradient
        return tuple(out)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> None:
        raise DvoError("dual numbers are not followed", field="reproject", remedy="use torch.func.jvp")


def _arrays(tensors: Sequence[Tensor]) -> list[np.ndarray[Any, Any]]:
    poses_cw, patches, *others = tensors
    return [x.detach().contiguous().numpy() for x in (poses_cw, patches.flatten(3), *others)]
