"""One value for a bundle adjustment problem: parts of it, its robust cost, and the door that solves it."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES
from dvo.ba.factors import PosePrior
from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import bundle_adjust
from dvo.ba.options import BADamping, BAOptions, Sensors
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.errors import DvoError
from dvo.geometry import se3


def graph(problem: Callable, **changes: object) -> PatchProblem:
    """One graph, float64."""
    made = problem(batch=1, noise=0.2, **changes)
    return PatchProblem(*(x[0] for x in made.arguments()[:5]), *made.arguments()[5:])


def test_one_graph_is_solved_as_a_batch_of_one(problem: Callable):
    given, options = graph(problem), BAOptions(report=True, covariance=(1,))
    one, batch = solve(given, options), solve(given.batched(), options)
    for name in ("poses_cw", "patches", "intrinsics", "cost", "inliers", "covariance"):
        assert torch.equal(getattr(one, name)[None], getattr(batch, name)), name
    plain = bundle_adjust(*(getattr(given.batched(), n) for n in
                            ("poses_cw", "patches", "intrinsics", "targets", "weights", "ii", "jj", "kk")))  # fmt: skip
    assert torch.equal(plain.poses_cw, batch.poses_cw)


def test_frames_are_selected_with_their_patches_and_edges(problem: Callable):
    given = replace(graph(problem, frames=5, per_frame=4), identifiers=torch.arange(5) * 10)
    frames = torch.tensor([True, False, True, True, False])
    part = given.select(frames)
    assert part.identifiers.tolist() == [0, 20, 30] and len(part.patches) == 12 and len(part.ii) == 3 * 2 * 4
    kept = frames[given.ii] & frames[given.jj]
    assert torch.equal(part.targets, given.targets[kept])
    assert torch.equal(part.patches[part.kk], given.patches[given.kk[kept]])
    assert torch.equal(part.poses_cw[part.jj], given.poses_cw[given.jj[kept]])
    prior = PosePrior(given.poses_cw[None], torch.ones(1, 5, 6, dtype=torch.float64))
    with pytest.raises(DvoError, match="divided"):
        replace(given, factors=(prior,)).select(frames)
    with pytest.raises(DvoError, match="order"):
        replace(given, kk=given.kk.flip(0)).select(frames)


@pytest.mark.parametrize("name", ["none", "huber", "cauchy"])
def test_the_robust_cost_is_what_the_sparse_solution_lowers(problem: Callable, name: str):
    """Also with a camera that stands in front of all points, and outliers."""
    given, kernel = graph(problem), Kernel(name, 0.3)
    poses, targets = given.poses_cw.clone(), given.targets.clone()
    poses[2, 2] -= 50.0
    targets[::7] += 100.0
    given = given.with_values(poses_cw=poses, targets=targets)
    options = GlobalBAOptions(kernel=kernel, max_residual=40.0, solver=LMOptions(max_iterations=5))
    result = solve(given, options)
    after = given.with_values(poses_cw=result.poses_cw, patches=result.patches)
    for cost, at in ((result.initial_cost, given), (result.cost, after)):
        assert float(at.robust_cost(kernel, 40.0) * given.weights.sum()) == pytest.approx(cost, rel=1e-9)


def test_a_rig_is_solved_by_both_solvers(problem: Callable):
    given = graph(problem, frames=5, per_frame=6)
    camera = torch.arange(len(given.ii)) % 2
    from_body = se3.exp(torch.tensor([[0.0] * 6, [0.05, 0.01, 0, 0, 0.02, 0]], dtype=torch.float64))
    rig = replace(given, sensors=Sensors(torch.zeros_like(camera), camera, from_body), intrinsics=given.intrinsics[:2])
    one = rig.batched()
    values = {POSES: one.poses_cw, INVERSE_DEPTHS: one.inverse_depths, INTRINSICS: one.intrinsics}
    error = rig.reprojection(1e9, None, Kernel()).linearise(values).residual[0]
    noise = torch.randn(len(error), 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses = torch.cat([rig.poses_cw[:1], se3.retract(rig.poses_cw[1:], 0.02 * noise[:12].view(4, 6))])
    rig = rig.with_values(targets=rig.targets - error + 0.1 * noise, poses_cw=poses)
    sparse = solve(rig, GlobalBAOptions(kernel=Kernel(), solver=LMOptions(max_iterations=100, tolerance=1e-13)))
    assert sparse.converged and sparse.cost < 0.1 * sparse.initial_cost and sparse.inliers.all()
    there = rig.with_values(poses_cw=sparse.poses_cw, patches=sparse.patches)
    dense = solve(there, BAOptions(iterations=3, damping=BADamping(1e-9, 0.01, 1e-9), report=True))
    assert float(dense.cost) == pytest.approx(2 * sparse.cost, rel=1e-6)
    torch.testing.assert_close(dense.poses_cw, sparse.poses_cw, atol=1e-3, rtol=1e-3)
