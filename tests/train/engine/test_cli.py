"""The command line: a step of every configuration, the task that it names, and bad input."""

import sys
from pathlib import Path

import pytest
import torch
import yaml

from train.__main__ import COMMANDS, main
from train.engine.cli import named_task

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "train"
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
    file = tmp_path / f"{name}.yaml"
    text = (CONFIGS / file.name).read_text()
    assert "task: patch_vo\n" in text
    file.write_text(text.replace("task: patch_vo\n", "") if name == "small" else text)  # the key may be left out
    folder = f"--trainer.default_root_dir={tmp_path}"
    monkeypatch.setattr(sys, "argv", ["train", "fit", f"--config={file}", folder, *settings])
    main()
    # what the run wrote down is what was asked for
    found = yaml.safe_load(next(tmp_path.rglob("config.yaml")).read_text())
    assert found["model"]["model"] == "tiny" and found["model"]["loss"]["balance"] == "none"
    assert found["task"] == "patch_vo"
    assert found["model"]["cycle"] == (240000 if name == "full" else None)


def test_the_task_is_named_by_the_configuration(tmp_path):
    old, new, broken = (tmp_path / f"{name}.yaml" for name in ("old", "new", "broken"))
    old.write_text("model: {model: tiny}")
    new.write_text("task: package.module:Class")
    broken.write_text("a: [")
    assert named_task(["fit", "--config", str(old)]) == "patch_vo"
    assert named_task(["fit", f"--config={new}", f"--config={old}"]) == "package.module:Class"
    assert named_task(["fit", "-c", str(new), "--task=other"]) == "other"
    assert named_task(["fit", "--config", str(broken), "--config"]) == "patch_vo"


@pytest.mark.parametrize(
    "command",
    ["study --config {0}/none", "export {0}/none {0}/out", "state {0}/none.ckpt {0}/out", "snr {0}/none.ckpt",
     "validate {0}/none.ckpt", "validate {0}/none", "export {0}/noise {0}/out", "validate {0}/noise.ckpt",
     "export {0}/other.ckpt {0}/out", "fit --config {0}/unknown.yaml", "fit --task no.such_module:Class",
     "nonsense", "", "--config {0}/unknown.yaml"],
)  # fmt: skip
def test_bad_input_is_one_line_and_code_2(command, tmp_path, monkeypatch, capsys):
    for name in ("noise", "noise.ckpt"):
        (tmp_path / name).write_bytes(b"noise")
    torch.save({"a": 1}, tmp_path / "other.ckpt")
    (tmp_path / "unknown.yaml").write_text("task: unknown")
    monkeypatch.setattr(sys, "argv", ["train", *command.format(tmp_path).split()])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ") and not (tmp_path / "out").exists()


def test_help_names_the_commands(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train", "--help"])
    main()
    said = capsys.readouterr().out
    assert all(f"``{command}" in said for command in COMMANDS) and "--resume" in said
