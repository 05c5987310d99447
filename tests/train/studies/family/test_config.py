"""Settings of the study of the family."""

from dataclasses import replace
from pathlib import Path

import pytest

from dvo.core.errors import DvoError
from dvo.synth.scenes.families import FAMILIES, SHARES
from train.studies.family.config import FamilyConfig, HeldOut, Member, Phase
from train.studies.family.training import member_program

FILE = Path(__file__).resolve().parents[4] / "configs" / "train" / "family.yaml"


def test_every_phase_of_the_study_of_the_checkout_can_be_built():
    config = FamilyConfig.read(FILE)
    assert {"deepvo", "tartanvo", "droid", "dpvo", "v2v", "mamba"} <= set(config.members)
    config.check_tasks(FILE)
    for name, member in config.members.items():
        shapes = [
            {key: value.shape for key, value in member_program(member, phase, 0).net.state_dict().items()}
            for phase in member.phases
        ]
        assert all(shape == shapes[0] for shape in shapes), name
    losses = [member_program(config.members[name], config.members[name].phases[1], 0).task.loss for name in
              ("dpvo", "v2v", "mamba")]  # fmt: skip
    assert [loss.balance for loss in losses] == ["none", "v2v", "trend"] and losses[1].weighted


def test_sequences_are_of_scenes_that_training_never_draws():
    sequences = FamilyConfig.read(FILE).held_out.sequences()
    assert len(sequences) > 1 and len({options["seed"] for options in sequences.values()}) == len(sequences)
    for options in sequences.values():
        assert options["apart"] and options["family"] in FAMILIES and options["family"] not in SHARES
    kinds = HeldOut(count=4, families=("hall",), kinds=("handheld", "fast")).sequences()
    assert list(kinds) == ["hall_handheld_0", "hall_fast_1", "hall_handheld_2", "hall_fast_3"]


@pytest.mark.parametrize(
    ("text", "message"),
    [("minutes: 3", "members"), ("members: {}", "members"), ("{members: {a: {task: deepvo, phases: []}}}", "shares"),
     ("{members: {a: {task: deepvo, phases: [{share: 0.5, rate: 1.0e-3}]}}}", "members: a: the shares do not add up"),
     ("{members: {'null': {task: deepvo, phases: [{share: 1.0, rate: 1.0e-3}]}}}", "members: none, or one named"),
     ("{members: {a: {task: deepvo, phases: [{share: 2.0, rate: 1.0e-3}]}}}", "out of range"),
     ("{seeds: [], members: {a: {task: deepvo, phases: [{share: 1.0, rate: 1.0e-3}]}}}", "seeds: an empty list"),
     ("{minuets: 3, members: {}}", "minuets"), ("- members", "got a list"), ("", "expected a table")],
)  # fmt: skip
def test_bad_settings_are_named(text, message, tmp_path):
    file = tmp_path / "family.yaml"
    file.write_text(text)
    with pytest.raises(DvoError, match=message) as error:
        FamilyConfig.read(file)
    assert str(error.value).startswith(f"{file}: ")


def test_a_member_whose_task_is_not_registered_is_named(family, tmp_path):
    config = family(members={"other": Member("absent", (Phase(1.0, 1e-3),))})
    with pytest.raises(DvoError, match=r"family.yaml: members: other: task: no task 'absent'.*--members"):
        config.check_tasks(tmp_path / "family.yaml")


def test_the_fingerprint_follows_what_the_measurements_depend_on(family):
    config = family()
    member = config.members["deepvo"]

    def digest(one=config, **changes):
        return replace(one, members={"deepvo": replace(member, **changes)}).digest("deepvo")

    same = config.digest("deepvo")
    assert digest(about="else") == digest(replace(config, minutes=3.0, points=5, published={"a": 1.0})) == same
    assert same not in (digest(steps=5), digest(batch=3), digest(odometry={"pixels": 9}), digest(phases=()))
    assert same not in (digest(replace(config, clips=4)), digest(replace(config, held_out=HeldOut())))
    timed = replace(config, members={"deepvo": replace(member, steps=0)})
    assert timed.digest("deepvo") != replace(timed, minutes=3.0).digest("deepvo")
    assert config.digest("null") == replace(config, clips=4).digest("null")
    assert config.digest("null") != replace(config, held_out=HeldOut()).digest("null")
