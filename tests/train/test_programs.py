"""Configurations, presets and precision: a step of each on tiny sizes."""

import sys
from pathlib import Path

import pytest
import torch
import yaml

from train.__main__ import main
from train.data.augment import Augmentation
from train.tasks.patch_vo.module import PatchVOTraining
from train.tasks.patch_vo.objective import LossConfig

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "train"
TINY = {
    "trainer.logger": "false", "trainer.callbacks": "null", "trainer.enable_checkpointing": "false",
    "trainer.max_steps": "1", "ckpt_path": "null", "trainer.accelerator": "cpu", "trainer.devices": "1",
    "trainer.enable_progress_bar": "false", "trainer.enable_model_summary": "false", "model.model": "tiny",
    "model.updates": "3", "model.settle": "1", "model.initial": "3", "data.frames": "4", "data.workers": "0",
    "data.seed": "5", "data.sizes": "[[48,64],[64,48]]", "data.flow_low": "2", "data.flow_high": "19",
}  # fmt: skip


@pytest.mark.parametrize("name", ["small", pytest.param("full", marks=pytest.mark.slow)])
def test_a_step_of_every_configuration(name, tmp_path, monkeypatch):
    if name == "full":
        pytest.importorskip("kornia")
    settings = [f"--{key}={value}" for key, value in TINY.items()]
    folder = f"--trainer.default_root_dir={tmp_path}"
    monkeypatch.setattr(sys, "argv", ["train", "fit", f"--config={CONFIGS / name}.yaml", folder, *settings])
    main()
    # what the run wrote down is what was asked for
    found = yaml.safe_load(next(tmp_path.rglob("config.yaml")).read_text())
    assert found["model"]["model"] == "tiny" and found["model"]["loss"]["balance"] == "none"
    assert found["model"]["cycle"] == (240000 if name == "full" else None)


@pytest.mark.slow
def test_the_full_network_takes_a_step_of_dpvos_recipe(tmp_path, runs):
    """The real layer sizes, on few patches of small frames: grows from 3 frames, structure only at first."""
    program = PatchVOTraining(
        "full", updates=4, initial=3, settle=2, cycle=100, warmup_mode="structure", warmup_until=2.0, warmup_steps=1
    )
    program.net.config = program.average.config = type(program.net.config)(training_patches=6)
    _, losses = runs.fit(tmp_path, 2, program)
    assert all(torch.isfinite(torch.tensor(x)) for x in losses)
    assert int(program.skipped) == 0 and not bool(program.warming)


@pytest.mark.parametrize(
    "loss",
    [
        pytest.param(LossConfig(), id="plain", marks=pytest.mark.slow),
        pytest.param(LossConfig(weighted=True, balance="v2v", balance_every=1), id="v2v"),
    ],
)
def test_mixed_precision_stays_near_full_precision(tmp_path, runs, loss):
    """Encoder and update operator in bfloat16; poses, bundle adjustment and loss in float32."""
    _, exact = runs.fit(tmp_path, 2, runs.module(loss=loss))
    program, mixed = runs.fit(tmp_path, 2, runs.module(loss=loss), precision="bf16-mixed")
    assert mixed[0] == pytest.approx(exact[0], rel=0.05) and mixed != exact
    assert int(program.skipped) == 0 and all(p.dtype == torch.float32 for p in program.parameters())
    seen = []
    program.net.update.register_forward_hook(lambda m, i, out: seen.append(out[1].dtype))
    with torch.autocast("cpu", torch.bfloat16):
        terms, _ = program.forward_terms(runs.batch(), "joint")
    assert seen == [torch.bfloat16] * 3
    assert terms.rotation[-1].dtype == terms.flow[-1].dtype == torch.float32


def test_augmentation_is_part_of_a_step_and_repeats(tmp_path, runs):
    pytest.importorskip("kornia")
    options = {"augmentation": Augmentation(colour=1.0, zoom=1.0)}
    _, a = runs.fit(tmp_path, 2, runs.module(**options))
    _, b = runs.fit(tmp_path, 2, runs.module(**options))
    _, plain = runs.fit(tmp_path, 2)
    assert a == b != plain


def test_bad_input_is_one_line_and_code_2(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train", "study", "--config", str(tmp_path / "none.yaml")])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    assert "no such file" in capsys.readouterr().err
