"""Tiny training runs."""

import functools
import sys
from pathlib import Path

import lightning as L
import pytest
import torch
import yaml

import dvo.synth.dataset
from dvo.synth.clip import make_clip
from train.__main__ import main
from train.data.clips import Renderings
from train.engine.build import make_program

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "train"
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

    @classmethod
    def check_resuming(cls, folder, steps, make, data=lambda: None):
        """Equal runs have equal bytes, and so has one that is stopped after two steps and resumed; returns the program.

        ``make`` and ``data`` give a new program and new clips; the state of the stopped run stays in ``stopped``.
        """
        for name in ("whole", "again", "stopped", "resumed"):
            (folder / name).mkdir()
        whole, losses = cls.fit(folder / "whole", steps, make(), data=data())
        _, same = cls.fit(folder / "again", steps, make(), data=data())
        assert losses == same
        _, first = cls.fit(folder / "stopped", 2, make(), data=data())
        resumed, then = cls.fit(folder / "resumed", steps, make(), folder / "stopped" / "last.ckpt", data=data())
        assert first + then == losses
        for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values(), strict=True):
            assert torch.equal(a, b), name
        return whole

    @staticmethod
    def shipped(task, folder):
        """Settings of the shipped configuration of a task, for a short run whose files go to a folder."""
        settings = yaml.safe_load((CONFIGS / f"{task}.yaml").read_text())
        assert settings["task"] == task and settings["model"]["model"] == "small"
        saver = settings["trainer"]["callbacks"][0]
        saver["init_args"]["every_n_train_steps"] = 1
        settings["trainer"] |= {
            "accelerator": "cpu", "log_every_n_steps": 1, "default_root_dir": str(folder), "callbacks": [saver],
            "enable_progress_bar": False, "enable_model_summary": False,
        }  # fmt: skip
        return settings


@pytest.fixture
def runs():
    return Runs


@pytest.fixture
def command(monkeypatch):
    """``command("fit", ...)`` runs ``python -m train fit ...``."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["train", *map(str, arguments)])
        main()

    return run
