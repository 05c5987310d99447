"""Patch centres of the training pass: drawn, or given."""

from collections import deque

import pytest
import torch

from dvo.geometry import se3
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import training_schedule
from dvo.nets.patch.config import preset


@pytest.fixture
def clip():
    torch.manual_seed(0)
    images = torch.randint(0, 256, (2, 3, 3, 48, 64), dtype=torch.uint8)
    return PatchVO(preset("tiny")).eval(), images, torch.tensor([50.0, 50, 32, 24]).expand(2, 3, 4)


def generators():
    return [torch.Generator().manual_seed(seed) for seed in (3, 4)]


@torch.no_grad()
def last(model, images, intrinsics, patches, **options):
    stages = training_schedule(3, patches, 2, self_edges=False)
    return deque(model.unroll(images, intrinsics, stages, poses_cw=se3.identity(2, 3), **options), maxlen=1)[0]


def test_given_centres_are_those_of_the_patches(clip):
    model, images, intrinsics = clip
    m = model.config.training_patches
    drawn = last(model, images, intrinsics, m, generator=generators())
    centres = model.draw_centres(images, generators())
    given = last(model, images, intrinsics, m, centres=centres)
    assert torch.equal(given.patches[:, :, :2, 1, 1].long(), centres.flatten(1, 2))
    assert torch.equal(drawn.poses_cw, given.poses_cw) and torch.equal(drawn.patches, given.patches)


def test_their_number_is_free(clip):
    model, images, intrinsics = clip
    centres = model.draw_centres(images, generators())[:, :, :5]
    assert last(model, images, intrinsics, 5, centres=centres).patches.shape[:2] == (2, 15)
