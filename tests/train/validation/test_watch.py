"""Validation while training leaves no trace in what is trained, and writes numbers and pictures."""

import random

import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from train.validation.watch import TrackWhileTraining, undisturbed

QUICK = {"rendered": 1, "frames": 10, "size": (48, 64)}


@pytest.mark.slow
def test_training_is_the_same_with_and_without_it(tmp_path, runs):
    watch = TrackWhileTraining(str(tmp_path), every=2, **QUICK)
    plain, losses = runs.fit(tmp_path, 3)
    loggers = [CSVLogger(tmp_path, "csv"), TensorBoardLogger(tmp_path, "board", version="")]
    watched, same = runs.fit(tmp_path, 3, callbacks=[watch], logger=loggers, log_every_n_steps=1)
    assert losses == same
    for a, b in zip(plain.state_dict().values(), watched.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    pictures = sorted((tmp_path / "pictures").glob("*.png"))
    assert [p.name for p in pictures] == ["rendered0_0000002.png"]
    assert cv2.imread(str(pictures[0])).std() > 10
    table = (tmp_path / "csv" / "version_0" / "metrics.csv").read_text().splitlines()
    wanted = {
        "loss", "loss_flow", "loss_target", "loss_translation", "loss_rotation", "beta", "rotation_coefficient",
        "px<0.25", "px<1", "px<4", "translation", "rotation_deg", "gradient_norm", "gradient_norm_encoder",
        "gradient_norm_update", "skipped", "clips_per_s", "wait_s", "track/ate_percent", "track/rendered0/ate_percent",
    }  # fmt: skip
    assert wanted <= set(table[0].split(","))
    assert sum(bool(row.split(",")[table[0].split(",").index("loss")]) for row in table[1:]) == 3
    assert any(p.stat().st_size > 20_000 for p in (tmp_path / "board").glob("events*"))  # the picture is in there


def test_random_states_are_put_back():
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    expected = random.random(), np.random.rand(), float(torch.rand(()))  # noqa: NPY002
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    with undisturbed():
        random.random(), np.random.rand(), torch.rand(3)  # noqa: NPY002
    assert (random.random(), np.random.rand(), float(torch.rand(()))) == expected  # noqa: NPY002


@pytest.mark.long
def test_trained_weights_are_validated_before_the_first_step(tmp_path, runs, capsys):
    program = runs.module()
    program.from_trained = True
    runs.fit(tmp_path, 1, program, callbacks=[TrackWhileTraining(str(tmp_path), every=1000, **QUICK)])
    lines = [row for row in capsys.readouterr().out.splitlines() if row.startswith("validation at step ")]
    assert len(lines) == 1 and lines[0].startswith("validation at step 0, ATE in % of the path: rendered0 ")
