"""Marginalisation: both forms, the same steps as without it, and the null space of a window with a prior."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dvo.ba.blocks import IMU_BIAS, INVERSE_DEPTHS, LOG_SCALE, POSES, VELOCITY, inertial_blocks, sim3_block
from dvo.ba.factors import PosePrior, RelativePose, VectorPrior
from dvo.ba.layer.layer import make_problem
from dvo.ba.layer.step import normal_equations
from dvo.ba.marginal import FirstEstimates, LinearPrior, marginalise
from dvo.ba.options import BADamping, BAOptions
from dvo.ba.problem import Factor, Problem, State
from dvo.ba.solve import solve
from dvo.core.errors import DvoError
from dvo.geometry import se3, sim3, so3
from tests.support.inertial_motion import InertialWindow, disturbed, inertial_window
from tests.support.jacobians import assert_jacobians

F64 = torch.float64
OLD = {POSES: torch.tensor([0]), VELOCITY: torch.tensor([0]), IMU_BIAS: torch.tensor([0])}


def intervals(factor: Factor, which: list[int]) -> Factor:
    """Some intervals of a factor."""
    at = torch.tensor(which)
    parameters = dict(zip(factor._parameters(), factor.tensors(), strict=True))
    chosen = {name: x.index_select(1, at) for name, x in parameters.items() if name not in ("gravity", "extrinsics")}
    return replace(factor, **chosen, ii=factor.ii[at], jj=factor.jj[at])  # type: ignore


def parts(window: InertialWindow, free: bool = False) -> tuple[State, list[Factor], list[Factor]]:
    """A window beside the truth; factors of frame 0 and of its patches, and those that touch neither.

    ``free``: the scale is known, and nothing holds position and yaw.
    """
    p = window.problem
    p = p.with_values(poses_cw=disturbed(p.poses_cw, 0.01, fixed=0), inverse_depths=p.inverse_depths * 1.02)
    scale = None if free else torch.tensor([0.1], dtype=F64)
    blocks = inertial_blocks(window.velocity + 0.02, window.biases, log_scale=scale)
    p, options = replace(p, blocks=blocks), BAOptions(fixed=0)

    def reprojection(which: Tensor) -> Factor:
        return make_problem(p.edges(which), options, grouped=False).factors[0]

    priors: list[Factor] = [VectorPrior(IMU_BIAS, torch.zeros(6, dtype=F64), torch.full((1, 1, 6), 1e3, dtype=F64),
                                        torch.tensor([0]))]  # fmt: skip
    if not free:
        priors.append(PosePrior(window.problem.poses_cw[:, :1], torch.full((6,), 1e4, dtype=F64), torch.tensor([0])))
        priors.append(VectorPrior(LOG_SCALE, torch.zeros(1, dtype=F64), torch.full((1,), 1e2, dtype=F64)))
    rest = list(range(1, len(window.factor.ii)))
    leave = [reprojection(p.ii == 0), intervals(window.factor, [0]), intervals(window.walk, [0]), *priors]
    stay = [reprojection((p.ii > 0) & (p.jj > 0)), intervals(window.factor, rest), intervals(window.walk, rest)]
    return make_problem(p, options, grouped=False).state, leave, stay


def step_of(state: State, factors: list[Factor]) -> Tensor:
    """Undamped step of the reduced unknowns."""
    found, _ = normal_equations(Problem(state, tuple(factors)), 0.0)
    used = found.h_ll[0] > 0
    h_pl, h_ll = found.h_pl[0][:, used], found.h_ll[0][used]
    hessian = found.h_pp[0] - (h_pl / h_ll) @ h_pl.T
    gradient = found.g_p[0] - h_pl @ (found.g_l[0][used] / h_ll)
    size = hessian.diagonal().sqrt()
    moves = size > 0
    solution = torch.zeros_like(gradient)
    scaled = hessian[moves][:, moves] / size[moves] / size[moves, None]
    solution[moves] = torch.linalg.solve(scaled, gradient[moves] / size[moves]) / size[moves]
    return solution


@pytest.mark.parametrize("form", ["root", "schur"])
def test_the_other_states_take_the_same_step(form: str) -> None:
    state, leave, stay = parts(inertial_window(3, 4, 4))
    expected = step_of(state, leave + stay)
    prior = marginalise(Problem(state, tuple(leave)), OLD, form)  # type: ignore[arg-type]
    names = {(name, int(e)) for name, e in zip(prior.blocks, prior.elements, strict=True)}
    assert (POSES, 0) not in names and {(POSES, 1), (POSES, 3), (VELOCITY, 1), (IMU_BIAS, 1), (LOG_SCALE, 0)} <= names
    assert (VELOCITY, 2) not in names and INVERSE_DEPTHS not in prior.blocks
    found = step_of(state, [prior, *stay])
    remain = torch.ones(state.size, dtype=torch.bool)
    for name, element in OLD.items():
        remain[state.rows(name, element)] = False
    size = expected[remain].abs().clamp(min=1e-4)
    error = ((found - expected)[remain] / size).abs().max()
    assert float(error) < (1e-6 if form == "root" else 1e-3)


def test_the_root_form_is_that_of_the_normal_equations() -> None:
    state, leave, _ = parts(inertial_window(4, 4, 4))
    root, schur = (marginalise(Problem(state, tuple(leave)), OLD, form) for form in ("root", "schur"))  # type: ignore
    assert root.blocks == schur.blocks and torch.equal(root.first, schur.first)
    hessians = [(x.jacobian.mT @ x.jacobian)[0] for x in (root, schur)]
    gradients = [(x.jacobian.mT @ x.residual[..., None])[0, :, 0] for x in (root, schur)]
    size = hessians[0].diagonal().sqrt()
    torch.testing.assert_close(
        hessians[1] / size / size[:, None], hessians[0] / size / size[:, None], atol=1e-6, rtol=0
    )
    scaled = [g / size for g in gradients]
    torch.testing.assert_close(*scaled, atol=1e-5 * float(scaled[0].abs().max()), rtol=0)


def test_jacobian_at_the_first_estimates_and_residual_elsewhere() -> None:
    state, leave, _ = parts(inertial_window(5, 3, 2))
    prior = marginalise(Problem(state, tuple(leave)), OLD)
    small = replace(prior, residual=prior.residual / 1e3, jacobian=prior.jacobian / 1e3)
    assert_jacobians(small, state, 1e-6)
    g = torch.Generator().manual_seed(0)
    step = 0.1 * torch.randn(1, state.size, generator=g, dtype=F64)
    moved = state.moved(step, torch.zeros_like(state[INVERSE_DEPTHS].value))
    now, then = prior.linearise(moved.values()), prior.linearise(state.values())
    columns = torch.cat([state.rows(n, e[None])[0] for n, e in zip(prior.blocks, prior.elements, strict=True)])
    expected = prior.residual - (prior.jacobian @ step[:, columns, None])[..., 0]
    torch.testing.assert_close(now.residual[:, 0], expected, atol=1e-6 * float(expected.abs().max()), rtol=0)
    assert all(torch.equal(a, b) for a, b in zip(now.jacobians, then.jacobians, strict=True))
    back = prior.first_estimates(moved.values())
    torch.testing.assert_close(back[POSES][:, 1:], state[POSES].value[:, 1:])
    assert torch.equal(back[VELOCITY][:, 2], moved[VELOCITY].value[:, 2])


def null_vectors(values: dict[str, Tensor], state: State, down: Tensor) -> Tensor:
    """``(P, 4)`` steps of all states when the world is shifted, or turned about gravity."""
    out = torch.zeros(state.size, 4, dtype=F64)
    axis = down[0] / down.norm()
    motions = torch.eye(6, 4, dtype=F64)
    motions[3:, 3] = axis
    for k in range(values[POSES].shape[1]):
        out[state.rows(POSES, torch.tensor([k]))[0]] = -se3.adjoint(values[POSES][0, k]) @ motions
        out[state.rows(VELOCITY, torch.tensor([k]))[0], 3] = so3.cross(axis, values[VELOCITY][0, k])
    return out


def test_first_estimates_keep_position_and_yaw_free() -> None:
    window = inertial_window(6, 4, 4)
    state, leave, stay = parts(window, free=True)
    prior = marginalise(Problem(state, tuple(leave)), OLD)
    g = torch.Generator().manual_seed(1)
    moved = state.moved(0.05 * torch.randn(1, state.size, generator=g, dtype=F64), 0 * state[INVERSE_DEPTHS].value)
    held = [prior, *(FirstEstimates(factor, prior) for factor in stay)]
    curvature = {}
    for name, factors, values in (("first", held, prior.first_estimates(moved.values())),
                                  ("present", [prior, *stay], moved.values())):  # fmt: skip
        found, _ = normal_equations(Problem(moved, tuple(factors)), 0.0)
        n = null_vectors(values, state, window.gravity)
        n[torch.cat([state.rows(key, element).flatten() for key, element in OLD.items()])] = 0  # frame 0 is gone
        curvature[name] = (n.T @ found.h_pp[0] @ n).diagonal()
    assert float(curvature["first"].max()) < 1e-10 * float(curvature["present"].max())
    assert float(curvature["present"].max()) > 1


def test_numbers_of_elements_follow_the_window() -> None:
    state, leave, _ = parts(inertial_window(3, 3, 2))
    prior = marginalise(Problem(state, tuple(leave)), OLD)
    numbers = torch.tensor([-1, 0, 1])
    moved = prior.renumbered({POSES: numbers, VELOCITY: numbers, IMU_BIAS: numbers})
    expected = [int(e) - (name != LOG_SCALE) for name, e in zip(prior.blocks, prior.elements, strict=True)]
    assert moved.elements.tolist() == expected
    with pytest.raises(DvoError, match="gone"):
        moved.renumbered({POSES: numbers})


def test_a_prior_takes_part_in_the_layer_with_gradients() -> None:
    window = inertial_window(7, 3, 3)
    state, leave, _ = parts(window)
    prior = marginalise(Problem(state, tuple(leave)), OLD)
    blocks = {name: state[name] for name in (VELOCITY, IMU_BIAS, LOG_SCALE)}
    residual = (prior.residual / 10).requires_grad_()
    small = replace(prior, residual=residual, jacobian=prior.jacobian / 10)
    given = replace(window.problem, factors=(small, FirstEstimates(window.factor, small)), blocks=blocks)
    result = solve(given, BAOptions(fixed=1, iterations=2, damping=BADamping(1.0, 0.0, 1e-3)))
    gradient = torch.autograd.grad(result.blocks[VELOCITY].square().sum(), residual)[0]
    assert torch.isfinite(gradient).all() and float(gradient.abs().max()) > 0


def test_what_cannot_be_in_a_prior_is_refused() -> None:
    sims = sim3.exp(torch.zeros(1, 2, 7, dtype=F64))
    factor = RelativePose(sims[:, :1], torch.ones(1, 1, 7, dtype=F64), torch.tensor([0]), torch.tensor([1]), block="s")
    problem = Problem(State({"s": sim3_block(sims, 0)}), (factor,))
    with pytest.raises(DvoError, match="cannot be in a prior"):
        marginalise(problem, {"s": torch.tensor([0])})
    with pytest.raises(DvoError, match="is 'other'"):
        marginalise(problem, {}, "other")  # type: ignore[arg-type]
    nothing = marginalise(problem, {"s": torch.tensor([0, 1])})
    assert isinstance(nothing, LinearPrior) and nothing.blocks == ()
    assert normal_equations(Problem(problem.state, (factor, nothing)), 0.0)[0].g_p.shape == (1, 14)
