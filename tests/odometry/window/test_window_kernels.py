"""Support of a pose and flow of a frame pair: the kernels give the values of their twins."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dvo.core.kernels import VARIABLE
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.map.window import Keyframe, Window
from dvo.odometry.window import pose_validation
from dvo.odometry.window.pose_validation import flow_magnitude, support_of

M, N = 6, 4


def window(seed: int, edges: int, masked: bool, bad: float | None) -> Window:
    """Measurements of about a pixel, a quarter of them confident to a tenth or less."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    w = Window.empty(M, 3, 2, torch.device("cpu"))
    for n in range(N):
        intrinsics = torch.tensor([40.0, 42, 20, 15]) + rand(4)
        frame = Keyframe(
            n, 0.1 * n, n, torch.zeros(M, 2, 3, 3), torch.zeros(M, 2), torch.zeros(M, 3).byte(), intrinsics
        )
        if masked and n == 1:
            frame.visible = torch.ones(30, 40, dtype=torch.bool)
        patches = (torch.cat((40 * rand(M, 2), 1.5 * rand(M, 1)), 1)[..., None, None] + torch.zeros(3, 3)).contiguous()
        pose = se3.exp((0.1 if seed % 3 else 1.0) * (rand(6) - 0.5))
        w.insert(n, frame, pose, patches)
    kk, jj = (torch.randint(high, (edges,), generator=generator) for high in (M * N, N))
    w.connect(kk, jj)
    seen = reproject(w.poses_cw[None], w.patches[None], w.intrinsics[None], w.ii, w.jj, w.kk).coords[0, :, 1, 1]
    w.targets = seen + rand(edges, 2) - 0.5
    w.confidence = (rand(edges, 2) - 0.2).clamp(min=0)
    w.confidence[::3] = 0
    if bad is not None and edges:
        (w.targets if seed % 2 else w.confidence)[edges // 2, 0] = bad
    return w


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 10_000), st.sampled_from([0, 1, 8, 60]), st.booleans(),
    st.sampled_from([None, None, math.nan, math.inf]),
)  # fmt: skip
def test_values_are_those_of_the_twins(
    monkeypatch: pytest.MonkeyPatch, seed: int, edges: int, masked: bool, bad: float | None
) -> None:
    w = window(seed, edges, masked, bad)
    for position in range(N):
        found = []
        for choice in ("numba", "torch"):
            monkeypatch.setenv(VARIABLE, choice)
            other = (position + 1) % N
            s = support_of(w, position)
            found.append([s.confidence, s.inliers, flow_magnitude(w, position, other)])
        assert found[0] == pytest.approx(found[1], rel=2e-5, abs=1e-5, nan_ok=True)


def test_the_kernel_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(pose_validation, "measured", None)  # the twin would call it
    assert support_of(window(1, 60, True, None), 2).inliers > 0


def test_an_index_out_of_range_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    w = window(1, 60, False, None)
    w.jj[:], w.kk[:] = N - 1, -1
    with pytest.raises((IndexError, RuntimeError)):
        support_of(w, N - 1)
