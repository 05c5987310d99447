"""A network, its task and its odometry from outside: trained, resumed, exported and loaded by name, while no file of
``dvo`` or ``train`` mentions them."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from safetensors import safe_open

import dvo
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.models.registry import ARCHITECTURES
from dvo.odometry.registry import ODOMETRIES
from dvo.session.session import run
from train.__main__ import main
from train.engine.build import make_program
from train.engine.checkpoint import load_any, read_state
from train.studies import snr, study
from train.studies.config import StudyConfig
from train.studies.report import write_report
from train.tasks.registry import TASKS

NAME = "two_frame_rotation"


@pytest.fixture(autouse=True)
def outside_package():
    """The module is importable, as if it were installed with entry points."""
    registries = (ARCHITECTURES, ODOMETRIES, TASKS)
    for registry, target in zip(registries, ("RotationRegressor", "RotationOdometry", "RotationTask"), strict=True):
        registry.register(NAME, f"tests.support.rotation_task:{target}")
    yield
    for registry in registries:
        registry.unregister(NAME)


@pytest.fixture
def command(monkeypatch):
    """``command("export", ...)`` runs ``python -m train export ...`` in this process."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["train", *map(str, arguments)])
        main()

    return call


def configuration(folder, steps, watched=False):
    """A configuration as a user would write it."""
    folder.mkdir(exist_ok=True)
    saver = {"dirpath": str(folder), "save_last": True, "every_n_train_steps": 1, "enable_version_counter": False}
    watch = {
        "every": 4 if watched else 100,
        "rendered": int(watched),
        "frames": 4,
        "size": [48, 64],
    }
    settings = {
        "task": NAME,
        "trainer": {
            "accelerator": "cpu", "devices": 1, "max_epochs": -1, "max_steps": steps, "log_every_n_steps": 1,
            "enable_progress_bar": False, "enable_model_summary": False, "use_distributed_sampler": False,
            "default_root_dir": str(folder),
            "callbacks": [
                {"class_path": "lightning.pytorch.callbacks.ModelCheckpoint", "init_args": saver},
                {"class_path": "train.validation.watch.TrackWhileTraining", "init_args": watch},
            ],
        },
        "model": {"channels": 6, "learning_rate": 1e-2, "loss": {"weight": 2.0}},
        "data": {"frames": 2, "sizes": [[48, 64]], "workers": 0, "seed": 5},
    }  # fmt: skip
    file = folder / "settings.yaml"
    file.write_text(yaml.safe_dump(settings))
    return file


@pytest.mark.long
def test_from_a_configuration_to_a_trajectory(tmp_path, command, capsys):
    command("fit", "--config", configuration(tmp_path / "whole", 4, watched=True))
    command("fit", "--config", configuration(tmp_path / "parts", 2))
    command("fit", "--config", configuration(tmp_path / "parts", 4), "--resume")
    whole, parts = (read_state(tmp_path / name / "last.ckpt") for name in ("whole", "parts"))
    assert whole["global_step"] == parts["global_step"] == 4 and whole["task"] == NAME
    assert whole["Renderings"] == parts["Renderings"] == {"clips_seen": 4}
    assert whole["state_dict"]["seen"] == 4
    for name, tensor in whole["state_dict"].items():
        assert torch.equal(tensor, parts["state_dict"][name]), name
    assert torch.equal(
        whole["state_dict"]["net.layers.1.running_var"], whole["state_dict"]["average.layers.1.running_var"]
    )
    logged = (tmp_path / "whole" / "csv" / "version_0" / "metrics.csv").read_text().splitlines()[0]
    assert {"loss", "error", "gradient_norm", "track/rendered0/rotation_ratio"} <= set(logged.split(","))

    weights = tmp_path / "turn.safetensors"
    command("export", tmp_path / "whole" / "last.ckpt", weights)
    with safe_open(weights, "pt") as file:
        assert file.metadata()["architecture"] == NAME
    assert "two_frame_rotation" in str(dvo.load_model(weights).architecture)
    noise, camera = np.random.default_rng(0), Camera(50, 50, 31.5, 23.5, 64, 48)
    clip = [Frame(i, 0.1 * i, noise.integers(0, 255, (48, 64, 3), np.uint8), camera) for i in range(4)]
    result = run(dvo.load(str(weights), gain=2.0), clip).result
    assert len(result.trajectory) == 4
    same = run(dvo.load(str(weights), gain=2.0), clip).result
    assert (result.trajectory.poses_wc == same.trajectory.poses_wc).all()
    with pytest.raises(DvoError, match="gain"):
        dvo.load(str(weights), gain=-1.0)

    capsys.readouterr()
    for file in (weights, tmp_path / "whole" / "last.ckpt"):
        command("validate", file, "--sequences", "--rendered=0", "--set", "gain=0.5")
    command("snr", tmp_path / "whole" / "last.ckpt", "--clips=4", "--frames=2", "--size", "48", "64")
    assert "pure noise would have about 0.500" in capsys.readouterr().out


@pytest.mark.long
def test_a_task_by_module_and_class(runs, tmp_path):
    """Without any registration of the task; the state goes on under the same name only."""
    TASKS.unregister(NAME)
    program = make_program("tests.support.rotation_task:RotationTask", channels=3, learning_rate=1e-2)
    assert program.settings.learning_rate == 1e-2 and program.hparams["channels"] == 3
    _, losses = runs.fit(tmp_path, 6, program, data=runs.data(sizes=[(48, 64)]))
    assert None not in losses and losses[-1] != losses[0]
    assert load_any(tmp_path / "last.ckpt").architecture == NAME
    again = make_program("tests.support.rotation_task:RotationTask", channels=3)
    runs.fit(tmp_path, 7, again, tmp_path / "last.ckpt", data=runs.data(sizes=[(48, 64)]))
    assert int(again.seen) == 7
    with pytest.raises(DvoError, match="task: the state is of the task 'tests.support.rotation_task:RotationTask'"):
        runs.module().on_load_checkpoint(read_state(tmp_path / "last.ckpt"))


def test_settings_that_neither_task_nor_engine_has():
    with pytest.raises(DvoError, match="chanels"):
        make_program(NAME, chanels=3)
    with pytest.raises(DvoError, match="weigth"):
        make_program(NAME, loss={"weigth": 3})
    with pytest.raises(DvoError, match="no task 'none'.*patch_vo"):
        make_program("none")


@pytest.mark.long
def test_a_study_of_another_task(tmp_path):
    config = StudyConfig(
        folder=str(tmp_path), task=NAME, frames=2, size=(48, 64), start={}, start_steps=1, steps=2, seeds=(0,),
        clips=2, validate_every=1, validation_clips=1, base={}, arms={"once": {}, "twice": {"weight": 2.0}},
        measures={"error": "error"},
    )  # fmt: skip
    once, twice = (study.run_arm(arm, 1e-3, 0, config) for arm in config.arms)
    assert [row["step"] for row in once["curve"]] == [0, 1, 2]
    assert twice["curve"][0]["error"] == pytest.approx(2 * once["curve"][0]["error"])
    config = replace(config, rates=(1e-3,), out=str(tmp_path / "report"))
    assert all(path.exists() for path in write_report([once, twice], config))


def test_its_gradients_have_a_ratio(runs):
    program = make_program(NAME)
    found = snr.clip_gradients(program.task, program.net, runs.batch(), 0)
    assert list(found) == ["loss"] and len(found["loss"]) == sum(p.numel() for p in program.net.parameters())
