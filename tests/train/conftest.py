"""Tiny training runs."""

import functools

import lightning as L
import pytest
import torch

import dvo.synth.dataset
from dvo.synth.clip import make_clip
from train.data.clips import Renderings
from train.engine.build import make_program

CLIP = {"frames": 4, "sizes": [(48, 64), (64, 48)], "workers": 0, "seed": 5}


@functools.lru_cache(maxsize=64)
def _clip(seed, index, options):
    return make_clip(seed, index, **dict(options))


@pytest.fixture(autouse=True)
def rendered_once(monkeypatch):
    """Tests share their clips: rendering them is what takes the time."""
    monkeypatch.setattr(dvo.synth.dataset, "make_clip", lambda seed, index, **o: _clip(seed, index, tuple(o.items())))


class Record(L.Callback):
    """Keeps the losses of a run."""

    def __init__(self):
        self.losses = []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.losses.append(float(outputs["loss"]) if outputs else None)


class Runs:
    """Makes modules, data and runs."""

    clip = CLIP

    @staticmethod
    def module(**changes):
        torch.manual_seed(0)
        options = {"model": "tiny", "updates": 3, "initial": 3, "settle": 1, "warmup_until": 0.0}
        return make_program("patch_vo", **(options | changes))

    @staticmethod
    def data(**changes):
        return Renderings(**(CLIP | changes))

    @staticmethod
    def batch(*indices, **changes):
        clips = Renderings(**(CLIP | changes)).clips()
        return torch.utils.data.default_collate([clips[i] for i in indices or (0,)])

    @classmethod
    def fit(cls, folder, steps, program=None, checkpoint=None, callbacks=(), data=None, **options):
        """Train; returns the program and the losses of its steps."""
        record = Record()
        trainer = L.Trainer(**({
            "accelerator": "cpu", "max_steps": steps, "max_epochs": -1, "logger": False, "enable_progress_bar": False,
            "enable_model_summary": False,
            "enable_checkpointing": any(isinstance(c, L.pytorch.callbacks.Checkpoint) for c in callbacks),
            "default_root_dir": folder, "use_distributed_sampler": False, "callbacks": [record, *callbacks],
        } | options))  # fmt: skip
        program = program or cls.module()
        trainer.fit(program, data or cls.data(), ckpt_path=checkpoint, weights_only=False)
        trainer.save_checkpoint(folder / "last.ckpt")
        return program, record.losses


@pytest.fixture
def runs():
    return Runs
