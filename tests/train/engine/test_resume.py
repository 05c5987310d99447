"""Resuming gives the same losses and weights as not having stopped."""

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from train.tasks.patch_vo.objective import LossConfig

V2V = LossConfig(weighted=True, balance="v2v", balance_every=1, balance_window=3, pose_from=1)


def same(a, b):
    for (name, x), y in zip(a.state_dict().items(), b.state_dict().values(), strict=True):
        assert torch.equal(x, y), name


@pytest.mark.long
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
    assert resumed.task.beta == whole.task.beta and resumed.task.rotation == whole.task.rotation
    if loss is not None:
        assert len(whole.task.beta.recent) == 3 and whole.task.beta.value != 1 != whole.task.rotation.value
    pairs = zip(runs.module().net.parameters(), whole.net.parameters(), strict=True)
    assert any(not torch.equal(a, b) for a, b in pairs)


def test_a_state_without_balance_goes_on_with_the_defaults(tmp_path, runs):
    runs.fit(tmp_path, 1)
    state = torch.load(tmp_path / "last.ckpt", weights_only=False)
    del state["training"]
    torch.save(state, tmp_path / "old.ckpt")
    resumed, _ = runs.fit(tmp_path, 2, runs.module(loss=V2V), tmp_path / "old.ckpt")
    assert len(resumed.task.beta.recent) == 1
    plain, _ = runs.fit(tmp_path, 2, runs.module(), tmp_path / "old.ckpt")
    assert plain.task.beta.value == plain.task.rotation.value == 1
