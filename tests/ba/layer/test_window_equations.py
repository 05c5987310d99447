"""The dense equations of a window against those of any graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BAOptions, make_problem
from dvo.ba.layer.step import normal_equations
from dvo.ba.layer.window_equations import window_equations
from dvo.ba.patch_problem import PatchProblem

Maker = Callable[..., Any]


@pytest.mark.parametrize("bounds", [None, (20.0, 15.0)])
@pytest.mark.parametrize("kernel", [Kernel(), Kernel("cauchy", 0.3)])
@pytest.mark.parametrize("first", [0, 2])
def test_the_sums_of_any_graph(problem: Maker, first: int, kernel: Kernel, bounds: tuple[float, float] | None) -> None:
    """With edges missing, in any order; patches of some frames only; edges of a frame into itself; gross errors."""
    p = problem(batch=1, frames=5, per_frame=6, noise=0.5)
    generator = torch.Generator().manual_seed(1)
    kk = torch.arange(30).repeat_interleave(5)
    jj = torch.arange(5).repeat(30)
    chosen = torch.randperm(150, generator=generator)[:110]
    kk, jj = kk[chosen], jj[chosen]
    kk, jj = kk[kk >= 6 * first], jj[kk >= 6 * first]
    targets = torch.rand(1, len(kk), 2, dtype=torch.float64, generator=generator) * torch.tensor([40.0, 30.0])
    exact = p.targets[0].view(30, 4, 2)
    for edge in range(0, len(kk), 2):  # every other edge near its true place, the rest anywhere
        frames = [j for j in range(5) if j != kk[edge] // 6]
        if int(jj[edge]) in frames:
            targets[0, edge] = exact[kk[edge], frames.index(int(jj[edge]))]
    weights = torch.rand(1, len(kk), 2, dtype=torch.float64, generator=generator)
    poses = p.poses.clone()
    poses[0, 4, 2] -= 3  # behind some points
    p = replace(p, poses=poses, targets=targets, weights=weights, ii=kk // 6, jj=jj, kk=kk)
    options = BAOptions(fixed=0, bounds=bounds, kernel=kernel, max_residual=25.0)
    plain, _ = normal_equations(make_problem(PatchProblem(*p.arguments()), options), 0.0)
    centre = p.patches[0, 6 * first :, :, 1, 1].unflatten(0, (-1, 6))
    found = window_equations(p.poses[0], centre[..., :2], centre[..., 2], p.intrinsics[0], targets[0], weights[0], jj,
                             kk - 6 * first, first, options)  # fmt: skip
    torch.testing.assert_close(found.h_pp, plain.h_pp, atol=1e-8, rtol=1e-8)
    torch.testing.assert_close(found.h_pl, plain.h_pl[..., 6 * first :], atol=1e-8, rtol=1e-8)
    torch.testing.assert_close(found.h_ll, plain.h_ll[..., 6 * first :], atol=1e-8, rtol=1e-8)
    assert (plain.h_pl[..., : 6 * first] == 0).all() and (found.h_pp != 0).any()
