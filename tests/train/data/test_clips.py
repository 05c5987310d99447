"""Curricula of rendered clips."""

import pytest

from dvo.errors import DvoError
from train.data.clips import CurriculumStage, MixedClips, Renderings


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
