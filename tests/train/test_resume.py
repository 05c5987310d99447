"""Resuming gives the same weights as not having stopped; a bad step is skipped; the warm-up ends by its criterion."""

import lightning as L
import pytest
import torch

from train.data import Renderings
from train.export import averaged_model
from train.module import PatchVOTraining

CLIP = {"frames": 4, "sizes": [(48, 64), (64, 48)], "workers": 0, "seed": 5}


def module(**changes):
    torch.manual_seed(0)
    return PatchVOTraining(model="tiny", updates=3, initial=3, settle=1, warmup_until=0.0, **changes)


def fit(folder, steps, checkpoint=None, program=None):
    trainer = L.Trainer(
        accelerator="cpu", max_steps=steps, max_epochs=-1, logger=False, enable_progress_bar=False,
        enable_model_summary=False, enable_checkpointing=False, default_root_dir=folder, use_distributed_sampler=False,
    )  # fmt: skip
    program = program or module()
    trainer.fit(program, Renderings(**CLIP), ckpt_path=checkpoint, weights_only=False)
    trainer.save_checkpoint(folder / "last.ckpt")
    return program


def test_resumed_training_equals_uninterrupted_training(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    whole = fit(tmp_path / "a", 4)
    fit(tmp_path / "b", 2)
    resumed = fit(tmp_path / "b", 4, tmp_path / "b" / "last.ckpt")
    for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    assert any(not torch.equal(a, b) for a, b in zip(module().net.parameters(), whole.net.parameters(), strict=True))


def test_a_step_that_is_not_finite_is_skipped_and_counted(tmp_path):
    program = module()
    before = [p.clone() for p in program.net.parameters()]
    real = program.net.update.forward

    def poisoned(*args):
        hidden, delta, weights = real(*args)
        return hidden, delta * torch.nan, weights

    program.net.update.forward = poisoned
    batch = torch.utils.data.default_collate([Renderings(**CLIP).clips()[0]])
    program.log_dict = lambda *a, **k: None
    assert program.training_step(batch, 0) is None
    assert int(program.skipped) == 1
    for a, b in zip(before, program.net.parameters(), strict=True):
        assert torch.equal(a, b)


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


def test_export_takes_the_moving_average(tmp_path):
    program = fit(tmp_path, 2)
    model, facts = averaged_model(tmp_path / "last.ckpt")
    assert facts["steps"] == 2
    assert facts["clips"] == 2
    for a, b in zip(model.parameters(), program.average.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("mode", ["joint", "structure", "flow"])
def test_every_mode_trains_every_part_it_uses(mode):
    program = PatchVOTraining(model="tiny", updates=3, warmup_mode=mode, warmup_until=1.0)
    program.log_dict = lambda *a, **k: None
    batch = torch.utils.data.default_collate([Renderings(**CLIP).clips()[0]])
    program.training_step(batch, 0).backward()
    idle = [name for name, p in program.net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    expected = [n for n, _ in program.net.named_parameters() if n.startswith("update.w.")] if mode == "flow" else []
    assert idle == expected or (mode == "flow" and set(expected) <= set(idle) and len(idle) <= len(expected) + 1)
