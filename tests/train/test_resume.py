"""Resuming gives the same losses and weights as not having stopped; the warm-up ends by its criterion."""

from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from train.engine.export import averaged_model
from train.tasks.patch_vo.module import PatchVOTraining
from train.tasks.patch_vo.objective import LossConfig

STATE = Path(__file__).resolve().parents[2] / "train" / "state" / "small.ckpt"
V2V = LossConfig(weighted=True, balance="v2v", balance_every=1, balance_window=3, pose_from=1)


def same(a, b):
    for (name, x), y in zip(a.state_dict().items(), b.state_dict().values(), strict=True):
        assert torch.equal(x, y), name


@pytest.mark.parametrize("loss", [pytest.param(None, id="plain", marks=pytest.mark.slow), pytest.param(V2V, id="v2v")])
def test_resumed_training_equals_uninterrupted_training(tmp_path, runs, loss):
    for name in "abc":
        (tmp_path / name).mkdir()
    whole, losses = runs.fit(tmp_path / "a", 4, runs.module(loss=loss))
    again, same_losses = runs.fit(tmp_path / "c", 4, runs.module(loss=loss))
    assert losses == same_losses  # the same seed, the same bytes
    same(whole, again)
    # The checkpoint that is written while training goes on, not only the one at its end, holds everything.
    saver = ModelCheckpoint(tmp_path / "b", filename="step", every_n_train_steps=2, save_top_k=1)
    _, first = runs.fit(tmp_path / "b", 3, runs.module(loss=loss), callbacks=[saver])
    resumed, then = runs.fit(tmp_path / "b", 4, runs.module(loss=loss), tmp_path / "b" / "step.ckpt")
    assert first == losses[:3]
    assert then == losses[2:]
    same(whole, resumed)
    assert resumed.beta == whole.beta and resumed.rotation == whole.rotation
    if loss is not None:
        assert len(whole.beta.recent) == 3 and whole.beta.value != 1 != whole.rotation.value
    pairs = zip(runs.module().net.parameters(), whole.net.parameters(), strict=True)
    assert any(not torch.equal(a, b) for a, b in pairs)


def test_a_state_without_balance_goes_on_with_the_defaults(tmp_path, runs):
    runs.fit(tmp_path, 1)
    state = torch.load(tmp_path / "last.ckpt", weights_only=False)
    del state["training"]
    torch.save(state, tmp_path / "old.ckpt")
    resumed, _ = runs.fit(tmp_path, 2, runs.module(loss=V2V), tmp_path / "old.ckpt")
    assert len(resumed.beta.recent) == 1
    plain, _ = runs.fit(tmp_path, 2, runs.module(), tmp_path / "old.ckpt")
    assert plain.beta.value == plain.rotation.value == 1


@pytest.mark.skipif(not STATE.is_file(), reason="no training state in this checkout")
def test_the_state_of_the_shipped_weights_fits_the_program():
    state = torch.load(STATE, map_location="cpu", weights_only=False)
    program = PatchVOTraining(model="small")
    program.load_state_dict(state["state_dict"], strict=True)
    program.on_load_checkpoint(state)
    optimizer = program.configure_optimizers()["optimizer"]
    optimizer.load_state_dict(state["optimizer_states"][0])


def test_warm_up_ends_when_the_flow_has_clicked():
    program = PatchVOTraining(model="tiny", warmup_until=0.5)
    for _ in range(30):
        program._follow(torch.tensor(0.6))
    assert bool(program.warming)
    for _ in range(100):
        program._follow(torch.tensor(0.6))
    assert not bool(program.warming)
    program._follow(torch.tensor(0.0))
    assert not bool(program.warming)


def test_warm_up_ends_after_its_steps(tmp_path, runs):
    program, _ = runs.fit(tmp_path, 2, runs.module(warmup_until=2.0, warmup_steps=2, warmup_mode="structure"))
    assert bool(program.warming)
    program, _ = runs.fit(tmp_path, 3, program, tmp_path / "last.ckpt")
    assert not bool(program.warming)


def test_export_takes_the_moving_average(tmp_path, runs):
    program, _ = runs.fit(tmp_path, 2)
    model, facts = averaged_model(tmp_path / "last.ckpt")
    assert facts["steps"] == 2
    assert facts["clips"] == 2
    for a, b in zip(model.parameters(), program.average.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("mode", ["joint", "structure", "flow"])
def test_every_mode_trains_every_part_it_uses(mode, runs):
    program = PatchVOTraining(model="tiny", updates=3, warmup_mode=mode, warmup_until=1.0)
    program.log_dict = lambda *a, **k: None
    program.training_step(runs.batch(), 0).backward()
    idle = [name for name, p in program.net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    expected = [n for n, _ in program.net.named_parameters() if n.startswith("update.w.")] if mode == "flow" else []
    assert idle == expected or (mode == "flow" and set(expected) <= set(idle) and len(idle) <= len(expected) + 1)
