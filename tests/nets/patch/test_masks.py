from functools import partial

import numpy as np
import pytest
import torch

from dvo.nets.patch.masks import in_sight, places_of_patches, shrunk, unmasked_centres, visible_features
from dvo.nets.patch.selection import SELECTIONS

CPU = torch.device("cpu")


def half_mask(height=96, width=128):
    mask = np.ones((height, width), bool)
    mask[:, : width // 2] = False
    return mask


def test_shrunk_keeps_the_margin_and_the_border():
    found = shrunk(half_mask(), 12)
    assert not found[:, : 64 + 12].any() and found[:, 64 + 12 :].all()


def test_a_patch_at_a_place_touches_no_ignored_pixel():
    places, visible = (f(half_mask(), 3, CPU) for f in (places_of_patches, visible_features))
    y, x = places.nonzero().unbind(-1)
    assert int(x.min()) == 64 // 4 + 3 and int(y.min()) == 1 and int(x.max()) == 30
    assert int(visible.nonzero()[:, 1].min()) * 4 - 6 >= 64 and bool(visible[0].any())


def test_a_narrow_strip_still_has_places():
    mask = np.zeros((96, 128), bool)
    mask[40:56] = True
    places = places_of_patches(mask, 3, CPU)
    y = places.nonzero()[:, 0]
    assert len(y) and 4 * int(y.min()) >= 40 and 4 * int(y.max()) < 56


@pytest.mark.parametrize("name", ["random", "grid", "structure"])
@pytest.mark.parametrize("mask", [half_mask(), np.pad(np.ones((30, 30), bool), ((60, 6), (90, 8)))])
def test_every_selection_stays_in_the_mask(name, mask):
    images = torch.randint(0, 256, (1, 1, 3, 96, 128), dtype=torch.uint8, generator=torch.manual_seed(0))
    draw = partial(SELECTIONS.resolve(name), images, patches=20, generator=torch.Generator().manual_seed(1))
    places = places_of_patches(mask, 3, CPU)
    centres = unmasked_centres(draw(), draw, places)
    assert centres.shape == (1, 1, 20, 2)
    x, y = centres[0, 0].unbind(-1)
    assert bool(places[y, x].all()) and len(set(map(tuple, centres[0, 0].tolist()))) > 5


def test_in_sight():
    visible = torch.ones(2, 4, 6, dtype=torch.bool)
    visible[1, 2, 3] = False
    targets = torch.tensor([[[3.2, 1.8], [3.2, 1.8], [-5.0, 2.0], [float("nan"), 0.0], [3.6, 2.0]]])
    assert in_sight(targets, torch.tensor([1, 0, 1, 1, 1]), visible).tolist() == [[False, True, True, True, True]]
