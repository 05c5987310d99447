"""The door to bundle adjustment: a problem and options in, values out."""

from __future__ import annotations

from dataclasses import replace
from typing import overload

from dvo.ba.layer.layer import adjust_dense
from dvo.ba.options import BAOptions, BAResult
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.sparse.global_adjust import GlobalBAOptions, GlobalBAResult, adjust_sparse


@overload
def solve(problem: PatchProblem, options: BAOptions) -> BAResult: ...
@overload
def solve(problem: PatchProblem, options: GlobalBAOptions) -> GlobalBAResult: ...


def solve(problem: PatchProblem, options: BAOptions | GlobalBAOptions) -> BAResult | GlobalBAResult:
    """Solve a problem; its state blocks and factors may be any.

    Args:
        problem: for a dense solution a batch, or one graph; for a sparse one one graph.
        options: :class:`dvo.ba.options.BAOptions` for dense Gauss-Newton steps, differentiable from end to end;
            :class:`dvo.ba.sparse.global_adjust.GlobalBAOptions` for Levenberg-Marquardt with block-sparse equations,
            robust costs and acceptance of steps, without gradients.

    Returns:
        New values, with the shapes of the problem.

    Raises:
        DvoError: see :func:`dvo.ba.layer.layer.bundle_adjust` and
            :func:`dvo.ba.sparse.global_adjust.global_bundle_adjust`.

    Example:
        >>> result = solve(problem, GlobalBAOptions(fixed=1))
        >>> problem = problem.with_values(poses_cw=result.poses_cw, patches=result.patches)
    """
    if isinstance(options, GlobalBAOptions):
        return adjust_sparse(problem, options)
    if options.sensors is not None:
        problem = replace(problem, sensors=options.sensors)
    result = adjust_dense(problem.batched(), options)
    if problem.poses_cw.dim() == 3:
        return result
    cost, inliers, covariance = (x if x is None else x[0] for x in (result.cost, result.inliers, result.covariance))
    values = result.poses_cw[0], result.patches[0], result.intrinsics[0]
    return BAResult(*values, cost, inliers, covariance, result.blocks)
