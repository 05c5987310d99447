"""The task of the pose-regression network: its loss, its measures, equal and resumed runs."""

from dataclasses import fields
from pathlib import Path

import pytest
import torch
import yaml
from lightning.pytorch.callbacks import ModelCheckpoint

import dvo
from dvo.core.errors import DvoError
from dvo.models.deepvo import TRANSLATION_UNIT, chain, true_steps
from dvo.synth.sequence import make_sequence
from train.data.augment import Augmentation
from train.data.turns import Turns, turn_cameras
from train.engine.build import make_program
from train.engine.checkpoint import read_state
from train.tasks.deepvo.objective import LossConfig, step_errors
from train.tasks.deepvo.task import DeepVOTask
from train.tasks.task import StepContext

ROOT = Path(__file__).resolve().parents[3]


def program(**changes):
    torch.manual_seed(0)
    return make_program("deepvo", **({"model": "tiny", "learning_rate": 2e-3, "warmup": 1} | changes))


def steps(seed, clips=2, count=3):
    return 0.3 * torch.randn(clips, count, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_the_gradient_of_the_loss():
    found, truth = steps(0).requires_grad_(), steps(1)
    assert torch.autograd.gradcheck(lambda x: step_errors(x, truth).total(LossConfig()), found)


def test_the_gradient_through_the_trajectory():
    """Of the product of the steps, on which a loss over several frames would rest."""
    poses_cw = chain(steps(1))
    truth = true_steps(poses_cw)
    total = lambda x: step_errors(true_steps(chain(x)), truth).total(LossConfig())  # noqa: E731
    assert torch.autograd.gradcheck(total, steps(0).requires_grad_())


def test_the_loss_is_the_published_one():
    """Squared error of the position plus kappa times that of the orientation, position in its unit."""
    truth = steps(1)
    off = truth + torch.tensor([TRANSLATION_UNIT, 0, 0, 0, 0, 0])
    assert step_errors(off, truth).total(LossConfig()) == pytest.approx(1)
    off = truth + torch.tensor([0, 0, 0, 0, 0.1, 0])
    assert step_errors(off, truth).total(LossConfig()) == pytest.approx(1)
    assert step_errors(off, truth).total(LossConfig(kappa=30.0)) == pytest.approx(0.3)
    assert step_errors(truth, truth).total(LossConfig()) == 0
    for kappa in (-1.0, "much"):
        with pytest.raises(DvoError, match="kappa"):
            LossConfig(kappa=kappa)


def test_the_same_seed_gives_the_same_bytes_and_resuming_those_of_not_having_stopped(tmp_path, runs):
    changes = {"augmentation": Augmentation(colour=0.0, zoom=0.0, exposure=1.0), "turns": Turns(probability=1.0)}
    options = {"both_ways": True} | changes
    for name in "abc":
        (tmp_path / name).mkdir()
    whole, losses = runs.fit(tmp_path / "a", 4, program(**options))
    again, same = runs.fit(tmp_path / "c", 4, program(**options))
    assert losses == same
    saver = ModelCheckpoint(tmp_path / "b", filename="step", every_n_train_steps=2, save_top_k=1)
    _, first = runs.fit(tmp_path / "b", 3, program(**options), callbacks=[saver])
    resumed, then = runs.fit(tmp_path / "b", 4, program(**options), tmp_path / "b" / "step.ckpt")
    assert first == losses[:3] and then == losses[2:]
    for (name, a), b, c in zip(
        whole.state_dict().items(), again.state_dict().values(), resumed.state_dict().values(), strict=True
    ):
        assert torch.equal(a, b) and torch.equal(a, c), name


@pytest.mark.slow
def test_the_shipped_configuration_trains_resumes_and_gives_weights_that_track(tmp_path, command):
    """By the ordinary commands, with smaller sizes on top."""
    watch = {"every": 2, "rendered": 1, "frames": 4, "size": [48, 64]}
    smaller = {
        "trainer": {
            "accelerator": "cpu", "enable_progress_bar": False, "enable_model_summary": False, "log_every_n_steps": 1,
            "default_root_dir": str(tmp_path),
            "callbacks": [
                {"class_path": "lightning.pytorch.callbacks.ModelCheckpoint",
                 "init_args": {"save_last": True, "every_n_train_steps": 1, "enable_version_counter": False}},
                {"class_path": "train.validation.watch.TrackWhileTraining", "init_args": watch},
            ],
        },
        "model": {"model": "tiny"},
        "data": {"batch_size": 1, "frames": 4, "sizes": [[48, 64]], "workers": 0},
    }  # fmt: skip
    file = tmp_path / "smaller.yaml"
    file.write_text(yaml.safe_dump(smaller))

    fit = ("fit", "--config", ROOT / "configs" / "train" / "deepvo.yaml", "--config", file)
    command(*fit, "--name", "whole", "--trainer.max_steps=4")
    command(*fit, "--name", "parts", "--trainer.max_steps=2")
    command(*fit, "--name", "parts", "--trainer.max_steps=4", "--resume")
    whole, parts = (read_state(tmp_path / name / "last.ckpt") for name in ("whole", "parts"))
    assert whole["task"] == "deepvo" and whole["Renderings"] == parts["Renderings"] == {"clips_seen": 4}
    for name, tensor in whole["state_dict"].items():
        assert torch.equal(tensor, parts["state_dict"][name]), name
    logged = (tmp_path / "whole" / "csv" / "version_0" / "metrics.csv").read_text().splitlines()[0]
    expected = {"loss", "rotation_ratio", "gradient_norm_encoder", "track/rendered0/ate_percent"}
    assert expected <= set(logged.split(","))
    command("export", tmp_path / "whole" / "last.ckpt", tmp_path / "motion.safetensors")
    odometry = dvo.load(str(tmp_path / "motion.safetensors"))
    assert odometry.name == "dvo-motion"
    for frame in make_sequence(7, frames=3, height=48, width=64, fps=10.0):
        assert odometry.track(frame).pose_wc is not None


def test_the_loss_of_one_clip_falls(tmp_path, runs):
    task = program()
    batch = runs.batch()
    optimizer = torch.optim.Adam(task.net.parameters(), 2e-3)
    losses = []
    for _ in range(40):
        optimizer.zero_grad()
        found = task.task.compute_loss(task.context, batch)
        found.loss.backward()
        optimizer.step()
        losses.append(float(found.loss.detach()))
    assert losses[-1] < 0.2 * losses[0]


def test_both_ways_is_the_mean_over_the_clips_and_their_reversals(runs):
    batch = runs.batch(0, 2)
    reverse = {name: value.flip(1) for name, value in batch.items()}
    one, both = program(), program(both_ways=True)
    apart = [one.task.compute_loss(one.context, clips).loss for clips in (batch, reverse)]
    torch.testing.assert_close(both.task.compute_loss(both.context, batch).loss, sum(apart) / 2)


def test_turned_cameras_have_the_motion_of_turned_cameras(runs):
    """Images and poses of the loss are those of the turned clips, in both directions."""
    batch = runs.batch(0, 2)
    turned = turn_cameras(batch, Turns(probability=1.0), 4, 0)
    plain, made = (program(seed=4, both_ways=True, **more) for more in ({}, {"turns": {"probability": 1.0}}))
    found = made.task.compute_loss(made.context, batch)
    expected = plain.task.compute_loss(plain.context, turned)
    torch.testing.assert_close(found.loss, expected.loss)
    assert found.measures["rotation_deg"] != plain.task.compute_loss(plain.context, batch).measures["rotation_deg"]


def test_measures_of_a_held_out_clip(runs):
    made = program()
    found = made.task.measure(made.net, runs.batch(), 0)
    assert set(found) == {"loss", "pose", "translation", "rotation_deg", "rotation_ratio", "step_ratio"}
    truth = runs.batch()["poses_cw"]
    exact = DeepVOTask.errors(true_steps(truth), truth)
    assert all(float(value) < 1e-2 for value in exact.values()), exact
    still = DeepVOTask.errors(torch.zeros(1, truth.shape[1] - 1, 6), truth)
    assert float(still["rotation_ratio"]) == pytest.approx(1) and float(still["step_ratio"]) == pytest.approx(1)


def test_mixed_precision_stays_near_full_precision(tmp_path, runs):
    _, exact = runs.fit(tmp_path, 2, program())
    _, mixed = runs.fit(tmp_path, 2, program(), precision="bf16-mixed")
    assert mixed[0] == pytest.approx(exact[0], rel=0.05)


def test_an_unknown_preset_is_refused():
    with pytest.raises(DvoError, match="no preset 'huge'.*tiny"):
        DeepVOTask("huge")


@pytest.mark.parametrize("change", [{"model": "huge"}, {"seed": -1}, {"both_ways": 1}])
def test_arguments_out_of_range_are_named(change):
    field = {"model": "preset"}.get(next(iter(change)), next(iter(change)))
    with pytest.raises(DvoError, match=field):
        DeepVOTask(**change)


@pytest.mark.parametrize("name", [item.name for item in fields(LossConfig) if item.name != "form"])
def test_weights_of_the_loss_out_of_range_are_named(name):
    for value in (-1.0, float("nan"), "1"):
        with pytest.raises(DvoError, match=name):
            LossConfig(**{name: value})


def test_copies_of_a_clip_are_turned_otherwise(runs):
    """Two copies of a clip count as the two clips that the same draws make of a batch with the clip twice."""
    batch = runs.batch(0, 1, sizes=[(48, 64)])
    turns = Turns(probability=1.0)
    copied, plain = program(seed=4, turns=turns, copies=2), program(seed=4, turns=turns)
    twice = {name: value.repeat_interleave(2, 0) for name, value in batch.items()}
    found = copied.task.compute_loss(StepContext(plain.net, 3, {}), batch)
    torch.testing.assert_close(found.loss, plain.task.compute_loss(StepContext(plain.net, 3, {}), twice).loss)
    turned = turn_cameras({k: twice[k] for k in ("images", "poses_cw", "intrinsics")}, turns, 4, 3)
    assert not torch.equal(turned["poses_cw"][0], turned["poses_cw"][1])


@pytest.mark.parametrize("change", [{"copies": 0}, {"copies": True}, {"copies": 2}])
def test_numbers_of_copies_out_of_range_are_named(change):
    with pytest.raises(DvoError, match="copies"):
        DeepVOTask(turns=None if change["copies"] == 2 else Turns(), **change)
