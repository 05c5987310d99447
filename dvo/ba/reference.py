"""The plain twin of :mod:`dvo.ba.layer`: dense normal equations from explicit Jacobians. Slow; the specification.

Nothing here is shared with the fast path but the Lie algebra: the residual is written out edge by edge in pixels,
``J_i`` and ``J_j`` are formed for every edge, and poses and depths are solved together in one dense system.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.ba.normal_equations import MARGIN
from dvo.geometry import se3


def residuals_and_jacobians(
    poses_cw: Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor, targets: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Residuals ``(B, E, 2)``, ``J_i, J_j (B, E, 2, 6)``, ``J_d (B, E, 2)``, ``Z (B, E)``, pixels ``(B, E, 2)``."""
    centre = patches.shape[-1] // 2
    x, y, d = patches[:, kk, :, centre, centre].unbind(-1)
    fx, fy, cx, cy = intrinsics[:, ii].unbind(-1)
    g = se3.relative(poses_cw[:, ii], poses_cw[:, jj])
    point = se3.act_homogeneous(g, torch.stack(((x - cx) / fx, (y - cy) / fy, torch.ones_like(x), d), -1))
    fx, fy, cx, cy = intrinsics[:, jj].unbind(-1)
    px, py, pz, h = point.unbind(-1)
    seen = pz > 0.2
    z = torch.where(seen, pz, 1.0)
    u, v = fx * px / z + cx, fy * py / z + cy
    o = torch.zeros_like(z)
    proj = torch.stack((fx / z, o, -fx * px / z**2, o, fy / z, -fy * py / z**2), -1).unflatten(-1, (2, 3))
    move = torch.stack((h, o, o, o, pz, -py, o, h, o, -pz, o, px, o, o, h, py, -px, o), -1).unflatten(-1, (3, 6))
    proj = proj * seen[..., None, None]
    j_j = proj @ move
    j_i = -j_j @ se3.adjoint(g)
    j_d = (proj @ g[..., :3, None])[..., 0]
    uv = torch.stack((u, v), -1)
    return targets - uv, j_i, j_j, j_d, pz, uv


def bundle_adjust_reference(
    poses_cw: Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    *,
    fixed: int = 1,
    iterations: int = 2,
    damping: tuple[float, float, float] = (0.1, 1e-4, 1e-4),
    structure_only: bool = False,
    motion_only: bool = False,
    bounds: tuple[float, float] | None = None,
    max_residual: float = 128.0,
    depth_range: tuple[float, float] = (1e-3, 10.0),
) -> tuple[Tensor, Tensor]:
    """As :func:`dvo.ba.layer.bundle_adjust`; ``damping`` is (pose, relative, depth)."""
    b, n = poses_cw.shape[:2]
    k = patches.shape[1]
    centre = patches.shape[-1] // 2
    at_i, at_j = (torch.nn.functional.one_hot(index, n).to(poses_cw) for index in (ii, jj))
    at_k = torch.nn.functional.one_hot(kk, k).to(poses_cw)
    for _ in range(iterations):
        r, j_i, j_j, j_d, z, uv = residuals_and_jacobians(poses_cw, patches, intrinsics, ii, jj, kk, targets)
        use = (z > 0.2) & (r.norm(dim=-1) < max_residual)
        if bounds is not None:
            limit = uv.new_tensor(bounds) + MARGIN
            use = use & (uv > -MARGIN).all(-1) & (uv < limit).all(-1)
        w = torch.where(use[..., None], weights, 0.0)
        jac_p = j_i[..., None, :] * at_i[:, None, :, None] + j_j[..., None, :] * at_j[:, None, :, None]
        jac_p, jac_l = jac_p[:, :, :, fixed:].flatten(-2), j_d[..., None] * at_k[:, None]
        jac_p, jac_l = jac_p.flatten(1, 2), jac_l.flatten(1, 2)
        w, r = w.flatten(1), r.flatten(1)
        free = jac_p.shape[-1]
        c = jac_l.mT @ (w[..., None] * jac_l) + damping[2] * torch.eye(k, dtype=w.dtype)
        u = (jac_l * (w * r)[..., None]).sum(1)
        dp = poses_cw.new_zeros(b, free)
        h_pp = jac_p.mT @ (w[..., None] * jac_p)
        e = jac_p.mT @ (w[..., None] * jac_l)
        v = (jac_p * (w * r)[..., None]).sum(1)
        if motion_only and not structure_only and free:
            dp = torch.linalg.solve(h_pp + torch.diag_embed(h_pp.diagonal(dim1=1, dim2=2) * damping[1] + damping[0]), v)
        elif not structure_only and free:
            # Damping is defined on the reduced system, so its diagonal is needed before the joint one can be written.
            s = h_pp - e @ torch.linalg.solve(c, e.mT)
            joint = torch.cat((torch.cat((h_pp, e), -1), torch.cat((e.mT, c), -1)), -2)
            extra = s.diagonal(dim1=1, dim2=2) * damping[1] + damping[0]
            joint = joint + torch.diag_embed(torch.cat((extra, torch.zeros_like(u)), -1))
            both = torch.linalg.solve(joint, torch.cat((v, u), -1))
            dp = both[:, :free]
        if not motion_only:
            dl = torch.linalg.solve(c, u - (e.mT @ dp[..., None])[..., 0])
            inverse_depth = (patches[:, :, 2, centre, centre] + dl).clamp(*depth_range)
            row = inverse_depth[:, :, None, None, None].expand_as(patches[:, :, :1])
            patches = torch.cat((patches[:, :, :2], row), 2)
        moved = se3.retract(poses_cw[:, fixed:], dp.unflatten(-1, (-1, 6))) if free else poses_cw[:, fixed:]
        poses_cw = torch.cat((poses_cw[:, :fixed], moved), 1)
    return poses_cw, patches
