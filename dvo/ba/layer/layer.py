"""The differentiable dense bundle adjustment layer.

Unknowns are camera poses, one inverse depth per patch and, if wanted, intrinsics; measurements are the positions of
patch centres in other frames, and any further factors. Residual of an edge (i, j, k):
``r = target - project(T_j T_i^-1 backproject(patch k))``, weighted by a 2-vector. Each iteration is a damped
Gauss-Newton step without acceptance test, hence differentiable from end to end: linearise with analytic Jacobians,
eliminate the depths, solve for the poses, substitute back, retract. (Tang and Tan, "BA-Net", 2019; Teed et al., "Deep
Patch Visual Odometry", 2023.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES, intrinsics_block, inverse_depth_block, pose_block
from dvo.ba.covariance import pose_covariance
from dvo.ba.edges import EdgePlan, plan_edges
from dvo.ba.layer import edgewise
from dvo.ba.layer.checks import FLOATS, INDICES, check_structure, check_values
from dvo.ba.layer.edgewise import EdgewiseReprojection, measured_edges
from dvo.ba.layer.grouped import group_measurements
from dvo.ba.layer.single import SinglePrecision
from dvo.ba.layer.step import gauss_newton
from dvo.ba.layer.transforms import composed
from dvo.ba.options import BADamping, BAOptions, BAResult, Sensors
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor, Problem, State, StateBlock
from dvo.core.context import full_precision, use_threads
from dvo.core.errors import DvoError
from dvo.core.kernels import is_transformed, use_device_kernels, use_kernels
from dvo.core.settings import shown
from dvo.geometry import se3

__all__ = ["BADamping", "BAOptions", "BAResult", "Sensors", "bundle_adjust", "make_problem"]

_DEFAULT = BAOptions()


def bundle_adjust(
    poses_cw: Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    options: BAOptions = _DEFAULT,
    *,
    factors: Iterable[Factor] = (),
    blocks: Mapping[str, StateBlock] | None = None,
    plan: EdgePlan | None = None,
) -> BAResult:
    """Refine poses and inverse depths so that the patches project onto their targets.

    Gradients flow to poses, patches, intrinsics, targets, weights and the parameters of the factors, through all
    iterations, and may be differentiated again (``create_graph``); kernel weights are constants of every derivative.
    What a gradient by poses says of the length of a quaternion means nothing, as they are unit quaternions.
    ``torch.func`` (grad, vjp, jacrev, jvp, jacfwd, hessian, vmap) works: a vmap is a loop over its elements. A
    backward pass raises if indices or tensors have been changed in place since.

    Neither the result nor a gradient is ever NaN or infinite for input that is not refused: an edge whose point is not
    in front of frame j (``Z <= 0.2``), whose residual is too long, which leaves the bounds, or whose target or weight
    is not finite counts for nothing in that iteration, and where the system cannot be solved, or its step is longer
    than 1e8, the step is zero. A gradient too large for its type is zero.

    Args:
        poses_cw: ``(B, N, 7)`` world to camera, unit quaternions; their dtype is that of the result (float32 for half
            precision). No number of poses, patches and intrinsics is larger than 1e8.
        patches: ``(B, K, 3, p, p)`` x, y (feature-map pixels) and inverse depth; all pixels of a patch share the one
            of its centre.
        intrinsics: ``(B, N, 4)`` fx fy cx cy in the same pixels, focal lengths of at least 1e-3; ``(B, S, 4)`` with
            several sensors.
        targets: ``(B, E, 2)`` measured positions of the patch centres, pixels of frame j; an edge with a target that is
            not finite, or larger than 1e8, does not count.
        weights: ``(B, E, 2)`` confidence per axis (inverse variance, pixels^-2), not negative; an edge with a weight
            that is not finite does not count.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch of each edge, whole numbers in any order, shared by
            the batch.
        options: see :class:`BAOptions`.
        factors: further measurements, for example priors (:mod:`dvo.ba.factors`).
        blocks: further unknowns that the factors concern, by name, for example velocities; see
            :func:`dvo.ba.blocks.vector_block`. If one of them is float64, so are all unknowns and factors, and the
            reprojection alone is summed in the type of the targets.
        plan: layout that :func:`dvo.ba.edges.plan_edges` made of ``ii, jj, kk``, to save doing it again for a graph
            that does not change.

    Returns:
        New poses and patches, and what the options ask for beyond.

    Raises:
        DvoError: types, devices or shapes that do not belong together, an empty batch, options out of their limits, a
            factor that does not fit. Unless ``options.check`` is False: poses, patches, intrinsics, blocks or factors
            with a number that is not finite or out of the limits above, an index out of range, a negative weight, a
            ``plan`` of other edges. Forward-mode dual numbers outside ``torch.func``.

    Example:
        Two frames, and forty patches of the first that the second sees a pixel and a half further right and down:

        >>> k = torch.arange(40)
        >>> patches = torch.rand(1, 40, 3, 1, 1) * torch.tensor([160, 120, 1.0]).view(3, 1, 1)  # x, y, inverse depth
        >>> targets = (patches[:, :, :2, 0, 0] + 1.5).requires_grad_()
        >>> intrinsics, weights = torch.tensor([[[200.0, 200, 80, 60]] * 2]), torch.ones(1, 40, 2)
        >>> poses, options = dvo.se3.identity(1, 2), dvo.BAOptions(iterations=4, bounds=(160, 120))
        >>> result = dvo.bundle_adjust(poses, patches, intrinsics, targets, weights, 0 * k, 0 * k + 1, k, options)
        >>> result.poses_cw[0, 1, :3].norm().backward()
        >>> targets.grad.shape
        torch.Size([1, 40, 2])
    """
    if not isinstance(options, BAOptions):
        raise DvoError(f"is {shown(options)}", field="options", remedy="give a BAOptions object")
    if not isinstance(factors, Iterable):
        raise DvoError(f"is {shown(factors)}", field="factors", remedy="give a list of factors")
    given = poses_cw, patches, intrinsics, targets, weights, ii, jj, kk
    further = {} if blocks is None else blocks
    return adjust_dense(PatchProblem(*given, options.sensors, tuple(factors), further, plan), options)


def adjust_dense(given: PatchProblem, options: BAOptions) -> BAResult:
    """The dense solution of a batch that is checked first; see :func:`bundle_adjust` and :func:`dvo.ba.solve.solve`."""
    use_threads()
    check_structure(given)
    if is_transformed():
        return _transformed(given, options)
    given = _with_whole_indices(given)
    if options.check is not False:
        check_values(given)
    return dense_solution(given, options)


def dense_solution(given: PatchProblem, options: BAOptions) -> BAResult:
    """The dense solution of a batch that is made by the caller: nothing of it is checked.

    Args:
        given: with indices of int64; not within ``torch.func``.
        options: see :class:`BAOptions`; ``check`` does not count.

    Returns:
        As :func:`bundle_adjust`.
    """
    use_threads()
    if (found := _by_window_kernels(given, options)) is not None:
        return found
    with full_precision(given.poses_cw.device):
        problem = _solved(make_problem(given, options), options)
        state, patches, dtype = problem.state, given.patches, _computed(given.poses_cw.dtype)
        patches = patches.to(dtype)
        poses_cw, inverse_depths = (state[name].value.to(dtype) for name in (POSES, INVERSE_DEPTHS))
        if not state[INVERSE_DEPTHS].held:
            row = inverse_depths[:, :, None, None, None].expand_as(patches[:, :, :1])
            patches = torch.cat((patches[:, :, :2], row), 2)
        intrinsics = state[INTRINSICS].value if INTRINSICS in state.blocks else given.intrinsics
        intrinsics = intrinsics.to(dtype)
        cost = inliers = covariance = None
        if options.covariance is not None:
            covariance = pose_covariance(problem, options.covariance, options.damping, sigma=options.sigma)
        if options.report:
            blocks = {name: state[name] for name in given.blocks}
            now = given.with_values(poses_cw=poses_cw, patches=patches, intrinsics=intrinsics, blocks=blocks)
            cost, inliers = _report(make_problem(now, options, grouped=False))
        further = {name: state[name].value for name in given.blocks}
        return BAResult(poses_cw, patches, intrinsics, cost, inliers, covariance, further)


def _by_window_kernels(given: PatchProblem, options: BAOptions) -> BAResult | None:
    """The problem of a tracker's window by one call of kernels: one camera, nothing but the reprojection, leading poses
    that stay. None for another problem, and where there are no kernels for it."""
    if given.sensors is not None or given.factors or given.blocks or options.refine_intrinsics != "none":
        return None
    if options.structure_only or options.motion_only or options.report or options.covariance is not None:
        return None
    fixed, frames = options.fixed, given.poses_cw.shape[1]
    if not isinstance(fixed, int) or isinstance(fixed, bool) or not 0 <= fixed < frames:
        return None
    take_steps = _kernels_of(given, frames - fixed)
    if take_steps is None:
        return None
    measured = given.centres, given.intrinsics, given.targets, given.weights, given.ii, given.jj, given.kk
    found = take_steps(given.poses_cw, given.inverse_depths, *measured, fixed, options)
    if found is None:
        return None
    row = found[1][:, :, None, None, None].expand_as(given.patches[:, :, :1])
    return BAResult(found[0], torch.cat((given.patches[:, :, :2], row), 2), given.intrinsics, blocks={})


def _kernels_of(given: PatchProblem, free: int) -> Callable[..., tuple[Tensor, Tensor] | None] | None:
    """Steps of a window with a number of free poses on the device of its tensors; None for the twin."""
    floats = given.poses_cw, given.patches, given.intrinsics, given.targets, given.weights
    if use_kernels(*floats):
        return edgewise.take_steps
    if not use_device_kernels(*floats) or not min(given.patches.shape[1], len(given.ii)):
        return None
    from dvo.ba.layer import edgewise_triton

    fits = given.poses_cw.shape[1] <= edgewise_triton.MOST_FRAMES and free <= edgewise_triton.MOST_FREE
    return edgewise_triton.take_steps if fits else None


def _solved(problem: Problem, options: BAOptions) -> Problem:
    first = problem.factors[0]
    if isinstance(first.factor if isinstance(first, SinglePrecision) else first, EdgewiseReprojection):
        return edgewise.gauss_newton(problem, options.iterations, options.damping, options.depth_range)
    return gauss_newton(problem, options.iterations, options.damping)


def _with_whole_indices(given: PatchProblem) -> PatchProblem:
    """The same with indices of the type that everything takes; nearly always they have it."""
    values: dict[str, Any] = {n: getattr(given, n).long() for n in INDICES if getattr(given, n).dtype != torch.int64}
    sensors = given.sensors
    if sensors is not None and (sensors.source.dtype, sensors.target.dtype) != (torch.int64, torch.int64):
        values["sensors"] = replace(sensors, source=sensors.source.long(), target=sensors.target.long())
    return replace(given, **values) if values else given


def _transformed(given: PatchProblem, options: BAOptions) -> BAResult:
    """The same within ``torch.func``, whose tensors are taken apart: see :mod:`dvo.ba.layer.transforms`."""
    named: list[tuple[Any, ...]] = [("given", name) for name in (*FLOATS, *INDICES)]
    if given.sensors is not None:
        named += [("sensors", name) for name in ("source", "target", "from_body")]
    named += [("blocks", name) for name in given.blocks]
    for i, factor in enumerate(given.factors):
        named += [("factors", i, f.name) for f in fields(factor) if isinstance(getattr(factor, f.name), Tensor)]  # type: ignore[arg-type]

    def value(kind: str, *name: Any) -> Tensor:
        if kind == "blocks":
            return given.blocks[name[0]].value
        holder = given.factors[name[0]] if kind == "factors" else given.sensors if kind == "sensors" else given
        found: Tensor = getattr(holder, name[-1])
        return found

    def rebuilt(tensors: tuple[Tensor, ...]) -> PatchProblem:
        values = dict(zip(named, tensors, strict=True))

        def part(*start: Any) -> dict[str, Tensor]:
            return {name[-1]: x for name, x in values.items() if name[:-1] == start}

        sensors = None if given.sensors is None else replace(given.sensors, **part("sensors"))
        blocks = {name: block.with_value(values["blocks", name]) for name, block in given.blocks.items()}
        factors = tuple(replace(f, **part("factors", i)) for i, f in enumerate(given.factors))  # type: ignore[type-var]
        own: dict[str, Any] = part("given")
        return replace(given, **own, sensors=sensors, blocks=blocks, factors=factors)

    asked = tuple(name for name in ("cost", "inliers", "covariance") if _asked(options, name))

    def run(*tensors: Tensor) -> tuple[Tensor, ...]:
        result = adjust_dense(rebuilt(tensors), options)
        plain = result.poses_cw, result.patches, result.intrinsics, *(getattr(result, name) for name in asked)
        return *plain, *result.blocks.values()

    found = composed(run, *(value(*name) for name in named))
    extra: dict[str, Any] = dict(zip(asked, found[3:], strict=False))
    further = dict(zip(given.blocks, found[3 + len(asked) :], strict=True))
    poses_cw, patches, intrinsics = found[:3]
    return replace(BAResult(poses_cw, patches, intrinsics, blocks=further), **extra)


def _asked(options: BAOptions, name: str) -> bool:
    return options.covariance is not None if name == "covariance" else options.report


def make_problem(given: PatchProblem, options: BAOptions = _DEFAULT, *, grouped: bool = True) -> Problem:
    """State blocks and factors of a batch, the reprojection first. They are not checked; half precision is float32.

    Args:
        given: the batch.
        options: what moves and what counts.
        grouped: use the fast reprojection where it applies: one camera with given intrinsics. False: the generic one,
            with the intrinsics as a state block.

    Returns:
        The least-squares problem.
    """
    wide = _computed(given.poses_cw.dtype)
    exact = any(block.value.dtype == torch.float64 for block in given.blocks.values())
    mixed = exact and given.targets.dtype != torch.float64
    wide, dtype = (torch.float64, torch.float32 if mixed else torch.float64) if exact else (wide, wide)
    poses_cw = given.poses_cw
    names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
    given = given.with_values(**{name: _cast(getattr(given, name), dtype) for name in names})
    poses = pose_block(given.poses_cw, options.fixed, held=options.structure_only)
    depths = inverse_depth_block(given.inverse_depths, options.depth_range, held=options.motion_only)
    further = {name: block.with_value(block.value.to(wide)) for name, block in given.blocks.items()}
    own = {POSES: poses, INVERSE_DEPTHS: depths}
    refine = options.refine_intrinsics
    more = [factor.with_tensors([x.to(wide) for x in factor.tensors()]) for factor in given.factors]
    measured = given.centres, given.intrinsics, given.targets, given.weights
    gate: dict[str, Any] = dict(max_residual=options.max_residual, bounds=options.bounds, kernel=options.kernel)
    reprojection: Factor | None = None
    fast = grouped and given.sensors is None and refine == "none"
    others = [*(block.value for block in further.values()), *(x for factor in more for x in factor.tensors())]
    if mixed and not torch.is_grad_enabled():
        others = []
    if fast and use_kernels(poses.value, depths.value, *measured, *others, adjoint=not (more or further)):
        reprojection = measured_edges(*measured, given.ii, given.jj, given.kk, **gate)
    if reprojection is not None:
        pass
    elif fast:
        plan = given.plan
        if plan is None:
            frames, count = given.poses_cw.shape[1], given.patches.shape[1]
            plan = plan_edges(given.ii, given.jj, given.kk, frames, count)
        reprojection = group_measurements(*measured, plan, poses, **gate)
    else:
        own = {INTRINSICS: intrinsics_block(given.intrinsics, refine, shared=given.sensors is None), **own}
        focal_only = refine == "focal"
        reprojection = given.reprojection(options.max_residual, options.bounds, options.kernel, focal_only)
    if mixed:
        own = {name: block.with_value(block.value.double()) for name, block in own.items()}
        own[POSES] = poses.with_value(se3.normalise(poses_cw.double()))
        reprojection = SinglePrecision(reprojection)
    return Problem(State({**further, **own}), (reprojection, *more))


def _computed(dtype: torch.dtype) -> torch.dtype:
    return torch.float32 if dtype in (torch.float16, torch.bfloat16) else dtype


def _cast(x: Tensor, dtype: torch.dtype) -> Tensor:
    """Another type; of the gradient, what is too large for the type of the argument is left out."""
    there = x.to(dtype)
    if there is not x and there.requires_grad:
        largest = torch.finfo(x.dtype).max
        there.register_hook(lambda g: None if g is None else torch.where(g.abs() > largest, 0.0, g))
    return there


@torch.no_grad()
def _report(problem: Problem) -> tuple[Tensor, Tensor]:
    """Cost ``(B,)`` and inliers ``(B, E)`` of a problem whose first factor is the generic reprojection."""
    values = problem.state.values()
    linear = [factor.linearise(values) for factor in problem.factors]
    return torch.stack([x.cost() for x in linear]).sum(0), (linear[0].weight > 0).any(-1)
