"""Alignment: recovers what was applied, agrees with evo, and survives points that determine less than a similarity."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry import sim3
from dvo.geometry.alignment import align


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@settings(max_examples=30)
@given(st.lists(st.floats(-3, 3), min_size=7, max_size=7), st.integers(4, 30))
def test_recovers_a_similarity(xi: list[float], count: int) -> None:
    truth = sim3.exp(torch.tensor(xi, dtype=torch.float64))
    points = cloud(count)
    moved = sim3.act(truth, points)
    found = align(points, moved, "sim3")
    torch.testing.assert_close(sim3.act(found, points), moved, atol=1e-8, rtol=1e-8)
    torch.testing.assert_close(found[7], truth[7], rtol=1e-9, atol=0)


def test_modes_do_only_what_they_say() -> None:
    points = cloud(20)
    truth = sim3.exp(torch.tensor([1.0, 2, 3, 0.4, 0.5, 0.6, 0.7], dtype=torch.float64))
    moved = sim3.act(truth, points)
    torch.testing.assert_close(align(points, moved, "none"), sim3.identity(dtype=torch.float64))
    assert align(points, moved, "se3")[7] == 1
    torch.testing.assert_close(align(points, 2.5 * points, "scale"), sim3.from_se3(torch.eye(7)[6].double(), 2.5))
    torch.testing.assert_close(align(points, moved, "scale")[:7], sim3.identity(dtype=torch.float64)[:7])


def test_never_a_reflection() -> None:
    points = cloud(20)
    found = align(points, points * torch.tensor([1.0, 1, -1], dtype=torch.float64))
    assert torch.det(sim3.matrix(found)[:3, :3]) > 0


def test_noise_is_averaged_and_the_result_is_a_minimum() -> None:
    points, noise = cloud(50), 0.1 * cloud(50, 1)
    target = sim3.act(sim3.exp(torch.full((7,), 0.3, dtype=torch.float64)), points) + noise
    found = align(points, target)
    best = (sim3.act(found, points) - target).square().sum()
    for step in torch.cat((torch.eye(7), -torch.eye(7))).double() * 1e-3:
        assert (sim3.act(sim3.retract(found, step), points) - target).square().sum() > best


@pytest.mark.parametrize("mode", ["se3", "sim3"])
def test_agrees_with_evo(mode: str) -> None:
    geometry = pytest.importorskip("evo.core.geometry")
    points, target = cloud(30), cloud(30, 2) + 2 * cloud(30)
    r, t, c = geometry.umeyama_alignment(points.numpy().T, target.numpy().T, mode == "sim3")
    found = align(points.numpy(), target.numpy(), mode)
    np.testing.assert_allclose(sim3.matrix(found)[:3, :3], c * r, atol=1e-9)
    np.testing.assert_allclose(found[:3], t, atol=1e-9)


@pytest.mark.parametrize("mode", ["none", "scale", "se3", "sim3"])
@pytest.mark.parametrize("kind", ["one", "still", "other still", "two", "line", "opposite line", "plane"])
def test_degenerate_points(mode: str, kind: str) -> None:
    points = cloud(10)
    line = torch.linspace(0, 1, 10, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2, 3], dtype=torch.float64)
    source, target = {
        "one": (points[:1], points[1:2]),
        "still": (points[:1].repeat(10, 1), points),
        "other still": (points, points[:1].repeat(10, 1)),
        "two": (points[:2], points[2:4]),
        "line": (line, 2 * line.flip(-1) + 1),
        "opposite line": (line, -line),
        "plane": (points * torch.tensor([1.0, 1, 0], dtype=torch.float64), points),
    }[kind]
    found = align(source, target, mode)
    assert torch.isfinite(found).all() and found[7] > 0
    torch.testing.assert_close(found[3:7].norm(), torch.ones((), dtype=torch.float64))
    if kind in ("line", "opposite line") and mode == "sim3":
        torch.testing.assert_close(sim3.act(found, source), target)


def test_straight_lines_are_not_rolled() -> None:
    """A rolled rotation would fit as well, but turns every camera upside down."""
    line = torch.linspace(0, 1, 10, dtype=torch.float64)[:, None] * torch.tensor([0.0, 0, 1], dtype=torch.float64)
    found = align(line, 3 * line)
    torch.testing.assert_close(found[3:7].abs(), torch.tensor([0.0, 0, 0, 1], dtype=torch.float64))


@pytest.mark.parametrize(
    ("source", "target", "mode"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), "sim3"),
        (np.zeros((3, 3)), np.zeros((4, 3)), "sim3"),
        (np.zeros((3, 2)), np.zeros((3, 2)), "sim3"),
        (np.full((3, 3), np.nan), np.zeros((3, 3)), "sim3"),
        (np.zeros((3, 3)), np.zeros((3, 3)), "affine"),
    ],
)
def test_bad_input(source: np.ndarray, target: np.ndarray, mode: str) -> None:
    with pytest.raises(DvoError):
        align(source, target, mode)
