"""Bundle adjustment of a whole graph: robust, sparse, with acceptance of steps; not differentiable.

The global counterpart of :func:`dvo.ba.layer.bundle_adjust`: same residuals, but memory and work grow with the number
of edges, not with frames times patches, and each step has to lower the cost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dvo.ba.blocks import INVERSE_DEPTHS, POSES
from dvo.ba.edges import free_slots, plan_edges
from dvo.ba.global_edges import ReprojectionEdges
from dvo.ba.kernels import Kernel
from dvo.ba.levenberg import LMOptions, levenberg_marquardt
from dvo.ba.linearisation import Linearisation
from dvo.ba.problem import Factor
from dvo.ba.schur_pattern import SchurPattern, make_schur_pattern
from dvo.ba.sparse import SparseSystem
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.precision import full_precision


@dataclass(frozen=True)
class GlobalBAOptions:
    """Settings of :func:`global_bundle_adjust`.

    Attributes:
        fixed: how many leading poses stay, or which: bool ``(N,)``. At least one, or a factor, has to hold the gauge;
            scale is held by damping alone where one pose is fixed.
        kernel: robust kernel on the weighted residual of an edge.
        max_residual: pixels; an edge with a longer residual has a constant cost.
        depth_range: inverse depths are clamped to it.
        move_poses, move_depths: what is refined.
        solver: of Levenberg-Marquardt and its linear systems.
    """

    fixed: int | Tensor | Sequence[bool] = 1
    kernel: Kernel = field(default_factory=lambda: Kernel("huber", 2.0))
    max_residual: float = 128.0
    depth_range: tuple[float, float] = (1e-3, 10.0)
    move_poses: bool = True
    move_depths: bool = True
    solver: LMOptions = field(default_factory=lambda: LMOptions(max_iterations=20))


@dataclass(frozen=True)
class GlobalBAResult:
    """Outcome of :func:`global_bundle_adjust`.

    Attributes:
        poses_cw: ``(N, 7)``.
        patches: ``(K, 3, p, p)``.
        initial_cost, cost: half the sum of robust squared residuals, pixels squared, before and after.
        inliers: ``(E,)`` bool, edges that count at the result.
        iterations: steps tried.
        converged: whether a criterion was met before the limit of iterations.
        stored_blocks: non-zero blocks of the normal equations.
    """

    poses_cw: Tensor
    patches: Tensor
    initial_cost: float
    cost: float
    inliers: Tensor
    iterations: int
    converged: bool
    stored_blocks: int


def global_bundle_adjust(
    poses_cw: Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    options: GlobalBAOptions = GlobalBAOptions(),  # noqa: B008 (frozen)
    factors: Sequence[Factor] = (),
) -> GlobalBAResult:
    """Refine all poses and inverse depths of a graph.

    Args:
        poses_cw: ``(N, 7)`` world to camera; their dtype, float32 or float64, is that of the computation.
        patches: ``(K, 3, p, p)`` x, y (pixels) and inverse depth; all pixels of a patch share that of its centre.
        intrinsics: ``(N, 4)`` fx fy cx cy in the same pixels.
        targets: ``(E, 2)`` where the patch centres are seen, pixels of frame j.
        weights: ``(E, 2)`` confidence per axis, not negative.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch of each edge, in any order. All edges of a patch
            have the same source frame.
        options: see :class:`GlobalBAOptions`.
        factors: further measurements of the state blocks "poses" ``(1, N, 7)`` and "inverse_depths" ``(1, K)``; the
            elements that they touch must not change between linearisations. Their cost is half the sum of
            ``weight * residual^2``, with the weights of their kernels.

    Returns:
        Poses and patches of the lowest cost found, and how it went.

    Raises:
        DvoError: shapes, indices or weights that do not fit, or a factor with other state blocks.

    Example:
        >>> result = global_bundle_adjust(poses_cw, patches, intrinsics, targets, weights, ii, jj, kk)
        >>> result.poses_cw, result.cost < result.initial_cost
    """
    _check(poses_cw, patches, intrinsics, targets, weights, ii, jj, kk)
    with torch.no_grad(), full_precision(poses_cw.device):
        centre = patches.shape[-1] // 2
        count, frames = len(patches), len(poses_cw)
        inverse_depth = patches[:, 2, centre, centre].to(poses_cw)
        slot, free = free_slots(options.fixed, frames, poses_cw.device)
        if not options.move_poses:
            slot, free = torch.zeros_like(slot), 0
        source = torch.zeros(count, dtype=torch.long, device=ii.device).index_copy_(0, kk, ii)
        if bool((source[kk] != ii).any()):
            raise DvoError(
                "a patch has two source frames", field="ii", remedy="give each patch the frame it was cut of"
            )
        intrinsics = intrinsics.to(poses_cw)
        focal, principal = intrinsics.split(2, -1)
        xy = patches[:, :2, centre, centre].to(poses_cw)
        edges = ReprojectionEdges(
            plan_edges(ii, jj, kk, frames, count),
            (xy - principal[source]) / focal[source],
            (targets.to(poses_cw) - principal[jj]) / focal[jj],
            weights.to(poses_cw),
            focal,
            options.kernel,
            options.max_residual,
            slot,
            free,
        )
        problem = _GlobalProblem(edges, source, tuple(factors), options, (poses_cw, inverse_depth))
        outcome = levenberg_marquardt(
            (poses_cw, inverse_depth), problem.linearise, problem.cost, problem.move, options.solver
        )
        poses, depths = outcome.state
        if options.move_depths:
            row = depths.to(patches)[:, None, None, None].expand_as(patches[:, :1])
            patches = torch.cat((patches[:, :2], row), 1)
        return GlobalBAResult(
            poses,
            patches,
            outcome.initial_cost,
            outcome.cost,
            edges.inliers(poses, depths),
            outcome.iterations,
            outcome.converged,
            problem.pattern.stored_blocks,
        )


class _GlobalProblem:
    """Cost, linearisation and retraction of the state ``(poses_cw (N, 7), inverse depths (K,))``."""

    def __init__(
        self,
        edges: ReprojectionEdges,
        source: Tensor,
        factors: tuple[Factor, ...],
        options: GlobalBAOptions,
        state: tuple[Tensor, Tensor],
    ) -> None:
        self.edges, self.factors, self.options = edges, factors, options
        plan, free = edges.plan, edges.free
        target, anchor = edges.ends
        frame, patch = [target, anchor], [plan.kk, plan.kk]
        pair_a, pair_b = [edges.slot[plan.pair_j]], [edges.slot[plan.pair_i]]
        for factor in factors:
            poses, depths = _slots(factor.linearise(_values(state)), edges.slot, free)
            pair_a += [a for a, _ in poses for _ in poses]
            pair_b += [b for _ in poses for b, _ in poses]
            for index, _ in depths:
                frame += [torch.where(index < 0, free, a) for a, _ in poses]
                patch += [index.clamp(min=0) for _ in poses]
        self.pattern: SchurPattern = make_schur_pattern(
            free, source, torch.cat(frame), torch.cat(patch), torch.cat(pair_a), torch.cat(pair_b)
        )
        self.at = (self.pattern.find(target, plan.kk), self.pattern.find(anchor, plan.kk))

    def cost(self, state: tuple[Tensor, Tensor]) -> float:
        values = _values(state)
        return self.edges.cost(*state) + sum(0.5 * float(f.linearise(values).cost()[0]) for f in self.factors)

    def move(self, state: tuple[Tensor, Tensor], step: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        (poses, depths), (dp, dl) = state, step
        slot, free = self.edges.slot, self.edges.free
        if free:
            moved = se3.retract(poses, torch.nn.functional.pad(dp, (0, 0, 0, 1))[slot])
            poses = torch.where((slot == free)[:, None], poses, moved)
        if self.options.move_depths:
            depths = (depths + dl).clamp(*self.options.depth_range)
        return poses, depths

    def linearise(self, state: tuple[Tensor, Tensor]) -> SparseSystem:
        h_pp, h_pl, h_ll, g_p, g_l = self.edges.accumulate(*state, self.pattern, self.at)
        system = SparseSystem(self.pattern, h_pp, h_pl, h_ll, g_p, g_l, self.options.move_depths)
        values = _values(state)
        for factor in self.factors:
            linear = factor.linearise(values)
            system.add(linear.residual[0], linear.weight[0], *_slots(linear, self.edges.slot, self.edges.free))
        return system


def _values(state: tuple[Tensor, Tensor]) -> Mapping[str, Tensor]:
    return {POSES: state[0][None], INVERSE_DEPTHS: state[1][None]}


def _slots(
    linear: Linearisation, slot: Tensor, free: int
) -> tuple[list[tuple[Tensor, Tensor]], list[tuple[Tensor, Tensor]]]:
    """Unknowns ``(F,)`` and Jacobians ``(F, D, 6)`` of the poses of a factor; elements and ``(F, D)`` of the depths."""
    poses, depths = [], []
    for name, index, jacobian in zip(linear.blocks, linear.indices, linear.jacobians, strict=True):
        if name == POSES:
            poses.append((torch.where(index < 0, free, slot[index]), jacobian[0]))
        elif name == INVERSE_DEPTHS:
            depths.append((index, jacobian[0, ..., 0]))
        else:
            raise DvoError(
                f"a factor touches {name!r}", field="factors", remedy="use factors of poses and inverse depths only"
            )
    return poses, depths


def _check(
    poses_cw: Tensor, patches: Tensor, intrinsics: Tensor, targets: Tensor, weights: Tensor, *edges: Tensor
) -> None:
    n, e = len(poses_cw), len(edges[0])
    k = len(patches)
    side = patches.shape[-1]
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]]
    wanted = {"poses_cw": (poses_cw, (n, 7)), "patches": (patches, (k, 3, side, side))}
    wanted |= {"intrinsics": (intrinsics, (n, 4)), "targets": (targets, (e, 2)), "weights": (weights, (e, 2))}
    wanted |= {name: (x, (e,)) for name, x in zip(("ii", "jj", "kk"), edges, strict=True)}
    for name, (tensor, shape) in wanted.items():
        if tensor.shape != shape:
            raise DvoError(
                f"has shape {tuple(tensor.shape)}, not {shape}", field=name, remedy="give one graph, without batch"
            )
    if poses_cw.dtype not in (torch.float32, torch.float64):
        raise DvoError(f"has dtype {poses_cw.dtype}", field="poses_cw", remedy="use float32 or float64")
    if e == 0:
        raise DvoError("a graph without edges", field="ii", remedy="give at least one edge")
    for name, index, size in zip(("ii", "jj", "kk"), edges, (n, n, k), strict=True):
        if int(index.min()) < 0 or int(index.max()) >= size:
            raise DvoError(f"has an index outside 0..{size - 1}", field=name, remedy="give existing frames and patches")
    if not bool(torch.isfinite(weights).all() and (weights >= 0).all()):
        raise DvoError("negative or not finite", field="weights", remedy="give weights of zero or more")
