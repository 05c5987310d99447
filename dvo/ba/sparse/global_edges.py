"""Reprojection edges of a whole graph: cost and block-sparse normal equations, a bounded number of edges at a time.

Linearisation is that of :mod:`dvo.ba.layer.normal_equations`; only the sums go to other places. An edge counts if its
point lies in front of the target frame (``Z > 0.2``) and its residual is shorter than ``max_residual``. Any other edge
has the constant cost of the longest residual, so that a step gains nothing by moving points behind a camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import torch
from torch import Tensor

from dvo.ba.edges import EdgePlan
from dvo.ba.kernels import Kernel, KernelName
from dvo.ba.layer.normal_equations import Gate, View, counts, pose_jacobian, relative_motion, view
from dvo.ba.sparse.schur_pattern import SchurPattern
from dvo.core.kernels import use_kernels
from dvo.geometry import so3

_LAYOUT = "group_pair", "pair_i", "pair_j", "order", "filled", "kk"  # of a plan, for kernels


@dataclass(frozen=True)
class Places:
    """Where the sums of edges go in a pattern.

    Attributes:
        target, source: ``(G * M,)`` observation of each edge by the frame it leads to, and by that of its patch; one
            past the last for fixed frames.
        pair: ``(P,)`` block of each pair of frames; not defined with a fixed one.
    """

    target: Tensor
    source: Tensor
    pair: Tensor


@dataclass(frozen=True)
class ReprojectionEdges:
    """Measurements of a graph in the order of an edge plan (one graph, no batch).

    Attributes:
        plan: layout of the edges by frame pair.
        source: ``(K, 2)`` patch centres in normalised coordinates of their source frame, x, y.
        target: ``(E, 2)`` normalised coordinates of the target frame.
        weight: ``(E, 2)`` confidence in inverse pixels squared.
        focal: ``(N, 2)`` fx fy of each frame.
        kernel: robust kernel on ``sum w r^2`` with ``r`` in pixels.
        max_residual: pixels.
        slot: ``(N,)`` unknown of each frame, ``free`` for fixed ones.
        free: number of free frames.
    """

    plan: EdgePlan
    source: Tensor
    target: Tensor
    weight: Tensor
    focal: Tensor
    kernel: Kernel
    max_residual: float
    slot: Tensor
    free: int

    def _view(
        self, rotation: Tensor, t: Tensor, inverse_depth: Tensor, part: slice
    ) -> tuple[View, Tensor, Tensor, Tensor]:
        """Points of a slice of groups, residual, weight ``(1, G, 2, M)`` and ``s = sum w r^2`` ``(1, G, 1, M)``.

        Weights are zero for empty places and edges that do not count; ``s`` is that of the longest residual for the
        latter.
        """
        plan, group = self.plan, self.plan.group_pair[part]
        places = slice(part.start * plan.size, part.stop * plan.size)
        shape = (1, len(group), plan.size, -1)
        kk, order = plan.kk[places], plan.order[places]
        xy = self.source.index_select(0, kk).view(shape)
        rays = torch.cat((xy, torch.ones_like(xy[..., :1])), -1).mT
        depth = inverse_depth.index_select(0, kk).view(1, -1, 1, plan.size)
        v = view(rotation.index_select(1, group), t.index_select(1, group), rays, depth)
        residual = self.target.index_select(0, order).view(shape).mT - v.xy
        pixel_weight = (self.weight.index_select(0, order).view(shape) * plan.filled[part, :, None]).mT
        focal = self.focal.index_select(0, plan.pair_j.index_select(0, group))[None, :, :, None]
        use = counts(v, residual, Gate(self.max_residual, focal), slice(None))
        residual = torch.where(use, residual, 0.0)
        weight = torch.where(use, pixel_weight * (focal * focal), 0.0)
        # The two axes are added by slices, here and below: a sum over a dimension of two is slow.
        square = weight * residual * residual
        s = square[..., :1, :] + square[..., 1:, :]
        longest = pixel_weight.amax(-2, keepdim=True) * self.max_residual**2
        return v, residual, weight, torch.where(use, s, longest)

    def _compiled(self, poses_cw: Tensor, inverse_depth: Tensor) -> bool:
        return use_kernels(poses_cw, inverse_depth, *self._floats, double=True)

    @property
    def _floats(self) -> tuple[Tensor, ...]:
        return self.source, self.target, self.weight, self.focal

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        """Arguments of kernels that do not change."""
        plan = self.plan
        source, target, weight, focal = (x.contiguous().numpy() for x in self._floats)
        layout = {name: getattr(plan, name).numpy() for name in _LAYOUT}
        return dict(source=source, target=target, weight=weight, focal=focal, **layout)

    def _motion(self, poses_cw: Tensor, inverse_depth: Tensor) -> dict[str, Any]:
        """Arguments of kernels that are the values of the unknowns."""
        values = so3.matrix(poses_cw[:, 3:]), poses_cw[:, :3], inverse_depth
        rotation, translation, depth = (x.contiguous().numpy() for x in values)
        return dict(rotation=rotation, translation=translation, depth=depth)

    def _robust(self) -> dict[str, Any]:
        return dict(name=get_args(KernelName).index(self.kernel.name), width=float(self.kernel.width))

    def cost(self, poses_cw: Tensor, inverse_depth: Tensor) -> float:
        """Half the sum of robust squared residuals, pixels squared, at ``(N, 7)`` and ``(K,)``."""
        if self._compiled(poses_cw, inverse_depth):
            from dvo.ba.sparse import edge_kernels

            values = self._motion(poses_cw, inverse_depth) | self._arrays | self._robust()
            return float(edge_kernels.cost(**values, max_residual=float(self.max_residual)))
        rotation, t = relative_motion(poses_cw[None], self.plan)
        total = 0.0
        for part in self.plan.chunks():
            s = self._view(rotation, t, inverse_depth, part)[3]
            total += 0.5 * float(self.kernel.cost(s).sum(dtype=torch.float64))
        return total

    def inliers(self, poses_cw: Tensor, inverse_depth: Tensor) -> Tensor:
        """``(E,)`` bool: the edge counts and its weight is positive."""
        if self._compiled(poses_cw, inverse_depth):
            from dvo.ba.sparse import edge_kernels

            values = self._motion(poses_cw, inverse_depth) | self._arrays
            return torch.from_numpy(edge_kernels.inliers(**values, max_residual=float(self.max_residual)))
        rotation, t = relative_motion(poses_cw[None], self.plan)
        out = torch.zeros(len(self.target), dtype=torch.bool, device=self.target.device)
        for part in self.plan.chunks():
            weight = self._view(rotation, t, inverse_depth, part)[2]
            places = slice(part.start * self.plan.size, part.stop * self.plan.size)
            filled = self.plan.filled[part].flatten()
            out[self.plan.order[places][filled]] = (weight > 0).any(-2).flatten()[filled]
        return out

    @cached_property
    def ends(self) -> tuple[Tensor, Tensor]:
        """``(G * M,)`` unknown of the target and of the source frame of each place; ``free`` for an empty place."""
        pair = self.plan.group_pair.repeat_interleave(self.plan.size)
        target, source = (self.slot[frames[pair]] for frames in (self.plan.pair_j, self.plan.pair_i))
        filled = self.plan.filled.flatten()
        return torch.where(filled, target, self.free), torch.where(filled, source, self.free)

    def places(self, pattern: SchurPattern) -> Places:
        """Where :meth:`accumulate` adds.

        Args:
            pattern: holds every observation and pair of the edges.
        """
        target, source = (pattern.find(end, self.plan.kk) for end in self.ends)
        frames = self.slot[self.plan.pair_j], self.slot[self.plan.pair_i]
        return Places(target, source, pattern.h_pp.find(torch.maximum(*frames), torch.minimum(*frames)))

    def accumulate(
        self, poses_cw: Tensor, inverse_depth: Tensor, pattern: SchurPattern, at: Places
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Linearise and sum over the edges.

        Args:
            poses_cw: ``(N, 7)``.
            inverse_depth: ``(K,)``.
            pattern: holds every observation and pair of the edges.
            at: of the pattern, see :meth:`places`.

        Returns:
            ``h_pp (N_blocks, 6, 6)``, ``h_pl (O, 6)``, ``h_ll (K,)``, ``g_p (n, 6)``, ``g_l (K,)``; see
            :class:`dvo.ba.sparse.equations.SparseSystem`.
        """
        if self._compiled(poses_cw, inverse_depth):
            return self._accumulate_compiled(poses_cw, inverse_depth, pattern, at)
        plan, n = self.plan, self.free
        zeros = poses_cw.new_zeros
        rotation, t = relative_motion(poses_cw[None], plan)
        # J_i = -J_j Ad(G_ij)
        minus_adjoint = zeros(len(plan.pair_i), 6, 6)
        minus_adjoint[:, :3, :3] = minus_adjoint[:, 3:, 3:] = -rotation[0]
        minus_adjoint[:, :3, 3:] = -so3.hat(t[0, ..., 0]) @ rotation[0]
        by_pair, h_pl = zeros(len(plan.pair_i), 6, 7), zeros(len(pattern.keys) + 1, 6)
        by_depth = zeros(plan.patches, 2)
        for part in plan.chunks():
            group = plan.group_pair[part]
            places = slice(part.start * plan.size, part.stop * plan.size)
            v, residual, weight, s = self._view(rotation, t, inverse_depth, part)
            weight = weight * self.kernel.slope(s)
            motion = t.index_select(1, group)
            j_d = (motion[..., :2, :] - v.xy * motion[..., 2:, :]) * v.inv_z
            # Rows: the six columns of J_j, then the residual, then J_d; each for the x and the y axis.
            f = torch.cat((*pose_jacobian(v), residual, j_d), -2)[0]
            flat = f.view(len(f), 8, 2 * plan.size)
            by_pair.index_add_(0, group, (flat[:, :6] * weight[0].flatten(-2)[:, None]) @ flat[:, :7].mT)
            wd = (weight * j_d)[0]
            products = (f[:, 0::2] * wd[:, :1] + f[:, 1::2] * wd[:, 1:]).mT  # (G, M, 8)
            by_depth.index_add_(0, plan.kk[places], products[..., 6:].reshape(-1, 2))
            target = products[..., :6]
            h_pl.index_add_(0, at.target[places], target.reshape(-1, 6))
            h_pl.index_add_(0, at.source[places], (target @ minus_adjoint.index_select(0, group)).reshape(-1, 6))

        hessian, gradient = by_pair.split((6, 1), -1)
        ji = hessian @ minus_adjoint
        slot_j, slot_i = self.slot[plan.pair_j], self.slot[plan.pair_i]
        h_pp = zeros(pattern.h_pp.count, 6, 6)
        for slot, blocks in ((slot_j, hessian), (slot_i, minus_adjoint.mT @ ji)):
            free = slot < n
            h_pp.index_add_(0, pattern.h_pp.diagonal[slot[free]], blocks[free])
        both = (slot_j < n) & (slot_i < n)
        same, below, above = both & (slot_j == slot_i), both & (slot_j > slot_i), both & (slot_j < slot_i)
        h_pp.index_add_(0, pattern.h_pp.find(slot_j[below], slot_i[below]), ji[below])
        h_pp.index_add_(0, pattern.h_pp.find(slot_i[above], slot_j[above]), ji[above].mT)
        h_pp.index_add_(0, pattern.h_pp.find(slot_j[same], slot_i[same]), ji[same] + ji[same].mT)
        g_p = zeros(n + 1, 6).index_add_(0, slot_j, gradient[..., 0])
        g_p = g_p.index_add_(0, slot_i, (minus_adjoint.mT @ gradient)[..., 0])[:n]
        return h_pp, h_pl[:-1], by_depth[:, 1], g_p, by_depth[:, 0]

    def _accumulate_compiled(
        self, poses_cw: Tensor, inverse_depth: Tensor, pattern: SchurPattern, at: Places
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        from dvo.ba.sparse import edge_kernels

        n, zeros = self.free, poses_cw.new_zeros
        h_pp, h_pl = zeros(pattern.h_pp.count, 6, 6), zeros(len(pattern.keys) + 1, 6)
        h_ll, g_p, g_l = zeros(self.plan.patches), zeros(n + 1, 6), zeros(self.plan.patches)
        edge_kernels.accumulate(
            **self._motion(poses_cw, inverse_depth), **self._arrays, **self._robust(),
            max_residual=float(self.max_residual), slot=self.slot.numpy(),
            at_target=at.target.numpy(), at_source=at.source.numpy(), diagonal=pattern.h_pp.diagonal.numpy(),
            off_diagonal=at.pair.numpy(), h_pp=h_pp.numpy(), h_pl=h_pl.numpy(), h_ll=h_ll.numpy(), g_p=g_p.numpy(),
            g_l=g_l.numpy(),
        )  # fmt: skip
        return h_pp, h_pl[:-1], h_ll, g_p[:n], g_l
