"""Local correlation against its plain twin, and the geometry of warping and doubling."""

import pytest
import torch

from dvo.nets.correlation.local_correlation import double, local_correlation, local_correlation_plain, warp


@pytest.mark.parametrize("shape", [(2, 5, 7, 9), (1, 3, 1, 1), (1, 4, 6, 3), (3, 2, 2, 8)])
@pytest.mark.parametrize("radius", [1, 2, 4])
def test_values_and_gradients_are_those_of_the_plain_twin(shape, radius):
    g = torch.Generator().manual_seed(0)
    first, second = (torch.randn(shape, generator=g, dtype=torch.float64, requires_grad=True) for _ in range(2))
    side = 2 * radius + 1
    upstream = torch.randn(shape[0], side * side, *shape[2:], generator=g, dtype=torch.float64)
    found = []
    for function in (local_correlation, local_correlation_plain):
        value = function(first, second, radius)
        found.append((value.detach(), *torch.autograd.grad((value * upstream).sum(), (first, second))))
    for mine, plain in zip(*found, strict=True):
        torch.testing.assert_close(mine, plain, atol=1e-12, rtol=1e-12)


def test_gradients_are_the_derivatives():
    g = torch.Generator().manual_seed(1)
    first, second = (torch.randn(1, 2, 3, 4, generator=g, dtype=torch.float64, requires_grad=True) for _ in range(2))
    assert torch.autograd.gradcheck(lambda a, b: local_correlation(a, b, 2), (first, second))


def test_the_highest_channel_is_the_displacement():
    g = torch.Generator().manual_seed(2)
    second = torch.nn.functional.normalize(torch.randn(1, 16, 12, 14, generator=g), dim=1)
    first = torch.roll(second, (-2, 1), (2, 3))  # first(x, y) = second(x - 1, y + 2)
    best = local_correlation(first, second, 3).argmax(1)[0, 3:9, 3:11]
    assert (best == (2 + 3) * 7 + (-1 + 3)).all()


def test_warping_fetches_what_the_flow_points_to():
    features = torch.arange(24.0).reshape(1, 1, 4, 6)
    flow = torch.zeros(1, 2, 4, 6)
    flow[:, 0], flow[:, 1] = 1.5, -1.0
    moved = warp(features, flow)
    torch.testing.assert_close(moved[0, 0, 2, 1], torch.tensor(6 + 2.5))  # row 1, column 2.5
    assert (moved[0, 0, 0] == 0).all()  # above the map


@pytest.mark.parametrize(("height", "width"), [(8, 12), (7, 11), (8, 11)])
def test_doubling_keeps_the_places_of_the_pixels(height, width):
    h, w = (height + 1) // 2, (width + 1) // 2
    x, y = torch.arange(w, dtype=torch.float32).expand(h, w), torch.arange(h, dtype=torch.float32)[:, None].expand(h, w)
    fine = double(torch.stack([x, y])[None], height, width)
    assert fine.shape == (1, 2, height, width)
    torch.testing.assert_close(fine[0, :, ::2, ::2], 2 * torch.stack([x, y]))
    torch.testing.assert_close(fine[0, 0, 0, : 2 * w - 1], torch.arange(2 * w - 1.0))
