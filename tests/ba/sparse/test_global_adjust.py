"""Global bundle adjustment against a dense solver and scipy; its storage grows with the edges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from dvo.ba.factors import DepthPrior, PosePrior, RelativePose
from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse import equations as sparse
from dvo.ba.sparse import schur_pattern
from dvo.ba.sparse.global_adjust import GlobalBAOptions, GlobalBAResult, SparseProblem, global_bundle_adjust
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from eval.benchmarks.global_ba import make_graph, position_error

EXACT = LMOptions(max_iterations=60, tolerance=1e-12)
PLAIN = GlobalBAOptions(kernel=Kernel("none"), solver=EXACT)


def arguments(problem: object) -> list[Tensor]:
    """Those of ``bundle_adjust`` without the batch dimension."""
    floats = [getattr(problem, name)[0] for name in ("poses", "patches", "intrinsics", "targets", "weights")]
    return floats + [getattr(problem, name) for name in ("ii", "jj", "kk")]


def weighted_residuals(poses: Tensor, depths: Tensor, given: list[Tensor]) -> Tensor:
    """``(E, 2)`` pixels times the root of the weight, computed edge by edge from the projection."""
    _, patches, intrinsics, targets, weights, ii, jj, kk = given
    patches = torch.cat((patches[:, :2], depths[:, None, None, None].expand_as(patches[:, :1])), 1)
    centre = patches.shape[-1] // 2
    seen = reproject(poses[None], patches[None], intrinsics[None], ii, jj, kk).coords[0, :, centre, centre]
    return (targets - seen) * weights.sqrt()


def least_squares(given: list[Tensor]) -> float:
    """Cost of the minimum that scipy finds, the first pose fixed."""
    from scipy.optimize import least_squares as scipy_least_squares

    poses, free = given[0], 6 * (len(given[0]) - 1)

    def residual(x: np.ndarray) -> np.ndarray:
        step = torch.from_numpy(x)
        moved = torch.cat((poses[:1], se3.retract(poses[1:], step[:free].view(-1, 6))))
        return weighted_residuals(moved, step[free:], given).flatten().numpy()

    start = np.concatenate((np.zeros(free), given[1][:, 2, 1, 1].numpy()))
    return float(scipy_least_squares(residual, start, xtol=1e-13, ftol=1e-13, gtol=1e-13, max_nfev=300).cost)


@pytest.mark.long
@pytest.mark.parametrize("solver", ["direct", "cg"])
@pytest.mark.parametrize("explicit", [True, False])
def test_the_minimum_is_that_of_scipy(problem: Callable, monkeypatch: pytest.MonkeyPatch, solver: str, explicit: bool):
    given = arguments(problem(batch=1, frames=6, per_frame=5, noise=0.3))
    monkeypatch.setattr(schur_pattern, "EXPLICIT_WORK", 1e9 if explicit else 0)
    options = replace(PLAIN, solver=replace(EXACT, solver=solver))
    result = global_bundle_adjust(*given, options=options)
    assert result.converged and result.cost < 0.1 * result.initial_cost
    assert result.cost == pytest.approx(least_squares(given), rel=1e-8)
    depths = result.patches[:, 2, 1, 1]
    again = 0.5 * float(weighted_residuals(result.poses_cw, depths, given).square().sum())
    assert result.cost == pytest.approx(again, rel=1e-12)
    assert torch.equal(result.poses_cw[0], given[0][0])
    assert bool(result.inliers.all())


@pytest.mark.parametrize("name", ["huber", "cauchy"])
def test_the_robust_result_is_a_minimum(problem: Callable, name: str):
    """The gradient of the robust cost, by autograd, vanishes at the result."""
    given = arguments(problem(batch=1, frames=5, per_frame=5, noise=0.1))
    given[3] = given[3].clone()
    given[3][::9] += torch.tensor([6.0, -4.0])
    kernel = Kernel(name, 0.5)  # type: ignore[arg-type]
    result = global_bundle_adjust(*given, options=replace(PLAIN, kernel=kernel))

    def gradient(poses: Tensor, depths: Tensor) -> tuple[float, Tensor]:
        xi = torch.zeros(4, 6, dtype=torch.float64, requires_grad=True)
        depths = depths.clone().requires_grad_()
        r = weighted_residuals(torch.cat((poses[:1], se3.retract(poses[1:], xi))), depths, given)
        cost = 0.5 * kernel.cost(r.square().sum(-1)).sum()
        return float(cost.detach()), torch.cat([x.flatten() for x in torch.autograd.grad(cost, (xi, depths))])

    _, before = gradient(given[0], given[1][:, 2, 1, 1])
    cost, after = gradient(result.poses_cw, result.patches[:, 2, 1, 1])
    assert result.cost == pytest.approx(cost, rel=1e-9)
    assert after.norm() < 1e-4 * before.norm()


@pytest.mark.parametrize("name", ["none", "huber", "cauchy"])
def test_the_weight_of_a_kernel_is_the_derivative_of_its_cost(name: str):
    s = torch.linspace(0.01, 9, 50, dtype=torch.float64, requires_grad=True)
    kernel = Kernel(name, 1.3)  # type: ignore[arg-type]
    (gradient,) = torch.autograd.grad(kernel.cost(s).sum(), s)
    torch.testing.assert_close(kernel.slope(s), gradient)


def test_the_system_is_that_of_explicit_jacobians(problem: Callable):
    """Blocks at one linearisation point against autograd, with fixed frames in the middle and a doubled edge."""
    made = problem(batch=1, frames=5, per_frame=3, noise=0.3)
    made = made.edges(torch.cat((torch.arange(len(made.ii)), torch.tensor([3, 7]))))
    given = arguments(made)
    fixed = torch.tensor([True, False, True, False, False])
    equations = SparseProblem(PatchProblem(*given), replace(PLAIN, fixed=fixed))
    system = equations.linearise(equations.state)
    free = torch.nonzero(~fixed)[:, 0]

    def residual(xi: Tensor, depths: Tensor) -> Tensor:
        step = torch.zeros(5, 6, dtype=torch.float64).index_copy(0, free, xi)
        return weighted_residuals(se3.retract(given[0], step), depths, given).flatten()

    at = torch.zeros(3, 6, dtype=torch.float64), given[1][:, 2, 1, 1]
    by_pose, by_depth = torch.autograd.functional.jacobian(residual, at)
    j = torch.cat((by_pose.flatten(1), by_depth), 1)
    r = residual(*at)
    h, g = j.mT @ j, -j.mT @ r
    n = 18
    torch.testing.assert_close(sparse.BlockMatrix(system.pattern.h_pp, system.h_pp).dense(), h[:n, :n])
    h_pl = torch.zeros(3, 15, 6, dtype=torch.float64)
    h_pl[system.pattern.frame, system.pattern.patch] = system.h_pl
    torch.testing.assert_close(h_pl.transpose(1, 2).reshape(n, 15), h[:n, n:])
    torch.testing.assert_close(torch.diag_embed(system.h_ll), h[n:, n:])
    torch.testing.assert_close(torch.cat((system.g_p.flatten(), system.g_l)), g)
    (dp, dl), predicted = system.step(0.0, LMOptions(solver="direct"))
    expected = torch.linalg.solve(h, g)
    torch.testing.assert_close(torch.cat((dp.flatten(), dl)), expected, rtol=1e-6, atol=1e-9)
    assert predicted == pytest.approx(0.5 * float(g @ expected), rel=1e-9)


def test_storage_grows_with_edges():
    """Stored blocks are the observations plus the pairs of frames that share an edge, whatever the graph's length."""
    few = LMOptions(max_iterations=1)
    per_edge = []
    for frames in (40, 80, 160):
        graph, _ = make_graph(frames, per_frame=12, reach=4, loop_reach=1)
        result = solve(graph, GlobalBAOptions(solver=few))
        seen = torch.stack((torch.cat((graph.ii, graph.jj)), torch.cat((graph.kk, graph.kk))))
        observations = torch.unique(seen[:, seen[0] > 0], dim=1).shape[1]
        pair = torch.stack((torch.minimum(graph.ii, graph.jj), torch.maximum(graph.ii, graph.jj)))
        pairs = torch.unique(pair[:, pair[0] > 0], dim=1).shape[1] + frames - 1
        assert result.stored_blocks == observations + pairs
        per_edge.append(result.stored_blocks / len(graph.ii))
        assert result.stored_blocks < 0.5 * frames * len(graph.patches)
    assert per_edge[2] < 1.05 * per_edge[0]


def test_the_reduced_system_stays_sparse():
    """Twice the frames give about twice the blocks of S and of its Cholesky factor."""
    counts, factors = [], []
    for frames in (200, 400):
        around = torch.arange(-6, 7)
        jj = (torch.arange(frames)[:, None] + around).flatten()
        patch = torch.arange(frames).repeat_interleave(len(around))
        jj, patch = jj[(jj >= 0) & (jj < frames)], patch[(jj >= 0) & (jj < frames)]
        pattern = schur_pattern.make_schur_pattern(frames, torch.arange(frames), jj, patch, jj, patch)
        assert pattern.explicit
        counts.append(pattern.reduced.count)
        factors.append(pattern.reduced.cholesky_plan(6).numbers(6))
    assert counts == [sum(min(f, 12) + 1 for f in range(n)) for n in (200, 400)]
    assert factors[1] < 2.5 * factors[0]


def solve_loop(**changes: object) -> tuple[GlobalBAResult, list[float]]:
    dtype = changes.pop("dtype", torch.float64)
    graph, true_poses_cw = make_graph(100, per_frame=16, reach=8, loop_reach=2, noise=0.1, wrong=0.02, dtype=dtype)
    options = GlobalBAOptions(kernel=Kernel("huber", 1.0), solver=LMOptions(max_iterations=15, tolerance=1e-5))
    result = solve(graph, replace(options, **changes))
    return result, [position_error(x, true_poses_cw) for x in (graph.poses_cw, result.poses_cw)]


@pytest.mark.long
def test_two_laps_with_drift_and_wrong_targets_come_back():
    result, (before, after) = solve_loop()
    assert result.converged and after < 0.4 * before
    single, (_, error) = solve_loop(dtype=torch.float32)
    assert single.poses_cw.dtype == torch.float32
    assert error == pytest.approx(after, rel=0.2)


def test_what_is_held_stays(problem: Callable):
    given = arguments(problem(batch=1, noise=0.3))
    motion = global_bundle_adjust(*given, options=replace(PLAIN, move_depths=False))
    assert torch.equal(motion.patches, given[1]) and not torch.equal(motion.poses_cw, given[0])
    structure = global_bundle_adjust(*given, options=replace(PLAIN, move_poses=False))
    assert torch.equal(structure.poses_cw, given[0]) and not torch.equal(structure.patches, given[1])
    for result in (motion, structure):
        assert result.cost < result.initial_cost


def test_further_factors_take_part(problem: Callable):
    """Priors on poses and depths, and a relative pose, that all agree with another scale, move the result there."""
    made = problem(batch=1, frames=4, per_frame=6)
    given = arguments(made)
    true = made.true_poses.clone()
    true[..., :3] *= 1.3  # about the origin of the world
    true[:, 0, :3] = made.true_poses[:, 0, :3]  # the fixed first pose
    centres = se3.inverse(made.true_poses)[0, :, :3]
    moved = se3.inverse(made.true_poses)[0].clone()
    moved[:, :3] = centres[0] + 1.3 * (centres - centres[0])
    wanted = se3.inverse(moved)[None]
    depth = made.true_patches[:, :, 2, 1, 1] / 1.3
    relative = se3.relative(wanted[:, 1], wanted[:, 3])[:, None]
    factors = (
        PosePrior(wanted[:, 2:3], torch.full((1, 1, 6), 1e3, dtype=torch.float64), torch.tensor([2])),
        DepthPrior(depth[:, :4], torch.full((1, 4), 1e3, dtype=torch.float64), torch.arange(4)),
        RelativePose(relative, torch.full((1, 1, 6), 1e3, dtype=torch.float64), torch.tensor([1]), torch.tensor([3])),
    )
    result = global_bundle_adjust(*given, options=PLAIN, factors=factors)
    torch.testing.assert_close(se3.inverse(result.poses_cw)[:, :3], moved[:, :3], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(result.patches[:, 2, 1, 1], depth[0], rtol=1e-4, atol=1e-5)
    assert result.cost < 1e-8


def test_a_point_behind_the_camera_is_no_way_out(problem: Callable):
    """An edge that does not count costs as much as the longest residual."""
    given = arguments(problem(batch=1, noise=0.1))
    poses = given[0].clone()
    poses[2, 2] -= 50.0  # the points lie behind this camera
    result = global_bundle_adjust(poses, *given[1:], options=replace(PLAIN, max_residual=40.0))
    lost = (given[5] != 2) & (given[6] == 2)
    assert bool(lost.any()) and result.initial_cost >= 0.5 * 40**2 * float(given[4][lost].amax(-1).sum())


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("jj", lambda a: a[:6] + [a[6] + 3] + a[7:]),
        ("ii", lambda a: a[:5] + [a[6]] + a[6:]),
        ("weights", lambda a: a[:4] + [-a[4]] + a[5:]),
        ("targets", lambda a: a[:3] + [a[3][:-1]] + a[4:]),
        ("poses_cw", lambda a: [a[0].half()] + a[1:]),
        ("ii", lambda a: a[:3] + [x[:0] for x in a[3:]]),
    ],
)
def test_bad_input_is_named(problem: Callable, field: str, change: Callable):
    with pytest.raises(DvoError) as error:
        global_bundle_adjust(*change(arguments(problem(batch=1))))
    assert error.value.field == field
