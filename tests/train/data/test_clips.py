"""Curricula of rendered clips."""

import pytest
import torch

from dvo.core.errors import DvoError
from train.data.clips import CurriculumStage, MixedClips, Renderings


@pytest.mark.long
def test_a_stage_begins_at_its_clip():
    stages = [CurriculumStage(0, 1.0, 4.0, [(48, 64)]), CurriculumStage(4, 1.0, 4.0, [(64, 48), (32, 48)])]
    clips = MixedClips(5, stages, 2, frames=2)
    shapes = [tuple(clips[i]["depth"].shape[1:]) for i in (0, 3, 4, 6)]
    assert shapes == [(48, 64), (48, 64), (64, 48), (32, 48)]


def test_stages_keep_their_former_name():
    later = [CurriculumStage(40, 1.0, 4.0, [(64, 48)])]
    assert Renderings(courses=later).stages == Renderings(stages=later).stages
    assert Renderings(stages=later).stages[1:] == later
    with pytest.raises(DvoError, match="courses"):
        Renderings(stages=later, courses=later)


@pytest.mark.long
def test_moving_bodies_and_low_light_are_in_the_clips_of_all_stages():
    options = {"seed": 5, "frames": 2, "sizes": [(48, 64)], "flow_low": 1.0, "flow_high": 4.0}
    later = [CurriculumStage(4, 1.0, 4.0, [(32, 48)])]
    hard = Renderings(movers=1.0, low_light=1.0, stages=later, **options).clips()
    for index in (0, 5):
        depth = hard[index]["depth"]
        assert torch.isnan(depth).any() and depth.nanmedian() == pytest.approx(1, rel=1e-5)
    usual = Renderings(stages=later, **options).clips()[0]
    assert torch.isfinite(usual["depth"]).all() and not torch.equal(usual["images"], hard[0]["images"])


def test_surroundings_are_in_the_clips():
    options = {"seed": 5, "frames": 2, "sizes": [(48, 64)], "flow_low": 1.0, "flow_high": 4.0}
    some, none = Renderings(surroundings=1.0, **options).clips(), Renderings(**options).clips()
    found = [bool(torch.isnan(some[index]["depth"]).any()) for index in range(4)]
    assert any(found) and all(torch.isfinite(none[index]["depth"]).all() for index in range(4))


@pytest.mark.parametrize("name", ["movers", "low_light", "surroundings", "bare", "blurred"])
def test_a_probability_is_from_0_to_1(name):
    for value in (-0.1, 1.5, float("nan")):
        with pytest.raises(DvoError, match=f"data.{name}: not a share"):
            Renderings(**{name: value})
