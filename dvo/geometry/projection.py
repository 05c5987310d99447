"""Reprojection of patches from frame i into frame j, with analytic Jacobians at the patch centre.

A pixel ``(x, y)`` with inverse depth ``d`` is the homogeneous point ``X = ((x - cx)/fx, (y - cy)/fy, 1, d)`` of frame i.
In frame j it is ``X' = R X_{1..3} + t d`` with ``(R, t) = T_j T_i^-1``, that is, the true point scaled by ``d``, which stays
finite for points at infinity (Teed et al., "Deep Patch Visual Odometry", 2023). Its third coordinate is ``Z``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.geometry import se3, so3

MIN_Z_DIVISION = 0.1
"""The projection divides by ``max(Z, this)``."""
MIN_Z_VALID = 0.2
"""A point counts as seen only where ``Z`` is greater: in front of the camera by a fifth of its depth in frame i."""


@dataclass(frozen=True)
class Reprojection:
    """Patches of frames ``ii`` as seen from frames ``jj``.

    Attributes:
        coords: ``(B, E, p, p, 2)`` pixels x, y in frame j.
        depth: ``(B, E, p, p)`` ``Z``, the depth in frame j over the depth in frame i.
        valid: ``(B, E, p, p)`` bool, ``Z > 0.2``.
        jac_i, jac_j: ``(B, E, 2, 6)`` derivative of the centre pixel by a left perturbation ``[tau, phi]`` of ``T_cw[ii]``
            and ``T_cw[jj]``; zero where the centre is not valid. None unless asked for.
        jac_d: ``(B, E, 2, 1)`` the same by the inverse depth.
    """

    coords: Tensor
    depth: Tensor
    valid: Tensor
    jac_i: Tensor | None = None
    jac_j: Tensor | None = None
    jac_d: Tensor | None = None


def projection_matrices(
    poses_cw: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, target_intrinsics: Tensor | None = None
) -> Tensor:
    """``(B, E, 3, 4)`` matrices M with ``Z (u, v, 1) = M (x, y, d, 1)`` from pixels of frame i to pixels of frame j.

    Args:
        poses_cw: ``(B, N, 7)`` world to camera.
        intrinsics: ``(B, N, 4)`` fx fy cx cy.
        ii, jj: ``(E,)`` source and target frames.
        target_intrinsics: the same for the role of frame j, if they differ (units: normalised coordinates come out).
    """
    b, n = poses_cw.shape[:2]
    rotation, t = so3.matrix(poses_cw[..., 3:]), poses_cw[..., :3, None]
    fx, fy, cx, cy = intrinsics.unbind(-1)
    one, zero = torch.ones_like(fx), torch.zeros_like(fx)
    fu, fv, cu, cv = (intrinsics if target_intrinsics is None else target_intrinsics).unbind(-1)
    k = torch.stack((fu, zero, cu, zero, fv, cv, zero, zero, one), -1).unflatten(-1, (3, 3))
    ix, iy = 1 / fx, 1 / fy
    # columns x, y, d, 1 of the back-projection into (X, Y, Z, d)
    rows = (ix, zero, zero, -cx * ix, zero, iy, zero, -cy * iy, zero, zero, zero, one)
    k_inv = torch.stack(rows, -1).unflatten(-1, (3, 4))
    to_camera = k @ torch.cat((rotation, t), -1)  # (B, N, 3, 4): world (scaled by d) to pixels
    back = rotation.mT
    d_column = torch.stack((zero, zero, one, zero), -1)[..., None, :]
    to_world = torch.cat((back @ k_inv - (back @ t) * d_column, d_column), -2)  # (B, N, 4, 4)
    if n * n > ii.shape[0]:
        return to_camera.index_select(1, jj) @ to_world.index_select(1, ii)
    # All pairs in one product, then one gather: much cheaper than a small product per edge.
    pairs = to_camera.reshape(b, n * 3, 4) @ to_world.permute(0, 2, 1, 3).reshape(b, 4, n * 4)
    pairs = pairs.view(b, n, 3, n, 4).transpose(2, 3).reshape(b, n * n, 12)
    return pairs.index_select(1, jj * n + ii).view(b, -1, 3, 4)


def project(matrices: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Apply :func:`projection_matrices`.

    Args:
        matrices: ``(..., 3, 4)``.
        pixels: ``(..., 3, P)`` rows x, y, d.

    Returns:
        ``(..., 2, P)`` pixels in frame j (division by ``max(Z, 0.1)``), and ``Z (..., 1, P)``.
    """
    lead, count = pixels.shape[:-2], pixels.shape[-1]
    m = matrices.reshape(-1, 3, 4)
    moved = torch.baddbmm(m[..., 3:], m[..., :3], pixels.reshape(-1, 3, count)).view(*lead, 3, count)
    z = moved[..., 2:, :]
    return moved[..., :2, :] / z.clamp(min=MIN_Z_DIVISION), z


def centre_jacobians(
    matrices: Tensor, uv: Tensor, z: Tensor, inverse_depth: Tensor, intrinsics_j: Tensor
) -> tuple[Tensor, Tensor]:
    """Derivatives of projected pixels by the target pose and by the inverse depth.

    Args:
        matrices: ``(..., 3, 4)`` of :func:`projection_matrices`.
        uv: ``(..., 2)`` projected pixels.
        z: ``(...)`` their Z.
        inverse_depth: ``(...)`` of the source.
        intrinsics_j: ``(..., 4)`` of the target frame.

    Returns:
        ``jac_j (..., 2, 6)`` and ``jac_d (..., 2)``, zero where ``Z <= 0.2``.
    """
    seen = z > MIN_Z_VALID
    inv_z = torch.where(seen, 1 / torch.where(seen, z, 1.0), 0.0)
    f, c = intrinsics_j[..., :2], intrinsics_j[..., 2:]
    # Of an unseen point all is made zero, so that no huge coordinate enters a product.
    xy = torch.where(seen[..., None], (uv - c) / f, 0.0)
    x, y = xy.unbind(-1)
    h = inverse_depth * inv_z
    o, s, r = torch.zeros_like(x), seen.to(x.dtype), x * y
    unit = torch.stack((h, o, -h * x, -r, s + x * x, -y, o, h, -h * y, -s - y * y, r, x), -1)
    jac_j = unit.unflatten(-1, (2, 6)) * f[..., None]
    jac_d = (matrices[..., :2, 2] - uv * matrices[..., 2:, 2]) * inv_z[..., None]
    return jac_j, jac_d


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
        patches: ``(B, K, 3, p, p)`` rows x, y (pixels), inverse depth.
        intrinsics: ``(B, N, 4)`` fx fy cx cy in the same pixels.
        ii, jj, kk: ``(E,)`` source frame, target frame, patch; shared by the batch.
        jacobians: also fill ``jac_i``, ``jac_j``, ``jac_d``.
    """
    b, k, _, p, _ = patches.shape
    matrices = projection_matrices(poses_cw, intrinsics, ii, jj)
    source = patches.reshape(b, k, 3 * p * p).index_select(1, kk).view(b, -1, 3, p * p)
    uv, z = project(matrices, source)
    shape = (b, ii.shape[0], p, p)
    coords = uv.transpose(-1, -2).reshape(*shape, 2)
    depth = z.view(shape)
    valid = depth > MIN_Z_VALID
    if not jacobians:
        return Reprojection(coords, depth, valid)
    centre = (p // 2) * p + p // 2
    jac_j, jac_d = centre_jacobians(
        matrices, uv[..., centre], z[..., 0, centre], source[..., 2, centre], intrinsics.index_select(1, jj)
    )
    g_ij = se3.relative(poses_cw.index_select(1, ii), poses_cw.index_select(1, jj))
    jac_i = -jac_j @ se3.adjoint(g_ij)
    return Reprojection(coords, depth, valid, jac_i, jac_j, jac_d[..., None])
