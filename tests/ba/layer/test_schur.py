"""The solver alone: eliminating landmarks changes nothing, and failures stay contained."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dvo.ba.layer.schur import eliminate, factorise, solve_with

F64 = torch.float64


def system(m: int, poses: int = 12, landmarks: int = 20) -> tuple[Tensor, ...]:
    """Normal equations of random rows, each of which sees all poses but one landmark only."""
    generator = torch.Generator().manual_seed(m)
    rows = 8
    a = torch.randn(2, landmarks, rows, poses, dtype=F64, generator=generator)
    b = torch.randn(2, landmarks, rows, m, dtype=F64, generator=generator)
    r = torch.randn(2, landmarks, rows, 1, dtype=F64, generator=generator)
    h_pp, h_pl, h_ll = (a.mT @ a).sum(1), (a.mT @ b).transpose(1, 2), b.mT @ b
    return h_pp, h_pl, h_ll, (a.mT @ r)[..., 0].sum(1), (b.mT @ r)[..., 0]


@pytest.mark.parametrize("m", [1, 3])
def test_eliminating_landmarks_solves_the_whole_system(m: int) -> None:
    h_pp, h_pl, h_ll, g_p, g_l = system(m)
    dp, dl = eliminate(h_pp, h_pl, h_ll).solve(g_p, g_l)
    for b in range(2):
        e = h_pl[b].flatten(1)
        whole = torch.cat((torch.cat((h_pp[b], e), 1), torch.cat((e.T, torch.block_diag(*h_ll[b])), 1)))
        expected = torch.linalg.solve(whole, torch.cat((g_p[b], g_l[b].flatten())))
        torch.testing.assert_close(torch.cat((dp[b], dl[b].flatten())), expected)


def test_damping_enters_the_reduced_system() -> None:
    h_pp, h_pl, h_ll, g_p, g_l = system(1)
    dp, _ = eliminate(h_pp, h_pl, h_ll, absolute=3.0, relative=0.5).solve(g_p, g_l)
    e, q = h_pl[..., 0], 1 / h_ll[..., 0, 0]
    s = h_pp - (e * q[:, None]) @ e.mT
    s = s + torch.diag_embed(3.0 + 0.5 * s.diagonal(dim1=1, dim2=2))
    y = g_p - ((e * q[:, None]) @ g_l)[..., 0]
    torch.testing.assert_close(dp, torch.linalg.solve(s, y))


@pytest.mark.parametrize("m", [1, 3])
def test_a_landmark_that_nothing_sees_stays(m: int) -> None:
    h_pp, h_pl, h_ll, g_p, g_l = system(m)
    for x in (h_ll, g_l):
        x[:, 4] = 0
    h_pl[:, :, 4] = 0
    dp, dl = eliminate(h_pp, h_pl, h_ll).solve(g_p, g_l)
    assert (dl[:, 4] == 0).all() and torch.isfinite(dp).all() and (dl[:, 5] != 0).all()


def test_a_singular_system_is_damped_until_it_can_be_solved() -> None:
    s = torch.zeros(2, 4, 4, dtype=F64)
    s[0] = torch.eye(4)
    s[1, :2, :2] = torch.tensor([[2.0, -2.0], [-2.0, 2.0 - 1e-9]])  # rank one, and slightly indefinite
    y = torch.ones(2, 4, dtype=F64)
    factor, ok = factorise(s)
    x = solve_with(factor, ok, y)
    assert ok.all()
    torch.testing.assert_close(x[0], y[0])
    assert torch.isfinite(x[1]).all() and (x[1] != 0).any()


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -1e6])
def test_one_hopeless_element_does_not_harm_the_others(poison: float) -> None:
    s = torch.eye(3, dtype=F64).repeat(3, 1, 1)
    s[1, 0, 0] = poison
    s[1, 0, 1] = s[1, 1, 0] = poison
    factor, ok = factorise(s)
    x = solve_with(factor, ok, torch.ones(3, 3, dtype=F64))
    assert ok.tolist() == [True, False, True]
    assert torch.equal(x, torch.tensor([[1.0] * 3, [0.0] * 3, [1.0] * 3], dtype=F64))
