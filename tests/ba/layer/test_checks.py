"""What the layer refuses, in one sentence, and what it must not take for an error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from dvo.ba.blocks import vector_block
from dvo.ba.edges import plan_edges
from dvo.ba.factors import DepthPrior, PosePrior, RelativePose
from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BADamping, BAOptions, Sensors, bundle_adjust
from dvo.core.errors import DvoError
from dvo.geometry import se3

Maker = Callable[..., Any]
F64 = torch.float64


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e15])
@pytest.mark.parametrize(("name", "at"), [("poses", (1, 2, 0)), ("poses", (0, 0, 5)), ("patches", (1, 3, 2)),
                                          ("patches", (0, 0, 0)), ("intrinsics", (0, 1, 3))])  # fmt: skip
def test_numbers_that_are_not_finite_or_too_large(problem: Maker, name: str, at: tuple[int, ...], value: float) -> None:
    p = problem(dtype=torch.float32)
    x = getattr(p, name).clone()
    x[at] = value
    with pytest.raises(DvoError, match="not finite, or larger than 1e\\+08"):
        replace(p, **{name: x}).solve()


@pytest.mark.parametrize("value", [0.0, -30.0, 1e-9])
def test_a_focal_length_that_is_not_positive(problem: Maker, value: float) -> None:
    p = problem()
    intrinsics = p.intrinsics.clone()
    intrinsics[1, 2, 1] = value
    with pytest.raises(DvoError, match="intrinsics: a focal length is below"):
        replace(p, intrinsics=intrinsics).solve()


@pytest.mark.parametrize("scale", [0.0, 0.5, 3.0])
def test_a_quaternion_that_is_no_rotation(problem: Maker, scale: float) -> None:
    p = problem()
    poses = torch.cat((p.poses[..., :3], scale * p.poses[..., 3:]), -1)
    with pytest.raises(DvoError, match="poses_cw: a quaternion is not of unit length"):
        replace(p, poses=poses).solve()
    replace(p, poses=torch.cat((p.poses[..., :3], 1.004 * p.poses[..., 3:]), -1)).solve()  # of half precision


@pytest.mark.parametrize("name", ["poses", "patches", "intrinsics", "targets", "weights"])
@pytest.mark.parametrize("dtype", [torch.int64, torch.complex64, torch.bool])
def test_numbers_that_are_not_real(problem: Maker, name: str, dtype: torch.dtype) -> None:
    p = problem()
    with pytest.raises(DvoError, match="has dtype"):
        replace(p, **{name: getattr(p, name).to(dtype)}).solve()


@pytest.mark.parametrize("name", ["ii", "jj", "kk"])
def test_indices_that_are_no_whole_numbers(problem: Maker, name: str) -> None:
    p = problem()
    for dtype in (torch.float32, torch.bool, torch.complex64):
        with pytest.raises(DvoError, match=f"{name}: has dtype"):
            replace(p, **{name: getattr(p, name).to(dtype)}).solve()
    for dtype in (torch.int32, torch.uint8):
        found = replace(p, **{name: getattr(p, name).to(dtype)}).solve()
        assert all(torch.equal(a, b) for a, b in zip(found, p.solve(), strict=True))
    for value in (None, getattr(p, name).tolist(), getattr(p, name).numpy()):
        with pytest.raises(DvoError, match="not a tensor"):
            replace(p, **{name: value}).solve()


def test_an_empty_batch_and_what_is_empty_for_good_reason(problem: Maker) -> None:
    p = problem()
    empty = {name: getattr(p, name)[:0] for name in ("poses", "patches", "intrinsics", "targets", "weights")}
    with pytest.raises(DvoError, match="without a problem"):
        replace(p, **empty).solve()
    with pytest.raises(DvoError, match="without a pixel"):
        replace(p, patches=p.patches[..., :0, :0]).solve()
    with pytest.raises(DvoError, match="patches: has shape"):
        replace(p, patches=p.patches[..., :2]).solve()
    none = torch.zeros(0, dtype=torch.long)
    alone = replace(p, patches=p.patches[:, :0], ii=none, jj=none, kk=none, targets=p.targets[:, :0],
                    weights=p.weights[:, :0])  # fmt: skip
    prior = PosePrior(p.true_poses, torch.full((2, 4, 6), 1e9, dtype=F64))
    torch.testing.assert_close(alone.adjust((prior,)).poses_cw[:, 1:], p.true_poses[:, 1:], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"fixed": 99}, "fixed"), ({"fixed": -1}, "fixed"), ({"fixed": 1.5}, "fixed"), ({"fixed": [0, 2]}, "fixed"),
        ({"fixed": [True, False]}, "fixed"), ({"fixed": torch.tensor([0, 1, 0, 1])}, "fixed"),
        ({"fixed": torch.ones(3, dtype=torch.bool)}, "fixed"), ({"fixed": True}, "fixed"), ({"fixed": None}, "fixed"),
        ({"iterations": 1.5}, "iterations"), ({"iterations": True}, "iterations"), ({"iterations": "2"}, "iterations"),
        ({"depth_range": (10.0, 0.1)}, "depth_range"), ({"depth_range": (math.nan, 1.0)}, "depth_range"),
        ({"depth_range": (-1.0, 1.0)}, "depth_range"), ({"depth_range": (0.1, math.inf)}, "depth_range"),
        ({"depth_range": 3.0}, "depth_range"), ({"depth_range": ("0", "1")}, "depth_range"),
        ({"bounds": (40,)}, "bounds"), ({"bounds": (math.nan, 30)}, "bounds"), ({"bounds": (-40, 30)}, "bounds"),
        ({"bounds": 40}, "bounds"), ({"bounds": (0, 30)}, "bounds"),
        ({"max_residual": math.nan}, "max_residual"), ({"max_residual": 0.0}, "max_residual"),
        ({"max_residual": -3.0}, "max_residual"), ({"max_residual": 1e200}, "max_residual"),
        ({"kernel": "huber"}, "kernel"), ({"kernel": None}, "kernel"), ({"damping": 0.1}, "damping"),
        ({"sensors": 3}, "sensors"), ({"covariance": 1}, "covariance"), ({"covariance": (0.5,)}, "covariance"),
        ({"sigma": math.nan}, "sigma"), ({"sigma": math.inf}, "sigma"), ({"sigma": "1"}, "sigma"),
        ({"report": "no"}, "report"), ({"structure_only": 1}, "structure_only"), ({"check": "no"}, "check"),
        ({"refine_intrinsics": ["all"]}, "refine_intrinsics"),
    ],
    ids=str,
)  # fmt: skip
def test_options_out_of_their_limits(problem: Maker, changes: dict[str, Any], field: str) -> None:
    with pytest.raises(DvoError) as error:
        problem().solve(**changes)
    assert error.value.field == field and "\n" not in str(error.value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, "1", None, True, torch.tensor(0.1)])
@pytest.mark.parametrize("name", ["pose", "relative", "depth"])
def test_damping_that_is_no_number(name: str, value: Any) -> None:
    with pytest.raises(DvoError, match=f"damping.{name}"):
        BADamping(**{name: value})


@pytest.mark.parametrize("kernel", [("huber", math.nan), ("huber", 1e-30), ("cauchy", math.inf), ("tukey", 1.0),
                                    (["huber"], 1.0), ("huber", "1")])  # fmt: skip
def test_kernels_that_are_none(kernel: Any) -> None:
    with pytest.raises(DvoError, match="kernel"):
        Kernel(*kernel)


def test_valid_options_of_other_types(problem: Maker) -> None:
    p = problem(noise=0.5)
    expected = p.solve(fixed=2)
    mask = np.array([True, True, False, False])
    for fixed in (np.int64(2), mask, list(mask), tuple(mask.tolist()), torch.from_numpy(mask)):
        assert torch.equal(p.solve(fixed=fixed)[0], expected[0])
    assert torch.equal(p.solve(fixed=2, max_residual=math.inf)[0], expected[0])
    assert torch.equal(p.solve(fixed=np.int64(2), iterations=np.int32(2), bounds=[400, 300])[0], expected[0])


def test_a_layout_of_other_edges(problem: Maker) -> None:
    p = problem(noise=0.5)
    good = plan_edges(p.ii, p.jj, p.kk, 4, 24)
    assert torch.equal(p.adjust(plan=good).poses_cw, p.adjust().poses_cw)
    turned = torch.roll(torch.arange(len(p.ii)), 1)
    bad = (
        plan_edges(p.ii, p.jj, p.kk[turned], 4, 24), plan_edges(p.ii[turned], p.jj[turned], p.kk[turned], 4, 24),
        plan_edges(p.ii[1:], p.jj[1:], p.kk[1:], 4, 24), plan_edges(p.ii, p.jj, p.kk, 5, 24), "plan",
    )  # fmt: skip
    for plan in bad:
        with pytest.raises(DvoError, match="plan"):
            p.adjust(plan=plan)


def test_sensors_that_do_not_fit(problem: Maker) -> None:
    p = problem()
    p = replace(p, intrinsics=p.intrinsics[:, :1])
    none = torch.zeros(len(p.ii), dtype=torch.long)
    body = se3.identity(1, dtype=F64)
    for sensors in (
        Sensors(none, none, 0 * body), Sensors(none, none, body * math.nan), Sensors(none.float(), none, body),
        Sensors(none, none[1:], body), Sensors(none, none, body.expand(3, 1, 7)), Sensors(none, none, body[0]),
        Sensors(none.tolist(), none, body), Sensors(none, none - 1, body),
    ):  # fmt: skip
        with pytest.raises(DvoError, match="sensors"):
            p.adjust(sensors=sensors)


def test_factors_and_blocks_that_do_not_fit(problem: Maker) -> None:
    p = problem()
    one, pair = torch.tensor(1.0), (torch.tensor([0]), torch.tensor([1]))
    for factors in (
        (DepthPrior(torch.ones(1, 1), torch.ones(1, 1), torch.tensor([77])),), (DepthPrior(torch.ones(7), one),),
        (DepthPrior(one * math.nan, one),), (DepthPrior(one, -one),), ("prior",), 3,
        (RelativePose(se3.identity(1, 1), -torch.eye(6)[None, None], *pair),),
        (RelativePose(se3.identity(1, 1), torch.ones(1, 1, 6), pair[0], pair[1] + 9),),
    ):  # fmt: skip
        with pytest.raises(DvoError, match="factors"):
            p.adjust(factors)
    speed = torch.zeros(2, 3, 3, dtype=F64)
    blocks: tuple[Any, ...] = (
        {"speed": speed}, {"poses": vector_block(speed)}, {"speed": vector_block(speed[:1])},
        {"speed": vector_block(speed * math.inf)}, {"speed": vector_block(speed.long())}, 3,
    )  # fmt: skip
    for further in blocks:
        with pytest.raises(DvoError, match="blocks"):
            bundle_adjust(*p.arguments(), blocks=further)
    with pytest.raises(DvoError, match="options"):
        bundle_adjust(*p.arguments(), {"iterations": 2})  # type: ignore[arg-type]


def test_values_are_not_looked_at_without_the_check(problem: Maker) -> None:
    p = problem()
    poses = p.poses.clone()
    poses[0, 2, 0] = math.nan
    found = replace(p, poses=poses).solve(check=False)
    assert torch.isfinite(found[1]).all()  # a pose that is none does not spoil the depths
    assert torch.isfinite(found[0][0, [0, 1, 3]]).all() and torch.isfinite(found[0][1]).all()
    assert BAOptions().check is None
