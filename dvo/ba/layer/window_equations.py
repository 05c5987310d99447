"""Normal equations of the patches of a window in one dense array, without gradients.

In a window nearly every patch has an edge into nearly every frame. With a place for each pair of patch and frame, all
sums are over dimensions of one array, and nothing is sorted or gathered: for a few frames of some patches that is twice
as fast as :mod:`dvo.ba.layer.normal_equations`, which takes any graph, and whose formulas these are.

Shapes: ``S`` source frames with ``M`` patches each, ``n`` frames.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dvo.ba.layer.linearisation import NormalEquations
from dvo.ba.layer.normal_equations import Gate, counts, pose_jacobian, view
from dvo.ba.layer.reprojection import MARGIN
from dvo.ba.options import BAOptions
from dvo.geometry import so3


@torch.no_grad()
def window_equations(
    poses_cw: Tensor,
    centres: Tensor,
    inverse_depth: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    jj: Tensor,
    kk: Tensor,
    first: int,
    options: BAOptions,
) -> NormalEquations:
    """Equations of all poses and inverse depths at the present values, with a batch dimension of 1.

    Args:
        poses_cw: ``(n, 7)`` world to camera.
        centres: ``(S, M, 2)`` pixels. inverse_depth: ``(S, M)``.
        intrinsics: ``(n, 4)``.
        targets, weights: ``(E, 2)`` of the edges, at most one for each patch and frame.
        jj, kk: ``(E,)`` target frame and patch of each edge; patch ``k`` belongs to the source frame ``k // M``.
        first: position among the frames of the first source frame; the others follow it.
        options: bounds, kernel and longest residual.

    Returns:
        ``h_pp (1, 6n, 6n)``, ``h_pl (1, 6n, S M)`` and ``h_ll (1, S M)``; the gradients are left at zero.
    """
    n, (s, m) = len(poses_cw), inverse_depth.shape
    places = poses_cw.new_zeros(s * m * n, 4)
    places[kk * n + jj] = torch.cat((targets, weights), 1)
    target, weight = places.view(s, m, n, 4).permute(0, 2, 3, 1).split(2, 2)  # (S, n, 2, M)
    focal, principal = intrinsics[..., None].split(2, 1)
    target, weight = (target - principal) / focal, weight * focal**2
    sources = slice(first, first + s)
    rays = torch.ones(s, 1, 3, m, dtype=poses_cw.dtype)
    rays[:, 0, :2] = (centres.mT - principal[sources]) / focal[sources]
    r, t = so3.matrix(poses_cw[:, 3:]), poses_cw[:, :3, None]
    rotation = r @ r[sources, None].mT
    motion = t - rotation @ t[sources, None]
    v = view(rotation, motion, rays, inverse_depth[:, None, None])

    gate = Gate(options.max_residual, focal[None], kernel=options.kernel)
    if options.bounds is not None:
        middle = poses_cw.new_tensor(options.bounds)[:, None] / 2
        gate = replace(gate, offset=principal[None] - middle, reach=middle + MARGIN)
    residual = target - v.xy
    w = torch.where(counts(v, residual, gate, slice(None)), weight, 0.0)
    scale = gate.kernel.weights(torch.where(w > 0, residual, 0.0), w, -2)
    if scale is not None:
        w = w * scale
    j_d = (motion[..., :2, :] - v.xy * motion[..., 2:, :]) * v.inv_z
    jacobian = torch.cat(pose_jacobian(v), -2).view(s, n, 6, 2 * m)
    weighted = jacobian * w.flatten(-2)[..., None, :]
    block = weighted @ jacobian.mT
    e = (weighted.unflatten(-1, (2, m)) * j_d[:, :, None]).sum(-2)  # (S, n, 6, M)
    # J_i = -J_j Ad(G_ij)
    minus_adjoint = poses_cw.new_zeros(s, n, 6, 6)
    minus_adjoint[..., :3, :3] = minus_adjoint[..., 3:, 3:] = -rotation
    minus_adjoint[..., :3, 3:] = -so3.hat(motion[..., 0]) @ rotation

    every, own = torch.arange(n), torch.arange(s)
    across = block @ minus_adjoint
    h_pp = poses_cw.new_zeros(n, n, 6, 6)
    h_pp[:, sources] = across.transpose(0, 1)
    h_pp[sources] += across.mT
    h_pp[every, every] += block.sum(0)
    h_pp[own + first, own + first] += (minus_adjoint.mT @ across).sum(1)
    h_pl = e.permute(1, 2, 0, 3).contiguous()  # (n, 6, S, M)
    h_pl[own + first, :, own] += (minus_adjoint.mT @ e).sum(1)
    h_ll = (w * j_d.square()).sum((1, 2))
    rows, count = 6 * n, s * m
    return NormalEquations(
        h_pp.transpose(1, 2).reshape(1, rows, rows), h_pl.view(1, rows, count), h_ll.view(1, count),
        poses_cw.new_zeros(1, rows), poses_cw.new_zeros(1, count),
    )  # fmt: skip
