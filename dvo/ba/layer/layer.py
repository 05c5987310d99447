"""The differentiable dense bundle adjustment layer.

Unknowns are camera poses, one inverse depth per patch and, if wanted, intrinsics; measurements are the positions of
patch centres in other frames, and any further factors. Residual of an edge (i, j, k):
``r = target - project(T_j T_i^-1 backproject(patch k))``, weighted by a 2-vector. Each iteration is a damped
Gauss-Newton step without acceptance test, hence differentiable from end to end: linearise with analytic Jacobians,
eliminate the depths, solve for the poses, substitute back, retract. (Tang and Tan, "BA-Net", 2019; Teed et al., "Deep
Patch Visual Odometry", 2023.)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES, intrinsics_block, inverse_depth_block, pose_block
from dvo.ba.covariance import pose_covariance
from dvo.ba.edges import EdgePlan, check_index, plan_edges
from dvo.ba.layer.grouped import group_measurements
from dvo.ba.layer.step import gauss_newton
from dvo.ba.options import BADamping, BAOptions, BAResult, Sensors
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor, Problem, State, StateBlock
from dvo.core.errors import DvoError
from dvo.core.threads import use_threads
from dvo.geometry.precision import full_precision

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
    iterations. Neither the result nor a gradient is ever NaN for finite input: an edge whose point is not in front of
    frame j (``Z <= 0.2``), whose residual is too long, or which leaves the bounds counts for nothing in that iteration,
    and where the system cannot be solved the step is zero.

    Args:
        poses_cw: ``(B, N, 7)`` world to camera.
        patches: ``(B, K, 3, p, p)`` x, y (feature-map pixels) and inverse depth; all pixels of a patch share the one
            of its centre.
        intrinsics: ``(B, N, 4)`` fx fy cx cy in the same pixels; ``(B, S, 4)`` with several sensors.
        targets: ``(B, E, 2)`` measured positions of the patch centres, pixels of frame j.
        weights: ``(B, E, 2)`` confidence per axis (inverse variance, pixels^-2), not negative; an edge with a weight
            that is not finite does not count.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch of each edge, in any order, shared by the batch.
        options: see :class:`BAOptions`.
        factors: further measurements, for example priors (:mod:`dvo.ba.factors`).
        blocks: further unknowns that the factors concern, by name, for example velocities; see
            :func:`dvo.ba.blocks.vector_block`.
        plan: layout that :func:`dvo.ba.edges.plan_edges` made of ``ii, jj, kk``, to save doing it again for a graph
            that does not change.

    Returns:
        New poses and patches, and what the options ask for beyond.

    Raises:
        DvoError: shapes that do not belong together; an edge index out of range or a negative weight (see
            ``options.check``).

    Example:
        >>> from dvo.ba.layer.layer import BAOptions, bundle_adjust
        >>> result = bundle_adjust(poses_cw, patches, intrinsics, targets, weights, ii, jj, kk,
        ...                        BAOptions(iterations=4, bounds=(160, 120)))
        >>> loss = pose_loss(result.poses_cw, true_poses_cw)
        >>> loss.backward()
    """
    given = poses_cw, patches, intrinsics, targets, weights, ii, jj, kk
    return adjust_dense(PatchProblem(*given, options.sensors, tuple(factors), blocks or {}, plan), options)


def adjust_dense(given: PatchProblem, options: BAOptions) -> BAResult:
    """The dense solution of a batch; see :func:`bundle_adjust` and :func:`dvo.ba.solve.solve`."""
    use_threads()
    _check_shapes(given)
    if options.check or (options.check is None and given.weights.device.type == "cpu"):
        _check_values(given)
    with full_precision(given.poses_cw.device):
        problem = gauss_newton(make_problem(given, options), options.iterations, options.damping)
        state, patches = problem.state, given.patches
        poses_cw, inverse_depths = state[POSES].value, state[INVERSE_DEPTHS].value
        patches = patches.to(poses_cw.dtype)
        if not state[INVERSE_DEPTHS].held:
            row = inverse_depths[:, :, None, None, None].expand_as(patches[:, :, :1])
            patches = torch.cat((patches[:, :, :2], row), 2)
        intrinsics = state[INTRINSICS].value if INTRINSICS in state.blocks else given.intrinsics.to(poses_cw.dtype)
        cost = inliers = covariance = None
        if options.covariance is not None:
            covariance = pose_covariance(problem, options.covariance, options.damping, sigma=options.sigma)
        if options.report:
            blocks = {name: state[name] for name in given.blocks}
            now = given.with_values(poses_cw=poses_cw, patches=patches, intrinsics=intrinsics, blocks=blocks)
            cost, inliers = _report(make_problem(now, options, grouped=False))
        further = {name: state[name].value for name in given.blocks}
        return BAResult(poses_cw, patches, intrinsics, cost, inliers, covariance, further)


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
    dtype = given.poses_cw.dtype
    if dtype in (torch.float16, torch.bfloat16):
        dtype = torch.float32
    names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
    given = given.with_values(**{name: getattr(given, name).to(dtype) for name in names})
    poses = pose_block(given.poses_cw, options.fixed, held=options.structure_only)
    depths = inverse_depth_block(given.inverse_depths, options.depth_range, held=options.motion_only)
    further = {name: block.with_value(block.value.to(dtype)) for name, block in given.blocks.items()}
    own = {POSES: poses, INVERSE_DEPTHS: depths}
    refine = options.refine_intrinsics
    reprojection: Factor
    if grouped and given.sensors is None and refine == "none":
        plan = given.plan
        if plan is None:
            frames, count = given.poses_cw.shape[1], given.patches.shape[1]
            plan = plan_edges(given.ii, given.jj, given.kk, frames, count)
        reprojection = group_measurements(
            given.centres, given.intrinsics, given.targets, given.weights, plan, poses,
            max_residual=options.max_residual, bounds=options.bounds, kernel=options.kernel,
        )  # fmt: skip
    else:
        own = {INTRINSICS: intrinsics_block(given.intrinsics, refine, shared=given.sensors is None), **own}
        focal_only = refine == "focal"
        reprojection = given.reprojection(options.max_residual, options.bounds, options.kernel, focal_only)
    more = (factor.with_tensors([x.to(dtype) for x in factor.tensors()]) for factor in given.factors)
    return Problem(State({**further, **own}), (reprojection, *more))


@torch.no_grad()
def _report(problem: Problem) -> tuple[Tensor, Tensor]:
    """Cost ``(B,)`` and inliers ``(B, E)`` of a problem whose first factor is the generic reprojection."""
    values = problem.state.values()
    linear = [factor.linearise(values) for factor in problem.factors]
    return torch.stack([x.cost() for x in linear]).sum(0), (linear[0].weight > 0).any(-1)


def _check_shapes(given: PatchProblem) -> None:
    poses_cw, patches, sensors = given.poses_cw, given.patches, given.sensors
    b, n = poses_cw.shape[:2] if poses_cw.dim() == 3 else (-1, -1)
    count = len(given.ii)
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]] = {"poses_cw": (poses_cw, (b, n, 7))}
    if sensors is None:
        wanted["intrinsics"] = (given.intrinsics, (b, n, 4))
    else:
        cameras = sensors.from_body.shape[-2] if sensors.from_body.dim() > 1 else -1
        wanted["intrinsics"] = (given.intrinsics, (b, cameras, 4))
        wanted |= {"sensors.source": (sensors.source, (count,)), "sensors.target": (sensors.target, (count,))}
    wanted |= {"targets": (given.targets, (b, count, 2)), "weights": (given.weights, (b, count, 2))}
    wanted |= {name: (getattr(given, name), (count,)) for name in ("ii", "jj", "kk")}
    if patches.dim() == 5:
        wanted["patches"] = (patches, (b, patches.shape[1], 3, *patches.shape[3:]))
    else:
        wanted["patches"] = (patches, (b, -1, 3, -1, -1))
    for name, (tensor, shape) in wanted.items():
        if tensor.shape != shape:
            raise DvoError(
                f"has shape {tuple(tensor.shape)}, not {shape}", field=name, remedy="see the help of bundle_adjust"
            )


def _check_values(given: PatchProblem) -> None:
    frames, patches, cameras = given.poses_cw.shape[1], given.patches.shape[1], given.intrinsics.shape[1]
    for field, index, count in (("ii", given.ii, frames), ("jj", given.jj, frames), ("kk", given.kk, patches)):
        check_index(index, count, field)
    if given.sensors is not None:
        check_index(given.sensors.source, cameras, "sensors.source")
        check_index(given.sensors.target, cameras, "sensors.target")
    # The smallest weight is NaN if any is; only then look at each.
    weights = given.weights
    least = float(weights.detach().amin()) if weights.numel() else 0.0
    if least < 0 or (least != least and bool((weights < 0).any())):
        raise DvoError("negative", field="weights", remedy="give inverse variances, zero for an edge to leave out")
