"""What is computed on an accelerator agrees with the CPU: look-ups, alignment, and the layer with its gradients."""

from __future__ import annotations

import pytest
import torch

from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BAOptions, bundle_adjust
from dvo.nets.alignment.alignment import align_patches
from dvo.nets.correlation.edge_correlation import EdgeCorrelation
from dvo.nets.correlation.frame_correlation import PairVolume
from tests.support.window_problem import window_problem

pytestmark = pytest.mark.gpu


def on(device, values):
    return tuple(x.to(device) for x in values)


@pytest.mark.long
@pytest.mark.parametrize(("scale", "channels"), [(1, 64), (4, 128)])
def test_correlation(device, scale, channels):
    g = torch.Generator().manual_seed(0)
    maps = [torch.randn(channels, 24, 32, generator=g) for _ in range(3)]
    features = torch.randn(20, 9, channels, generator=g)
    kk, slots = torch.randint(20, (150,), generator=g), torch.randint(3, (150,), generator=g)
    patch = torch.stack(torch.meshgrid(torch.arange(3.0), torch.arange(3.0), indexing="xy"), -1)
    coords = torch.rand(150, 1, 1, 2, generator=g) * torch.tensor([180.0, 130.0]) - 30 + 1.1 * patch
    coords[0, 0, 0] = torch.tensor([-1e6, 1e6])
    coords[1, 1, 1, 0] = torch.nan
    found = []
    for where in (device, torch.device("cpu")):
        level = EdgeCorrelation(scale, 3, where)
        for slot, one in enumerate(maps):
            level.keep_map(slot, one.to(where))
        with torch.inference_mode():
            found.append([level.lookup(*on(where, (coords, features, kk, slots))).cpu() for _ in range(2)])
    (first, again), (expected, _) = found
    assert torch.isfinite(expected).any() and torch.equal(first.nan_to_num(7), again.nan_to_num(7))
    torch.testing.assert_close(first, expected, atol=2e-4, rtol=1e-4, equal_nan=True)


def test_correlation_of_frames(device):
    g = torch.Generator().manual_seed(1)
    source, target = torch.randn(2, 32, 16, 24, generator=g)
    coords = torch.rand(16, 24, 2, generator=g) * 30 - 3
    expected = PairVolume(source, target, (1, 2), 3)(coords)
    found = PairVolume(*on(device, (source, target)), (1, 2), 3)(coords.to(device)).cpu()
    torch.testing.assert_close(found, expected, atol=2e-4, rtol=1e-4)


@pytest.mark.long
def test_alignment(device):
    g = torch.Generator().manual_seed(2)
    noise = torch.rand(4, 1, 24, 32, generator=g) * 255
    images = torch.nn.functional.interpolate(noise, (96, 128), mode="bicubic")[:, 0].contiguous()
    source = torch.randint(4, (40,), generator=g)
    centres = torch.rand(40, 2, generator=g) * torch.tensor([100.0, 70.0]) + 12
    start = centres + torch.rand(40, 2, generator=g)
    warps = torch.eye(2) + 0.05 * torch.rand(40, 2, 2, generator=g)
    given = images, source, source, centres, start, warps
    expected, found = align_patches(*given), align_patches(*on(device, given))
    torch.testing.assert_close(found.positions.cpu(), expected.positions, atol=2e-3, rtol=1e-4)


OPTIONS = {
    "tracking": BAOptions(fixed=1, bounds=(80, 60), kernel=Kernel("cauchy", 0.3), check=False),
    "four held": BAOptions(fixed=4, iterations=3, check=False),
    "structure": BAOptions(structure_only=True, kernel=Kernel("huber", 0.3)),
    "motion": BAOptions(motion_only=True, max_residual=20.0),
    "report": BAOptions(report=True, covariance=[1, 3]),
}


@pytest.mark.long
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_window_solver(device, options):
    given = window_problem()
    expected = bundle_adjust(*given, options)
    with torch.no_grad():
        found, again = (bundle_adjust(*on(device, given), options) for _ in range(2))
    assert (given[0] - expected.poses_cw).abs().max() + (given[1] - expected.patches).abs().max() > 1e-3
    for name in ("poses_cw", "patches", "cost", "covariance"):
        x, y = getattr(found, name), getattr(expected, name)
        assert (x is None) == (y is None)
        if x is not None:
            torch.testing.assert_close(x.cpu(), y, atol=1e-4, rtol=1e-3)


@pytest.mark.long
def test_gradients_of_the_layer(device):
    gradients = []
    for where in (device, torch.device("cpu")):
        *floats, ii, jj, kk = on(where, window_problem(3))
        floats = [x.requires_grad_() for x in floats]
        result = bundle_adjust(*floats, ii, jj, kk, BAOptions(bounds=(80, 60)))
        (result.poses_cw[:, 1:, :3].sum() + result.patches[:, :, 2].square().sum()).backward()
        by_poses, *others = (x.grad.cpu() for x in floats)
        q = floats[0][..., 3:].detach().cpu()
        along = (q * by_poses[..., 3:]).sum(-1, keepdim=True) * q  # the length of a unit quaternion means nothing
        gradients.append([torch.cat([by_poses[..., :3], by_poses[..., 3:] - along], -1), *others])
    for x, y in zip(*gradients, strict=True):
        assert y.abs().max() > 0
        torch.testing.assert_close(x, y, atol=5e-3 * float(y.abs().max()), rtol=1e-2)
