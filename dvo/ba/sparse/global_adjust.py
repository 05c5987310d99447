"""Bundle adjustment of a whole graph: robust, sparse, with acceptance of steps; not differentiable.

The global counterpart of :func:`dvo.ba.layer.layer.bundle_adjust`: same residuals, but memory and work grow with the
number of edges, not with frames times patches, and each step has to lower the cost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.ba.blocks import (
    INTRINSICS,
    INVERSE_DEPTHS,
    POSES,
    free_slots,
    intrinsics_block,
    inverse_depth_block,
    pose_block,
)
from dvo.ba.checks import REAL, WHOLE, check_kind, check_positive, check_range, check_switch, check_tensor, check_within
from dvo.ba.edges import check_index, plan_edges
from dvo.ba.kernels import Kernel
from dvo.ba.limits import DEPTH_RANGE, HEAVIEST, LARGEST, SHORTEST_FOCAL
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor, State, StateBlock, check_further
from dvo.ba.sparse.block_parts import PART, BlockParts
from dvo.ba.sparse.equations import SparseSystem
from dvo.ba.sparse.global_edges import Places, ReprojectionEdges
from dvo.ba.sparse.levenberg import LMOptions, levenberg_marquardt
from dvo.ba.sparse.schur_pattern import SchurPattern, make_schur_pattern
from dvo.ba.sparse.small_problem import SmallProblem, is_small
from dvo.core.context import full_precision, use_threads
from dvo.core.errors import DvoError
from dvo.core.kernels import use_kernels


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

    Raises:
        DvoError: a value of another type or out of its limits.
    """

    fixed: int | Tensor | Sequence[bool] = 1
    kernel: Kernel = field(default_factory=lambda: Kernel("huber", 2.0))
    max_residual: float = 128.0
    depth_range: tuple[float, float] = DEPTH_RANGE
    move_poses: bool = True
    move_depths: bool = True
    solver: LMOptions = field(default_factory=lambda: LMOptions(max_iterations=20))

    def __post_init__(self) -> None:
        check_kind(self.kernel, "kernel", Kernel)
        check_kind(self.solver, "solver", LMOptions)
        if self.max_residual != math.inf:
            check_positive(self.max_residual, "max_residual")
        check_range(self.depth_range, "depth_range", 0.0, LARGEST)
        for name in ("move_poses", "move_depths"):
            check_switch(getattr(self, name), name)


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
        blocks: values of the further state blocks, by name.
    """

    poses_cw: Tensor
    patches: Tensor
    initial_cost: float
    cost: float
    inliers: Tensor
    iterations: int
    converged: bool
    stored_blocks: int
    blocks: Mapping[str, Tensor] = field(default_factory=dict)


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
    blocks: Mapping[str, StateBlock] | None = None,
) -> GlobalBAResult:
    """Refine all poses and inverse depths of a graph.

    Args:
        poses_cw: ``(N, 7)`` world to camera, unit quaternions; their dtype, float32 or float64, is that of the
            computation. No number of poses, patches and intrinsics is larger than 1e8.
        patches: ``(K, 3, p, p)`` x, y (pixels) and inverse depth; all pixels of a patch share that of its centre.
        intrinsics: ``(N, 4)`` fx fy cx cy in the same pixels.
        targets: ``(E, 2)`` where the patch centres are seen, pixels of frame j; an edge with a target that is not
            finite, or larger than 1e8, does not count.
        weights: ``(E, 2)`` confidence per axis, from 0 to 1e16.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch of each edge, in any order. All edges of a patch
            have the same source frame.
        options: see :class:`GlobalBAOptions`.
        factors: further measurements of the state blocks "poses" ``(1, N, 7)``, "inverse_depths" ``(1, K)`` and those
            in ``blocks``; the elements that they touch must not change between linearisations. Their cost is half of
            :meth:`dvo.ba.problem.Factor.cost`.
        blocks: further unknowns that the factors concern, by name, each with a batch dimension of 1; see
            :func:`dvo.ba.blocks.vector_block`. If one of them is float64, so is the computation.

    Returns:
        Poses and patches of the lowest cost found, and how it went.

    Raises:
        DvoError: types, shapes, numbers, indices or weights that do not fit, options of another type, or a further
            block that is eliminated or a batch.

    Example:
        >>> result = global_bundle_adjust(poses_cw, patches, intrinsics, targets, weights, ii, jj, kk)
        >>> result.poses_cw, result.cost < result.initial_cost
    """
    given = poses_cw, patches, intrinsics, targets, weights, ii, jj, kk
    return adjust_sparse(PatchProblem(*given, factors=tuple(factors), blocks=blocks or {}), options)


def adjust_sparse(problem: PatchProblem, options: GlobalBAOptions) -> GlobalBAResult:
    """The sparse solution of one graph; see :func:`global_bundle_adjust` and :func:`dvo.ba.solve.solve`."""
    use_threads()
    check_kind(options, "options", GlobalBAOptions)
    problem, unseen = _checked(problem)
    with torch.no_grad(), full_precision(problem.poses_cw.device):
        system: Any  # whose state is of one type or the other
        if options.move_poses and options.solver.solver in ("auto", "direct") and is_small(problem):
            slots = free_slots(options.fixed, len(problem.poses_cw), problem.poses_cw.device)
            how: tuple[Any, ...] = (options.move_depths, options.kernel, options.max_residual, options.depth_range)
            system = SmallProblem(problem, *slots, *how)
        else:
            system = SparseProblem(problem, options)
        outcome = levenberg_marquardt(system.state, system.linearise, system.cost, system.moved, options.solver)
        state: Any = outcome.state
        poses_cw, inverse_depths = system.values(state)
        if options.move_depths:
            problem = problem.with_values(inverse_depths=inverse_depths)
        return GlobalBAResult(
            poses_cw.to(problem.poses_cw.dtype),
            problem.patches,
            outcome.initial_cost,
            outcome.cost,
            system.inliers(state) if unseen is None else system.inliers(state) & ~unseen,
            outcome.iterations,
            outcome.converged,
            system.stored_blocks,
            {name: state[name].value for name in problem.blocks},
        )


class SparseProblem:
    """Cost and block-sparse normal equations of a graph; its measurements take the fast path with one camera.

    Args:
        problem: one graph.
        options: what moves, kernel and longest residual.

    Attributes:
        state: the unknowns at the values of the problem.
        pattern: of the normal equations.
    """

    def __init__(self, problem: PatchProblem, options: GlobalBAOptions) -> None:
        like = problem.poses_cw
        if any(block.value.dtype == torch.float64 for block in problem.blocks.values()):
            like = like.double()
        names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
        problem = problem.with_values(**{name: getattr(problem, name).to(like) for name in names})
        one = problem.batched()
        further = {name: block.with_value(block.value.to(like)) for name, block in problem.blocks.items()}
        for name, block in further.items():
            if block.eliminated or block.value.shape[0] != 1:
                raise DvoError(f"{name!r} is eliminated or a batch", field="blocks", remedy="give vectors of one graph")
        poses = pose_block(one.poses_cw, options.fixed, held=not options.move_poses)
        depths = inverse_depth_block(one.inverse_depths, options.depth_range, held=not options.move_depths)
        factors = [factor.with_tensors([x.to(like) for x in factor.tensors()]) for factor in problem.factors]
        if problem.sensors is not None:
            further[INTRINSICS] = intrinsics_block(one.intrinsics)
            factors.insert(0, problem.reprojection(options.max_residual, None, options.kernel))
        self.state = State({POSES: poses, **further, INVERSE_DEPTHS: depths})
        self.parts, self.factors, self.moves_depths = BlockParts.of(self.state), factors, options.move_depths
        source = _sources(problem)
        self.edges: ReprojectionEdges | None = None
        if problem.sensors is None:
            frames = torch.arange(len(like), device=like.device)
            slots = self.parts.slots(self.state, POSES, frames) or [torch.full_like(frames, self.parts.count)]
            self.edges = _fast_edges(problem, source, slots[0], self.parts.count, options)
        if self.edges is None:
            self.pattern = self._pattern(source)
        else:
            self.pattern, self.at = self._layout(self.edges, source)

    def _layout(self, edges: ReprojectionEdges, source: Tensor) -> tuple[SchurPattern, Places]:
        """Pattern, and the places of the edges in it; without other factors made once for the same edges."""
        key, known = (self.parts.count, edges.slot.cpu().numpy().tobytes()), edges.plan.layouts
        if self.factors or key not in known:
            pattern = self._pattern(source)
            places = edges.places(pattern)
            if self.factors:
                return pattern, places
            known[key] = pattern, places
        layout: tuple[SchurPattern, Places] = known[key]
        return layout

    def _pattern(self, source: Tensor) -> SchurPattern:
        """Where blocks are, by the elements that the factors touch now."""
        frame, patch, pair_a, pair_b = [], [], [], []
        free, values = self.parts.count, self.state.values()
        if self.edges is not None:
            plan = self.edges.plan
            frame, patch = [*self.edges.ends], [plan.kk, plan.kk]
            pair_a, pair_b = [self.edges.slot[plan.pair_j]], [self.edges.slot[plan.pair_i]]
        for factor in self.factors:
            parts, depths = self.parts.of_factor(factor.linearise(values), self.state)
            pair_a += [a for a, _ in parts for _ in parts]
            pair_b += [b for _ in parts for b, _ in parts]
            for index, _ in depths:
                frame += [torch.where(index < 0, free, a) for a, _ in parts]
                patch += [index.clamp(min=0) for _ in parts]
        none = [torch.zeros(0, dtype=torch.long, device=source.device)]
        return make_schur_pattern(free, source, *(torch.cat(x or none) for x in (frame, patch, pair_a, pair_b)))

    @property
    def stored_blocks(self) -> int:
        """Blocks of the normal equations that are not zero."""
        return self.pattern.stored_blocks

    def moved(self, state: State, step: tuple[Tensor, Tensor]) -> State:
        """The state after a step."""
        poses, (turns, depths) = state[POSES], step
        if len(state.blocks) > 2 or poses.held or not use_kernels(poses.value, turns, double=True):
            return self.parts.moved(state, step)
        from dvo.ba.layer.edgewise_kernels import move_poses

        values, slots = poses.value[0].contiguous().numpy().copy(), np.arange(len(poses.value[0]))
        slots = slots if poses.slot is None else poses.slot.numpy()
        move_poses(values, np.where(slots < poses.free, PART * slots, -1), turns.contiguous().numpy().ravel())
        found = {POSES: torch.from_numpy(values)[None], INVERSE_DEPTHS: state[INVERSE_DEPTHS].moved(depths[None]).value}
        return state.with_values(found)

    def values(self, state: State) -> tuple[Tensor, Tensor]:
        """Poses ``(N, 7)`` and inverse depths ``(K,)`` of a state."""
        return state[POSES].value[0], state[INVERSE_DEPTHS].value[0]

    def cost(self, state: State) -> float:
        """Half the sum of robust squared residuals, and of what the factors give as their cost."""
        values = state.values()
        own = self.edges.cost(*self.values(state)) if self.edges is not None else 0.0
        return own + sum(0.5 * float(factor.cost(values)[0]) for factor in self.factors)

    def inliers(self, state: State) -> Tensor:
        """``(E,)`` bool, edges that count."""
        if self.edges is not None:
            return self.edges.inliers(*self.values(state))
        return (self.factors[0].linearise(state.values()).weight[0] > 0).any(-1)

    def linearise(self, state: State) -> SparseSystem:
        """Normal equations at a state."""
        pattern, zeros = self.pattern, state[POSES].value.new_zeros
        count, free = state[INVERSE_DEPTHS].value.shape[1], self.parts.count
        if self.edges is not None:
            sums = self.edges.accumulate(*self.values(state), pattern, self.at)
        else:
            shapes = (pattern.h_pp.count, PART, PART), (len(pattern.keys), PART), (count,), (free, PART), (count,)
            sums = tuple(map(zeros, shapes))  # type: ignore[assignment]
        system = SparseSystem(pattern, *sums, self.moves_depths)
        values = state.values()
        for factor in self.factors:
            linear = factor.linearise(values)
            system.add(linear.residual[0], linear.weight[0], *self.parts.of_factor(linear, state))
        if len(self.state.blocks) > 2:  # a pose has nothing filled up
            system.h_pp.index_add_(0, pattern.h_pp.diagonal, torch.diag_embed(self.parts.filled))
        return system


def _sources(problem: PatchProblem) -> Tensor:
    """``(K,)`` source frame of each patch."""
    source = torch.zeros(len(problem.patches), dtype=torch.long, device=problem.ii.device)
    return source.index_copy_(0, problem.kk, problem.ii)


def _fast_edges(
    problem: PatchProblem, source: Tensor, slot: Tensor, free: int, options: GlobalBAOptions
) -> ReprojectionEdges:
    focal, principal = problem.intrinsics.split(2, -1)
    plan = problem.plan
    if plan is None:
        plan = plan_edges(problem.ii, problem.jj, problem.kk, len(problem.poses_cw), len(problem.patches))
    return ReprojectionEdges(
        plan,
        (problem.centres - principal[source]) / focal[source],
        (problem.targets - principal[problem.jj]) / focal[problem.jj],
        problem.weights,
        focal,
        options.kernel,
        options.max_residual,
        slot,
        free,
    )


def _checked(problem: PatchProblem) -> tuple[PatchProblem, Tensor | None]:
    """The problem with indices of one type, and edges without a target as such of no weight; which these are."""
    check_further(problem.factors, problem.blocks)
    sensors, device = problem.sensors, getattr(problem.poses_cw, "device", None)
    for name in ("poses_cw", "patches", "intrinsics", "targets", "weights"):
        check_tensor(getattr(problem, name), name, REAL, device)
    indices = {name: getattr(problem, name) for name in ("ii", "jj", "kk")}
    for name, index in indices.items():
        check_tensor(index, name, WHOLE, device)
    if any(x.dim() == 0 for x in (problem.poses_cw, problem.patches, *indices.values())):
        raise DvoError("a number alone", field="poses_cw", remedy="give one graph")
    n, e, k = problem.poses_cw.shape[0], len(problem.ii), problem.patches.shape[0]
    side = problem.patches.shape[-1]
    cameras = n if sensors is None else sensors.from_body.shape[-2]
    wanted = {"poses_cw": (n, 7), "patches": (k, 3, side, side), "intrinsics": (cameras, 4)}
    wanted |= {"targets": (e, 2), "weights": (e, 2), "ii": (e,), "jj": (e,), "kk": (e,)}
    for name, shape in wanted.items():
        tensor = getattr(problem, name)
        if tensor.shape != shape:
            raise DvoError(
                f"has shape {tuple(tensor.shape)}, not {shape}", field=name, remedy="give one graph, without batch"
            )
    if problem.poses_cw.dtype not in (torch.float32, torch.float64):
        raise DvoError(f"has dtype {problem.poses_cw.dtype}", field="poses_cw", remedy="use float32 or float64")
    if e == 0:
        raise DvoError("a graph without edges", field="ii", remedy="give at least one edge")
    sizes = [("ii", problem.ii, n), ("jj", problem.jj, n), ("kk", problem.kk, k)]
    if sensors is not None:
        sizes += [("sensors.source", sensors.source, cameras), ("sensors.target", sensors.target, cameras)]
    for name, index, size in sizes:
        check_index(index, size, name)
    check_within(problem.weights, "weights", 0.0, HEAVIEST)
    for name in ("poses_cw", "patches", "intrinsics"):
        check_within(getattr(problem, name), name)
    check_within(
        torch.linalg.vector_norm(problem.poses_cw[:, 3:], dim=-1), "poses_cw, length of quaternions", 0.95, 1.05
    )
    check_within(problem.intrinsics[:, :2], "intrinsics, focal lengths", SHORTEST_FOCAL)
    if any(index.dtype != torch.int64 for index in indices.values()):
        problem = replace(problem, **{name: index.long() for name, index in indices.items()})
    if bool((_sources(problem)[problem.kk] != problem.ii).any()):
        raise DvoError("a patch has two source frames", field="ii", remedy="give each patch the frame it was cut of")
    unseen = ~(torch.isfinite(problem.targets) & (problem.targets.abs() <= LARGEST)).all(-1)
    if not bool(unseen.any()):
        return problem, None
    targets, weights = (x.masked_fill(unseen[:, None], 0.0) for x in (problem.targets, problem.weights))
    return replace(problem, targets=targets, weights=weights), unseen
