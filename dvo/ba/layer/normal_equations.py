"""Normal equations of patch reprojection by frame pairs: residuals, analytic Jacobians, their sums by frame and patch.

Everything is in normalised camera coordinates of the target frame; the focal lengths enter with the weights. The
Jacobian by the source pose is ``J_i = -J_j Ad(G_ij)``, and the adjoint depends on the frame pair only, so that the
blocks of the source frame are made from the sums over a pair rather than from a second Jacobian of each edge.

Shapes: ``B`` batch, ``G`` groups of ``M`` places (see :mod:`dvo.ba.edges`), ``P`` pairs, ``K`` patches, ``n`` free
frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.edges import EdgePlan
from dvo.ba.kernels import Kernel
from dvo.ba.layer.linearisation import NormalEquations
from dvo.geometry import so3
from dvo.geometry.bounds import MIN_Z_VALID

Counted = tuple[Tensor, Tensor | None]
"""Of a slice of groups: places that count, ``(B, G, 1, M)`` bool, and their kernel weights of the same shape."""


@dataclass(frozen=True)
class Gate:
    """Conditions on which edges count.

    Attributes:
        max_residual: pixels; a longer residual is an outlier.
        focal: ``(B, G, 2, 1)`` of the target frames, to go from normalised coordinates to pixels.
        offset: ``(B, G, 2, 1)`` their principal points relative to the middle of the feature map.
        reach: ``(2, 1)`` farthest distance from that middle along each axis, or None for no bounds.
        kernel: robust kernel of the weighted residual.
    """

    max_residual: float
    focal: Tensor
    offset: Tensor | None = None
    reach: Tensor | None = None
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)


@dataclass(frozen=True)
class View:
    """Points of a slice of groups in the target frame: all ``(B, G, 1, M)`` but ``xy (B, G, 2, M)``."""

    xy: Tensor
    h: Tensor
    inv_z: Tensor
    seen: Tensor


def relative_motion(poses_cw: Tensor, plan: EdgePlan) -> tuple[Tensor, Tensor]:
    """Rotation ``(B, P, 3, 3)`` and translation ``(B, P, 3, 1)`` of ``T_j T_i^-1`` for each pair."""
    r, t = so3.matrix(poses_cw[..., 3:]), poses_cw[..., :3, None]
    rotation = r.index_select(1, plan.pair_j) @ r.index_select(1, plan.pair_i).mT
    return rotation, t.index_select(1, plan.pair_j) - rotation @ t.index_select(1, plan.pair_i)


def view(rotation: Tensor, t: Tensor, rays: Tensor, inverse_depth: Tensor, seen: Tensor | None = None) -> View:
    """Move ``rays (B, G, 3, M)`` = (x, y, 1) with ``inverse_depth (B, G, 1, M)`` by each group's motion; project.

    ``seen``: those in front of the camera that are projected, None for all; the rest are zero.
    """
    moved = rotation @ rays + t * inverse_depth
    z = moved[..., 2:, :]
    seen = z > MIN_Z_VALID if seen is None else seen
    inv_z = seen / torch.where(seen, z, 1.0)
    return View(moved[..., :2, :] * inv_z, inverse_depth * inv_z, inv_z, seen)


def counts(v: View, residual: Tensor, gate: Gate, part: slice) -> Tensor:
    """Places that count, ``(B, G, 1, M)`` bool. A NaN does not."""
    focal = gate.focal[:, part]
    use = v.seen & ((residual * focal).square().sum(-2, keepdim=True) < gate.max_residual**2)
    if gate.offset is not None and gate.reach is not None:
        use &= (torch.addcmul(gate.offset[:, part], v.xy, focal).abs() < gate.reach).all(-2, keepdim=True)
    return use


def pose_jacobian(v: View) -> tuple[Tensor, ...]:
    """Rows of ``J_j``: for each of the six tangent components the x and the y axis; 12 rows ``(B, G, ., M)`` in all."""
    x, y = v.xy.split(1, -2)
    o, xy, square = torch.zeros_like(x), x * y, v.xy * v.xy + 1
    return v.h, o, o, v.h, -v.h * v.xy, -xy, -square[..., 1:, :], square[..., :1, :], xy, -y, x


@dataclass(frozen=True)
class SumIndex:
    """Destinations of the sums of :func:`accumulate`, the same in every iteration.

    Attributes:
        slot, free: of the frames, see :func:`dvo.ba.blocks.free_slots`.
        pairs: by chunk ``(B G,)``, cell of each group among batch and pairs.
        ends: by chunk ``(2 B G M,)``, cells of both frames of each place among batch, slots and patches.
        blocks: ``(4 B P,)`` cells of the 6x6 blocks of the pairs among batch, slots and slots.
        gradients: ``(2 P,)`` slots of the gradients of the pairs.
    """

    slot: Tensor
    free: int
    pairs: tuple[Tensor, ...]
    ends: tuple[Tensor, ...]
    blocks: Tensor
    gradients: Tensor


def sum_index(plan: EdgePlan, slot: Tensor, free: int, batch: int) -> SumIndex:
    """Destinations for a batch of the given size."""
    n, k = free, plan.patches

    def over_batch(cells: Tensor, count: int) -> Tensor:
        """Cells ``(X,)`` of one element among ``count`` to those of the whole batch ``(B X,)``."""
        if batch == 1:
            return cells
        return (torch.arange(batch, device=slot.device)[:, None] * count + cells).flatten()

    slot_i, slot_j = slot[plan.pair_i], slot[plan.pair_j]
    by_pair, by_both = [], []
    for part in plan.chunks():
        group = plan.group_pair[part]
        kk = plan.kk[part.start * plan.size : part.stop * plan.size]
        ends = torch.stack((slot_j[group], slot_i[group]), -1)[:, None] * k
        by_pair.append(over_batch(group, len(plan.pair_i)))
        by_both.append(over_batch((ends + kk.view(-1, plan.size, 1)).flatten(), (n + 1) * k))
    row, column = torch.cat((slot_j, slot_j, slot_i, slot_i)), torch.cat((slot_j, slot_i, slot_j, slot_i))
    blocks = over_batch(row * (n + 1) + column, (n + 1) ** 2)
    return SumIndex(slot, free, tuple(by_pair), tuple(by_both), blocks, torch.cat((slot_j, slot_i)))


def accumulate(
    poses_cw: Tensor,
    inverse_depth: Tensor,
    rays: Tensor,
    target: Tensor,
    weight: Tensor,
    plan: EdgePlan,
    gate: Gate,
    index: SumIndex,
    pose_part: bool,
    depth_part: bool,
) -> tuple[NormalEquations, list[Counted]]:
    """Linearise at the present poses ``(B, N, 7)`` and inverse depths ``(B, K)``, and sum over the edges.

    Args:
        rays: ``(B, G, 3, M)``. target, weight: ``(B, G, 2, M)``, normalised.
        index: destinations of the sums.
        pose_part, depth_part: poses, depths are unknowns. What is not needed stays zero or empty.

    Returns:
        The equations of the ``6 n`` pose unknowns and ``K`` inverse depths, and for each chunk of the plan the places
        that count.
    """
    b, k, n, pairs = len(poses_cw), plan.patches, index.free, len(plan.pair_i)
    zeros = poses_cw.new_zeros
    rotation, t = relative_motion(poses_cw, plan)
    tr = so3.hat(t[..., 0]) @ rotation
    # [I | -Ad] padded to 8 rows and columns: from (e_j, u, C) of an edge to those, and (e_i, 0, 0)
    both_ends = zeros(b, pairs, 8, 2, 8)
    both_ends[..., 0, :].diagonal(dim1=-2, dim2=-1).fill_(1)
    both_ends[..., :3, 1, :3] = both_ends[..., 3:6, 1, 3:6] = -rotation
    both_ends[..., :3, 1, 3:6] = -tr
    minus_adjoint = both_ends[..., :6, 1, :6]
    both_ends = both_ends.view(b, pairs, 8, 16)

    by_pair, by_both = zeros(b * pairs, 6, 7), zeros(b * (n + 1) * k, 8)
    used: list[Counted] = []
    for chunk, part in enumerate(plan.chunks()):
        group = plan.group_pair[part]
        places = slice(part.start * plan.size, part.stop * plan.size)
        kk = plan.kk[places]
        depth = inverse_depth.index_select(1, kk).view(b, -1, 1, plan.size)
        motion = t.index_select(1, group)
        v = view(rotation.index_select(1, group), motion, rays[:, part], depth)
        residual = target[:, part] - v.xy
        use = counts(v, residual, gate, part)
        w = torch.where(use, weight[:, part], 0.0)
        residual = torch.where(use, residual, 0.0)
        scale = gate.kernel.weights(residual, w, -2)
        if scale is not None:
            w = w * scale
        used.append((use, scale))
        j_d = (motion[..., :2, :] - v.xy * motion[..., 2:, :]) * v.inv_z
        # Rows: the six columns of J_j, then the residual, then J_d; each for the x and the y axis.
        f = torch.cat((*pose_jacobian(v), residual, j_d), -2)
        if pose_part:
            flat = f.view(*f.shape[:2], 8, 2 * plan.size)
            products = (flat[..., :6, :] * w.flatten(-2)[..., None, :]) @ flat[..., :7, :].mT
            by_pair.index_add_(0, index.pairs[chunk], products.flatten(0, 1))
        if depth_part:
            wd = w * j_d
            products = (f.unflatten(-2, (8, 2)) * wd[..., None, :, :]).sum(-2).mT @ both_ends.index_select(1, group)
            by_both.index_add_(0, index.ends[chunk], products.reshape(-1, 8))

    by_both = by_both.view(b, n + 1, k, 8)
    landmark = by_both[..., 6:].sum(1)
    g_l, h_ll = landmark.unbind(-1)
    if not pose_part:
        return NormalEquations(zeros(b, 0, 0), zeros(b, 0, k), h_ll, zeros(b, 0), g_l), used
    h_pl = by_both[:, :n, :, :6].transpose(2, 3).reshape(b, 6 * n, k)

    by_pair = by_pair.view(b, pairs, 6, 7)
    hessian, gradient = by_pair[..., :6], by_pair[..., 6:]
    ji = hessian @ minus_adjoint
    ii_gradient = minus_adjoint.mT @ torch.cat((ji, gradient), -1)
    blocks = torch.cat((hessian, ji, ji.mT, ii_gradient[..., :6]), 1)
    grid = zeros(b * (n + 1) ** 2, 6, 6).index_add_(0, index.blocks, blocks.flatten(0, 1))
    grid = grid.view(b, n + 1, n + 1, 6, 6)
    h_pp = grid[:, :n, :n].transpose(2, 3).reshape(b, 6 * n, 6 * n)
    gradients = torch.cat((gradient, ii_gradient[..., 6:]), 1)[..., 0]
    g_p = zeros(b, n + 1, 6).index_add_(1, index.gradients, gradients)[:, :n].reshape(b, 6 * n)
    return NormalEquations(h_pp, h_pl, h_ll, g_p, g_l), used
