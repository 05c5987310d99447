"""Degraded clips."""

import math

import pytest
import torch

from dvo.core.errors import DvoError
from train.data.degrade import Degradation, degrade, motion_blurred

NOTHING = {"light": 0.0, "noise": 0.0, "blur": 0.0}


def clips(count=2):
    draw = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (count, 3, 3, 24, 32), dtype=torch.uint8, generator=draw)


def test_the_same_step_degrades_the_same_and_nothing_is_nothing():
    images, all_of_it = clips(), Degradation(1.0, (0.1, 0.5), 1.0, (1.0, 6.0), 1.0, (1.0, 5.0))
    assert torch.equal(degrade(images, all_of_it, 3, 7), degrade(images, all_of_it, 3, 7))
    assert not torch.equal(degrade(images, all_of_it, 3, 7), degrade(images, all_of_it, 3, 8))
    assert torch.equal(degrade(images, Degradation(**NOTHING), 3, 7), images)
    # a clip of a batch does not depend on the number of clips after it
    assert torch.equal(degrade(images, all_of_it, 3, 7)[:1], degrade(images[:1], all_of_it, 3, 7))


def test_little_light_dims_and_adds_noise():
    grey = torch.full((20, 4, 3, 24, 32), 120, dtype=torch.uint8)
    found = degrade(grey, Degradation(**(NOTHING | {"light": 1.0, "light_range": (0.2, 0.2)})), 0, 0).float()
    means = found.mean((1, 2, 3, 4))
    assert (means > 20).all() and (means < 130).all() and means.max() - means.min() > 40
    assert (found.std((1, 2, 3, 4)) > 0.8).all()


def test_noise_has_the_spread_asked_for():
    grey = torch.full((1, 4, 3, 48, 64), 120, dtype=torch.uint8)
    found = degrade(grey, Degradation(**(NOTHING | {"noise": 1.0, "noise_range": (4.0, 4.0)})), 0, 0).float()
    assert found.std().item() == pytest.approx(4, rel=0.05) and found.mean().item() == pytest.approx(120, abs=0.2)


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_a_point_is_smeared_along_the_line(angle):
    image = torch.zeros(1, 1, 15, 15)
    image[0, 0, 7, 7] = 1
    found = motion_blurred(image, 4.0, angle)[0, 0]
    line = found[7] if angle == 0 else found[:, 7]
    assert found.sum().item() == pytest.approx(1) and line.sum().item() == pytest.approx(1, abs=1e-5)
    assert line[5] > 0.1 and line[9] > 0.1 and line[:5].sum() == 0
    torch.testing.assert_close(motion_blurred(image, 0.0, angle), image)


@pytest.mark.parametrize("change", [{"light": 2.0}, {"light_range": (0.5, 0.1)}, {"noise_range": (-1.0, 2.0)}])
def test_values_out_of_range_are_refused(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        Degradation(**change)


def test_seeds_may_have_64_bits():
    images = torch.full((2, 2, 3, 16, 16), 100, dtype=torch.uint8)
    found = [degrade(images, Degradation(noise=1.0), seed, 7) for seed in (2**63 - 1, 2**63 - 1, 2**63 - 2)]
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])
