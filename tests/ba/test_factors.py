"""Jacobians of every factor against autograd, and the fast reprojection against its generic twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dvo.ba.blocks import INVERSE_DEPTHS, POSES, inverse_depth_block, pose_block, sim3_block
from dvo.ba.factors import DepthDamping, DepthPrior, PosePrior, RelativePose
from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BAOptions, Sensors, make_problem
from dvo.ba.layer.linearisation import adjoint_term, assemble
from dvo.ba.layer.step import gauss_newton
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import AdjointConstants, Problem, State
from dvo.core.errors import DvoError
from dvo.geometry import se3, sim3
from tests.support.jacobians import assert_jacobians, generator_of

F64 = torch.float64
Maker = Callable[..., Any]
seeds = st.integers(0, 2**32 - 1)


def poses(seed: int, count: int = 4, size: float = 1.0) -> Tensor:
    return se3.exp(size * generator_of(seed)(1, count, 6))


@pytest.mark.long
@settings(max_examples=10, deadline=None)
@given(seeds, st.sampled_from([1e-6, 0.1, 0.8]))
def test_jacobians_of_priors_and_relative_poses(seed: int, size: float) -> None:
    randn = generator_of(seed)
    start = poses(seed)
    ii, jj = torch.tensor([0, 1, 3, 2]), torch.tensor([1, 3, 2, 2])
    state = make_state(start, randn(1, 5).exp())
    near = se3.retract(start, size * randn(1, 4, 6))
    some = torch.tensor([3, 1])
    motion = se3.relative(start[:, ii], start[:, jj])
    measured = se3.retract(motion, size * randn(1, 4, 6))
    for factor in (
        DepthPrior(randn(1, 5), randn(1, 5).exp()),
        DepthPrior(randn(2), torch.tensor(2.0, dtype=F64), some),
        DepthPrior(randn(1, 5), randn(1, 5).exp(), kernel=Kernel("cauchy", 0.5)),
        PosePrior(near, randn(1, 4, 6).exp()),
        PosePrior(near[:, some], torch.ones(6, dtype=F64), some),
        RelativePose(measured, torch.ones(1, 4, 6, dtype=F64), ii, jj),
        RelativePose(measured, randn(1, 4, 6).exp(), ii, jj, Kernel("huber", 0.1)),
    ):
        assert_jacobians(factor, state)


@settings(max_examples=8, deadline=None)
@given(seeds, st.sampled_from([1e-6, 0.1, 0.6]))
def test_jacobian_of_relative_similarities(seed: int, size: float) -> None:
    randn = generator_of(seed)
    sims = sim3.exp(0.7 * randn(1, 4, 7))
    ii, jj = torch.tensor([0, 1, 3]), torch.tensor([1, 3, 2])
    motion = sim3.compose(sims[:, jj], sim3.inverse(sims[:, ii]))
    measured = sim3.retract(motion, size * randn(1, 3, 7))
    factor = RelativePose(measured, torch.ones(1, 3, 7, dtype=F64), ii, jj)
    assert_jacobians(factor, State({POSES: sim3_block(sims, 0)}))


def make_state(poses_cw: Tensor, inverse_depths: Tensor) -> State:
    depths = inverse_depth_block(inverse_depths, (-torch.inf, torch.inf))
    return State({POSES: pose_block(poses_cw, 0), INVERSE_DEPTHS: depths})


def rig(p: Any, seed: int = 3) -> tuple[Any, Sensors, Tensor]:
    """The problem with every edge between two of three sensors, edges within a frame included."""
    randn = generator_of(seed)
    count = len(p.ii)
    sensors = Sensors(torch.arange(count) % 3, (torch.arange(count) // 2) % 3, se3.exp(0.1 * randn(3, 6)))
    intrinsics = p.intrinsics[:, :3]
    own = torch.arange(count) % 4 == 0
    return replace(p, jj=torch.where(own, p.ii, p.jj)), sensors, intrinsics


@pytest.mark.parametrize("refine", ["none", "focal", "all"])
@pytest.mark.parametrize("several", [False, True])
def test_jacobians_of_reprojection(problem: Maker, refine: str, several: bool) -> None:
    p = problem(batch=1, per_frame=2, noise=0.3)
    intrinsics, sensors = p.intrinsics, None
    if several:
        p, sensors, intrinsics = rig(p)
    options = BAOptions(refine_intrinsics=refine, fixed=0, max_residual=1e9)  # type: ignore[arg-type]
    given = PatchProblem(p.poses, p.patches, intrinsics, p.targets, p.weights, p.ii, p.jj, p.kk, sensors)
    made = make_problem(given, options, grouped=False)
    assert (made.factors[0].linearise(made.state.values()).weight > 0).any(-1).float().mean() > 0.7
    assert_jacobians(made.factors[0], made.state)


MODES: list[dict[str, Any]] = [
    {},
    {"bounds": (20, 15), "max_residual": 3.0},
    {"structure_only": True},
    {"motion_only": True},
    {"fixed": torch.tensor([False, True, False, True])},
    {"kernel": Kernel("huber", 0.3)},
    {"kernel": Kernel("cauchy", 0.5), "fixed": 0},
]


@pytest.mark.parametrize("options", MODES, ids=str)
def test_grouped_reprojection_is_its_generic_twin(problem: Maker, options: dict[str, Any]) -> None:
    """Normal equations, and gradients of the adjoint by every input, with relative damping."""
    p = problem(noise=0.5)
    own = torch.arange(3)
    p = replace(p, ii=torch.cat((p.ii, own)), jj=torch.cat((p.jj, own)), kk=torch.cat((p.kk, own * 6)),
                targets=torch.cat((p.targets, p.targets[:, :3]), 1),
                weights=torch.cat((p.weights, p.weights[:, :3]), 1))  # fmt: skip
    found, lines = [], []
    for grouped in (True, False):
        leaves = p.leaves()
        made = make_problem(PatchProblem(*leaves.arguments()), BAOptions(**options), grouped=grouped)
        factor, state = made.factors[0], made.state
        equations, memo = factor.normal_equations(state)
        randn = generator_of(0)
        b, size, k = 2, state.size, 24
        s, e, c = (randn(b, size), randn(b, size, k), randn(b, k)) if size else (None, None, None)
        constants = AdjointConstants(randn(b, size), randn(b, size), randn(b, k), randn(b, k), s, e, c)
        if options.get("motion_only"):  # no steps of what is held, hence no coefficients either
            zero = torch.zeros(b, k, dtype=F64)
            constants = replace(constants, lambda_l=zero, delta_l=zero, e=torch.zeros_like(e), c=zero)
        phi = torch.stack(list(factor.phi(state, constants, memo))).sum()
        phi.backward()
        gradients = [getattr(leaves, name).grad for name in ("patches", "intrinsics", "targets", "weights")]
        tangent = torch.zeros(b, 4, 6, dtype=F64, requires_grad=True)  # poses along the manifold only
        (se3.retract(p.poses, tangent) * leaves.poses.grad).sum().backward()
        parts = [equations.h_pp, equations.h_pl, equations.h_ll, equations.g_p, equations.g_l]
        if options.get("motion_only"):
            parts = [parts[0], parts[3]]
        found.append([*parts, phi, *gradients, tangent.grad])
        lines.append(assemble(factor.linearise(state.values()), state))
        torch.testing.assert_close(adjoint_term(factor.linearise(state.values()), state, constants), phi)
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, atol=1e-7, rtol=1e-7)
    for name in ("h_pp", "h_pl", "h_ll", "g_p", "g_l"):  # its own linearisation, for generic solvers
        torch.testing.assert_close(getattr(lines[0], name), getattr(lines[1], name), atol=1e-7, rtol=1e-7)


def test_destinations_follow_the_fixed_frames_of_the_state(problem: Maker) -> None:
    made = make_problem(PatchProblem(*problem(noise=0.5).arguments()))
    other = make_problem(PatchProblem(*problem(noise=0.5).arguments()), BAOptions(fixed=2))
    found, _ = made.factors[0].normal_equations(other.state)
    expected, _ = other.factors[0].normal_equations(other.state)
    torch.testing.assert_close(found.h_pp, expected.h_pp)


def test_an_information_matrix_is_a_weight_with_correlations() -> None:
    randn = generator_of(0)
    start = poses(0)
    ii, jj = torch.tensor([0, 1]), torch.tensor([1, 2])
    measured = se3.retract(se3.relative(start[:, ii], start[:, jj]), 0.1 * randn(1, 2, 6))
    root = randn(1, 2, 6, 6)
    information = root @ root.mT + torch.eye(6, dtype=F64)
    state = make_state(start, torch.ones(1, 1, dtype=F64))
    whole = RelativePose(measured, information, ii, jj)
    plain = RelativePose(measured, torch.ones(6, dtype=F64), ii, jj).linearise(state.values())
    expected = (plain.residual[..., None, :] @ information @ plain.residual[..., None]).sum()
    torch.testing.assert_close(whole.linearise(state.values()).cost()[0], expected)
    expected = plain.jacobians[0].mT @ information @ plain.jacobians[1]
    found = whole.linearise(state.values()).jacobians
    torch.testing.assert_close(found[0].mT @ found[1], expected)
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    a = RelativePose(measured, torch.diag_embed(diagonal), ii, jj).linearise(state.values())
    b = RelativePose(measured, diagonal, ii, jj).linearise(state.values())
    torch.testing.assert_close(a.cost(), b.cost())


def test_a_loop_of_relative_poses_is_closed() -> None:
    """A ring of ten poses from exact relative motions and a disturbed start, in SE(3) and in Sim(3)."""
    randn = generator_of(1)
    ii = torch.arange(10)
    jj = (ii + 1) % 10
    damping = BAOptions().damping
    for group, dim in ((se3, 6), (sim3, 7)):
        truth = group.exp(0.5 * randn(1, 10, dim))
        measured = group.compose(truth[:, jj], group.inverse(truth[:, ii]))
        start = torch.cat((truth[:, :1], group.retract(truth, 0.1 * randn(1, 10, dim))[:, 1:]), 1)
        block = sim3_block(start) if dim == 7 else pose_block(start)
        problem = Problem(State({POSES: block}), (RelativePose(measured, torch.full((dim,), 1e4, dtype=F64), ii, jj),))
        assert problem.cost() > 1
        found = gauss_newton(problem, 8, replace(damping, relative=0.0, pose=1e-6)).state[POSES].value
        torch.testing.assert_close(group.matrix(found), group.matrix(truth), atol=1e-6, rtol=0)


def test_damping_of_each_depth(problem: Maker) -> None:
    """A strongly damped depth hardly moves; the others move as without it if the poses are held."""
    p = problem(noise=0.5)
    weight = torch.zeros(2, 24, dtype=F64)
    weight[:, ::2] = 1e12
    free = p.adjust(structure_only=True).patches
    found = p.adjust((DepthDamping(weight),), structure_only=True).patches
    torch.testing.assert_close(found[:, ::2], p.patches[:, ::2], atol=1e-6, rtol=0)
    torch.testing.assert_close(found[:, 1::2], free[:, 1::2])
    assert (free[:, ::2] - p.patches[:, ::2]).abs().max() > 1e-2


def test_kernels(problem: Maker) -> None:
    with pytest.raises(DvoError, match="kernel"):
        Kernel("tukey")  # type: ignore[arg-type]
    with pytest.raises(DvoError, match="width"):
        Kernel("huber", 0.0)
    residual, weight = torch.tensor([[0.3, 0.4], [3.0, 4.0]]), torch.full((2, 2), 4.0)
    # whitened norms 1 and 10
    torch.testing.assert_close(Kernel("huber", 2.0).weights(residual, weight, -1), torch.tensor([[1.0], [0.2]]))
    torch.testing.assert_close(Kernel("cauchy", 2.0).weights(residual, weight, -1), torch.tensor([[0.8], [1 / 26]]))
    assert Kernel().weights(residual, weight, -1) is None
    # one target in ten is wrong: the kernel finds the poses that least squares misses
    p = problem(frames=5, per_frame=12)
    targets = p.targets.clone()
    targets[:, ::10] += 20
    errors = []
    for kernel in (Kernel(), Kernel("cauchy", 0.5)):
        found = replace(p, targets=targets).adjust(kernel=kernel, iterations=15).poses_cw
        errors.append(se3.log(se3.relative(found, p.true_poses))[..., 3:].norm(dim=-1).mean())
    assert errors[1] < 0.1 * errors[0]
