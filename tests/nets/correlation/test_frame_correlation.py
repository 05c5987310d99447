"""Correlation of whole frames: the volume of a clip and that of one pair against the specification."""

import torch

from dvo.nets.correlation.correlation import CorrelationVolume, correlate_reference
from dvo.nets.correlation.frame_correlation import PairVolume

PYRAMID, RADIUS = (1, 2, 4), 2


def case(height=9, width=11, dtype=torch.float32):
    g = torch.Generator().manual_seed(0)
    maps = torch.randn(1, 2, 5, height, width, generator=g, dtype=dtype)
    coords = 4 * torch.randn(1, 2, height, width, 2, generator=g, dtype=dtype) + 4
    far = torch.tensor([[1e4, -1e4], [-40.0, 3.0], [width - 0.4, height + 0.2], [-0.5, -0.5], [-1.0, 3.0]], dtype=dtype)
    coords[0, 0, 0, : len(far)] = far
    return maps, coords, torch.tensor([0, 1]), torch.tensor([1, 0])


def test_a_pair_has_the_values_of_the_specification():
    maps, coords, ii, jj = case()
    plain = correlate_reference(maps, maps, coords, ii, jj, PYRAMID, RADIUS)
    plain = torch.cat([level.view(2, -1, 9, 11) for level in plain], 1)
    for edge, (i, j) in enumerate(((0, 1), (1, 0))):
        found = PairVolume(maps[0, i], maps[0, j], PYRAMID, RADIUS)(coords[0, edge])
        torch.testing.assert_close(found, plain[edge], atol=1e-5, rtol=1e-5)


def test_a_map_of_one_pixel_has_all_taps_outside_but_one():
    maps = torch.randn(2, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    found = PairVolume(maps[0], maps[1], (4,), 1)(torch.zeros(4, 4, 2)).view(3, 3, 16)
    torch.testing.assert_close(found[1, 1], maps[0].flatten(1).mT @ maps[1].mean((1, 2)), atol=1e-5, rtol=1e-5)
    found[1, 1] = 0
    assert (found == 0).all()


def test_the_volume_of_a_clip_takes_whole_frames_as_patches():
    maps, coords, ii, jj = case(dtype=torch.float64)
    upstream = torch.randn(2, 25, 9, 11, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = []
    for plain in (False, True):
        leaf = maps.clone().requires_grad_()
        if plain:
            levels = correlate_reference(leaf, leaf, coords, ii, jj, PYRAMID, RADIUS)
        else:
            levels = CorrelationVolume(leaf, leaf, PYRAMID, RADIUS).lookup(coords, ii, jj)
        values = [level.view(2, -1, 9, 11) for level in levels]
        total = torch.stack([(value * upstream).sum() for value in values]).sum()
        found.append((*[v.detach() for v in values], *torch.autograd.grad(total, leaf)))
    for mine, reference in zip(*found, strict=True):
        torch.testing.assert_close(mine, reference, atol=1e-9, rtol=1e-9)
