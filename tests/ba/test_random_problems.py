"""Problems with every kind of degeneracy and type: a finite result with finite gradients, or one DvoError."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dvo.ba.blocks import vector_block
from dvo.ba.edges import plan_edges
from dvo.ba.factors import DepthDamping, DepthPrior, PosePrior, RelativePose
from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BADamping, BAOptions, Sensors, bundle_adjust
from dvo.core.errors import DvoError
from dvo.geometry import se3

FLOATS = ("poses_cw", "patches", "intrinsics", "targets", "weights")
NUMBERS = [0.0, -1.0, 1.0, 1e-30, 1e-3, 1e3, 1e7, 1e8, 1e10, 1e15, 1e30, 1e38, -1e38, math.nan, math.inf, -math.inf]
DTYPES = [torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.bool, torch.complex64]
OPTIONS: dict[str, list[Any]] = {
    "fixed": [0, 1, 2, 99, -1, 1.5, True, [True, False, True], [0, 2], torch.tensor([False, True, True]),
              torch.tensor([0, 1, 1]), torch.tensor(1), None],
    "iterations": [0, 1, 2, 4, -1, 1.5, True, "2", math.nan],
    "damping": [(0.1, 1e-4, 1e-4), (0, 0, 0), (math.nan, 0, 0), (0, -1, 0), (0, 0, math.inf), (1e20, 1e20, 1e20),
                (1e-30, 0, 1e-30), ("a", 0, 0), None],
    "structure_only": [True, "yes"],
    "motion_only": [True, 1],
    "bounds": [(40, 30), (1, 1), (0, 0), (-5, 30), (math.nan, 30), (40,), 40, "ab", (1e9, 30)],
    "max_residual": [128.0, 1e-3, math.inf, 0.0, -1.0, math.nan, 1e200, "1"],
    "depth_range": [(1e-3, 10), (0.0, 1e8), (10, 1e-3), (math.nan, 1), (0.5, 0.5), (-1, 1), (0, math.inf), 3,
                    (1, 2, 3)],
    "kernel": [("huber", 0.1), ("cauchy", 1e-12), ("cauchy", 1e12), ("huber", math.nan), ("huber", 0), ("tukey", 1),
               None],
    "refine_intrinsics": ["focal", "all", "radial", 3],
    "report": [True, 2],
    "covariance": [(1,), (), (0, 2), (7,), (-1,), 1, (0.5,), "a"],
    "sigma": [1.0, 1e-3, 0.0, math.nan, math.inf],
    "check": [None, True, "no"],
}  # fmt: skip
CHANGES = ("number", "number", "number", "row", "dtype", "shape", "index", "index dtype", "still", "scale", "kind")
EXTRAS = ("factor", "bad factor", "sensors", "block", "plan", "bad plan")


def plain(dtype: torch.dtype, batch: int, edges: int, seed: int) -> dict[str, Tensor]:
    """Three frames of two patches."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    centres = torch.cat((40 * rand(batch, 6, 1), 30 * rand(batch, 6, 1), 0.2 + rand(batch, 6, 1)), -1)
    some = torch.randperm(18, generator=generator)[:edges]
    kk, jj = some // 3, some % 3
    given = {
        "poses_cw": se3.exp(0.1 * (rand(batch, 3, 6) - 0.5)),
        "patches": centres[..., None, None].expand(-1, -1, -1, 3, 3),
        "intrinsics": torch.tensor([30.0, 32, 20, 15], dtype=torch.float64) + rand(batch, 3, 4),
        "targets": centres[:, kk, :2] + 4 * (rand(batch, edges, 2) - 0.5),
        "weights": rand(batch, edges, 2),
    }
    return {name: x.to(dtype) for name, x in given.items()} | {"ii": kk // 2, "jj": jj, "kk": kk}


def change(given: dict[str, Any], kind: str, draw: Callable[..., Any]) -> None:
    """Make a problem worse, in place."""
    name = draw(st.sampled_from(("ii", "jj", "kk") if kind.startswith("index") else FLOATS))
    x = given[name]
    if not isinstance(x, Tensor):
        return
    if kind in ("number", "row") and x.numel() and x.is_floating_point():
        x, value = x.clone(), draw(st.sampled_from(NUMBERS))
        if kind == "row":
            x[:, draw(st.integers(0, x.shape[1] - 1))] = value
        else:
            x.view(-1)[draw(st.integers(0, x.numel() - 1))] = value
    elif kind == "dtype":
        x = x.to(draw(st.sampled_from(DTYPES)))
    elif kind == "shape":
        x = draw(st.sampled_from((x[:1], x[..., :1], x[0], x[:, :1], x[None], x[:0], x[..., :0]))) if len(x) else x
    elif kind == "index" and len(x):
        x, value = x.clone(), torch.tensor(draw(st.sampled_from((-1, 0, 1, 2, 5, 6, 1000))))
        x[draw(st.integers(0, len(x) - 1))] = value.to(x.dtype)  # bytes wrap around
    elif kind == "index dtype":
        x = x.to(draw(st.sampled_from((torch.int32, torch.uint8, torch.float32, torch.bool, torch.complex64))))
    elif kind == "still":  # no parallax
        poses = given["poses_cw"]
        given["poses_cw"] = poses[:, :1].expand_as(poses) if isinstance(poses, Tensor) and poses.dim() > 1 else poses
        return
    elif kind == "scale" and x.is_floating_point():
        x = x * draw(st.sampled_from((0.0, -1.0, 1e-6, 1e3, 1e6, 1e12)))
    elif kind == "kind":
        x = draw(st.sampled_from((x.tolist(), None, x.numpy()))) if x.dtype != torch.bfloat16 else None
    given[name] = x


def options_of(changes: dict[str, Any]) -> BAOptions:
    made = dict(changes)
    if isinstance(made.get("damping"), tuple):
        made["damping"] = BADamping(*made["damping"])
    if isinstance(made.get("kernel"), tuple):
        made["kernel"] = Kernel(*made["kernel"])
    return BAOptions(**made)


def extra(kind: str, given: dict[str, Any], options: BAOptions, value: float) -> tuple[dict[str, Any], BAOptions]:
    """Further arguments."""
    like = {"dtype": torch.float64}
    if kind == "factor":
        two, three = torch.tensor([0, 1]), torch.tensor([1, 2])
        return {"factors": (
            DepthPrior(torch.full((1, 6), 0.5, **like), torch.tensor(abs(value), **like)),
            PosePrior(se3.identity(1, 3, **like), torch.full((1, 3, 6), abs(value), **like)),
            RelativePose(se3.identity(1, 2, **like), torch.ones(1, 2, 6, **like), two, three),
            DepthDamping(torch.tensor(1.0, **like)),
        )}, options  # fmt: skip
    if kind == "bad factor":
        bad = (
            DepthPrior(torch.tensor(value), torch.tensor(1.0)), DepthPrior(torch.tensor(1.0), torch.tensor(-1.0)),
            DepthPrior(torch.ones(1, 2), torch.ones(1, 2), torch.tensor([0, 77])),
            PosePrior(torch.ones(5), torch.ones(2)),
            RelativePose(se3.identity(1, 1), -torch.eye(6)[None, None], torch.tensor([0]), torch.tensor([1])), "prior",
        )  # fmt: skip
        return {"factors": (bad[int(abs(value)) % 6 if math.isfinite(value) else 0],)}, options
    if kind == "sensors":
        intrinsics, edges = given["intrinsics"], given["ii"]
        if isinstance(intrinsics, Tensor) and intrinsics.dim() > 1 and isinstance(edges, Tensor):
            given["intrinsics"] = intrinsics[:, :2]
            sensor = torch.arange(len(edges)) % 2
            options = replace(
                options, sensors=Sensors(sensor, 1 - sensor, se3.exp(torch.zeros(2, 6)) * min(value, 1.0))
            )
        return {}, options
    if kind == "block":
        name = "speed" if value < 5 else "poses"
        return {"blocks": {name: vector_block(torch.full((1, 2, 3), value))}}, options
    if isinstance(given["ii"], Tensor) and given["ii"].dtype == torch.int64:
        ii, jj, kk = (given[name] for name in ("ii", "jj", "kk"))
        good = all(isinstance(x, Tensor) and x.shape == ii.shape and x.dtype == ii.dtype for x in (jj, kk))
        if good and ii.dim() == 1 and kind == "plan":
            return {"plan": plan_edges(ii, jj, kk, 3, 6)}, options
        if good and ii.dim() == 1 and kind == "bad plan":
            return {"plan": plan_edges(ii, (jj + 1) % 3, kk, 3, 6)}, options
    return {}, options


def is_fine(draw: Callable[..., Any]) -> str:
    """Solve a random problem; what is wrong with the outcome, or nothing."""
    dtype = draw(st.sampled_from((torch.float32, torch.float32, torch.float64)))
    given = plain(
        dtype,
        draw(st.sampled_from((1, 1, 2, 2, 0))),
        draw(st.sampled_from((12, 12, 6, 1, 0))),
        draw(st.integers(0, 99)),
    )
    for kind in draw(st.lists(st.sampled_from(CHANGES), max_size=3)):
        change(given, kind, draw)
    names = draw(st.lists(st.sampled_from(sorted(OPTIONS)), max_size=3, unique=True))
    changes = {name: draw(st.sampled_from(OPTIONS[name])) for name in names}
    leaves = []
    try:
        options, more = options_of(changes), {}
        kind = draw(st.sampled_from((None, None, *EXTRAS)))
        if kind is not None:
            more, options = extra(
                kind, given, options, draw(st.sampled_from((1.0, 2.0, 3.0, 4.0, 5.0, 1e10, math.nan)))
            )
        for name in FLOATS:
            x = given[name]
            if isinstance(x, Tensor) and (x.is_floating_point() or x.is_complex()):
                given[name] = x.detach().clone().requires_grad_()
                leaves.append((name, given[name]))
        result = bundle_adjust(*given.values(), options, **more)
    except DvoError as error:
        return "" if "\n" not in str(error) else "an error of several lines"
    found = {name: getattr(result, name) for name in ("poses_cw", "patches", "intrinsics", "cost")} | dict(
        result.blocks
    )
    wrong = [name for name, x in found.items() if x is not None and not torch.isfinite(x).all()]
    if result.covariance is not None and result.covariance.isnan().any():
        wrong.append("covariance")
    outputs = [x for x in (result.poses_cw, result.patches, result.intrinsics) if x.requires_grad]
    if outputs:
        sum(x.sum() for x in outputs).backward(retain_graph=True)
    if outputs and draw(st.sampled_from((False, False, True))):
        wrong += wrong_again(sum(x.sum() for x in outputs), dict(leaves))
    wrong += [f"gradient of {name}" for name, x in leaves if x.grad is not None and not torch.isfinite(x.grad).all()]
    return ", ".join(wrong)


def wrong_again(total: Tensor, leaves: dict[str, Tensor]) -> list[str]:
    """Derivatives of first and second order that are not finite, of a graph that is recorded."""
    first = torch.autograd.grad(total, list(leaves.values()), create_graph=True, allow_unused=True)
    sums = [x.sum() for x in first if x is not None and x.requires_grad and x.sum().isfinite()]
    second = torch.autograd.grad(sums, list(leaves.values()), allow_unused=True) if sums else [None] * len(leaves)
    found = {"recorded gradient": first, "second derivative": second}
    return [
        f"{what} of {name}"
        for what, each in found.items()
        for name, x in zip(leaves, each, strict=True)
        if x is not None and not x.isfinite().all()
    ]


SETTINGS = settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None)


@pytest.mark.long
@settings(SETTINGS, max_examples=200)
@given(st.data())
def test_random_problems(data: st.DataObject) -> None:
    assert is_fine(data.draw) == ""


@pytest.mark.slow
@settings(SETTINGS, max_examples=5000)
@given(st.data())
def test_many_random_problems(data: st.DataObject) -> None:
    assert is_fine(data.draw) == ""
