"""Training of a member: phases, learning curve, interruption."""

from dataclasses import replace

import pytest
import torch

from train.studies.family import training
from train.studies.family.records import Records
from train.studies.family.training import run_folder, train_member


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


@pytest.mark.long
def test_an_interrupted_training_ends_as_one_that_was_not(family, tmp_path, monkeypatch):
    config = family()
    whole = train_member(config, "deepvo", 0)
    records = Records(config)
    (run,) = records.runs.rows()
    assert (run["steps"], run["clips"], run["skipped"]) == ("4", "8", "0") and float(run["seconds"]) > 0
    assert int(run["parameters"]) == sum(p.numel() for p in whole.net.parameters())
    curve = records.curves.rows()
    assert [(row["point"], row["step"]) for row in curve] == [("0", "0"), ("1", "2"), ("2", "4")]
    assert 0 < float(curve[1]["seconds"]) < float(curve[2]["seconds"]) <= float(run["seconds"]) * 1.001
    # done: nothing is trained
    monkeypatch.setattr(training, "fit", None)
    assert same(train_member(config, "deepvo", 0).average, whole.average)
    monkeypatch.undo()
    # stopped after the first step of the second phase
    again = replace(config, out=str(tmp_path / "again" / "family"))
    folder = run_folder(config, "deepvo", 0)
    (folder / "phase1.pt").unlink()
    (folder / "phase1" / "last.ckpt").unlink()
    real = training.fit

    def stops_early(folder, program, clips, steps, callbacks, save_every):
        real(folder, program, clips, 1, callbacks, save_every)

    monkeypatch.setattr(training, "fit", stops_early)
    with pytest.raises(KeyboardInterrupt):
        train_member(again, "deepvo", 0)
    monkeypatch.undo()
    assert (folder / "phase1" / "last.ckpt").is_file() and not Records(again).runs.rows()
    resumed = train_member(again, "deepvo", 0)
    assert same(resumed.average, whole.average) and same(resumed.net, whole.net)
    (run,) = Records(again).runs.rows()
    assert (run["steps"], run["clips"]) == ("4", "8")


def test_phases_have_their_own_settings_and_seeds_their_own_weights(family, monkeypatch):
    config, programs = family(curve_sequences=0), []
    real = training.fit

    def keep(folder, program, *rest):
        programs.append(program)
        real(folder, program, *rest)

    monkeypatch.setattr(training, "fit", keep)
    found = [train_member(config, "deepvo", seed) for seed in (0, 1)]
    assert [program.task.both_ways for program in programs] == [False, True] * 2
    assert [program.settings.learning_rate for program in programs] == [1e-3, 2e-3] * 2
    assert not same(found[0].average, found[1].average)
    assert Records(config).curves.rows() == []


def test_the_budget_is_processor_time(family, monkeypatch):
    config = family(curve_sequences=0, minutes=0.1)
    config = replace(config, members={"deepvo": replace(config.members["deepvo"], steps=0)})
    real = training.Pace.on_train_batch_end

    def a_second(self, trainer, program, *rest):
        real(self, trainer, program, *rest)
        self.train_seconds = float(trainer.global_step)
        self._look(trainer, program)

    monkeypatch.setattr(training.Pace, "on_train_batch_end", a_second)
    train_member(config, "deepvo", 0)
    (run,) = Records(config).runs.rows()
    assert (run["steps"], run["seconds"]) == ("6", "6")  # two phases of three seconds


@pytest.mark.parametrize("steps", [4, 0])
def test_a_phase_that_was_stopped_after_its_last_step_is_not_trained_again(steps, family, monkeypatch):
    config = family(curve_sequences=0, minutes=1e-3)
    config = replace(config, members={"deepvo": replace(config.members["deepvo"], steps=steps)})
    whole = train_member(config, "deepvo", 0)
    (before,) = Records(config).runs.rows()
    (run_folder(config, "deepvo", 0) / "phase1.pt").unlink()
    again = train_member(config, "deepvo", 0)
    assert same(again.average, whole.average)
    (after,) = Records(config).runs.rows()
    for name in ("steps", "clips", "seconds"):
        assert after[name] == before[name], name
