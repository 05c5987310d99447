"""Training states: network, facts and position in them; copies that name no folder; the state in the repository."""

from pathlib import Path, PureWindowsPath

import lightning as L
import pytest
import torch
from safetensors import safe_open

import dvo
from dvo.core.errors import DvoError
from dvo.models.weights import load_weights
from dvo.nets.patch.config import PRESETS
from train.data.clips import Renderings
from train.engine import export
from train.engine.build import make_program
from train.engine.callbacks import StopGently
from train.engine.checkpoint import absolute_paths, facts_of, load_any, network_of, portable, read_state, task_of

STATE = Path(__file__).resolve().parents[3] / "train" / "state" / "small.ckpt"
stored = pytest.mark.skipif(not STATE.is_file(), reason="no training state in this checkout")


def equal(a, b):
    for (name, x), y in zip(a.state_dict().items(), b.state_dict().values(), strict=True):
        assert torch.equal(x, y), name


def test_export_takes_the_moving_average_and_names_the_architecture(tmp_path, runs, capsys):
    program, _ = runs.fit(tmp_path, 2)
    file, out = tmp_path / "last.ckpt", tmp_path / "out" / "w.safetensors"
    (tmp_path / "card.json").write_text('{"hours": 3}')
    export.export([str(file), str(out), "--card", str(tmp_path / "card.json")])
    card = load_weights(out).info.card
    assert (card["steps"], card["clips"], card["seed"], card["preset"], card["hours"]) == (2, 2, 0, "tiny", 3)
    with safe_open(out, "pt") as weights:
        assert weights.metadata()["architecture"] == "patch_vo"
        for name, tensor in program.average.state_dict().items():
            assert torch.equal(weights.get_tensor(name), tensor.half()), name
    loaded = load_any(file)
    assert (loaded.name, loaded.architecture, loaded.preset) == ("last", "patch_vo", "tiny")
    equal(loaded.model, program.average)
    equal(network_of(read_state(file), "net"), program.net)
    assert dvo.load(str(out)).name == "dvo-w"
    (tmp_path / "card.json").write_text("[1]")
    with pytest.raises(DvoError, match="card"):
        export.export([str(file), str(out), "--card", str(tmp_path / "card.json")])


def test_the_sizes_of_a_state_are_its_own(tmp_path, runs):
    runs.fit(tmp_path, 1, runs.module(patches=5))
    state = read_state(tmp_path / "last.ckpt")
    assert network_of(state).config.training_patches == 5 and facts_of(state)["preset"] == "custom"
    assert task_of(state).network().config.training_patches == 5
    assert task_of(state, updates=7, no_such_setting=1).updates == 7
    old = {key: value for key, value in state.items() if key not in ("network", "task")}
    assert network_of(old).config == PRESETS["tiny"]
    unnamed = state | {"network": {"config": state["network"]["config"]}}
    assert facts_of(unnamed) == facts_of(state)


def test_a_state_of_other_tensors_is_refused(tmp_path, runs):
    runs.fit(tmp_path, 1)
    state = read_state(tmp_path / "last.ckpt")
    for changed, match in (
        ({"network": {"architecture": "os:system", "config": {}}}, "no architecture 'os:system'"),
        ({"network": {"architecture": "patch_vo", "config": PRESETS["small"].to_dict()}}, "does not fit"),
        ({"network": {}, "hyper_parameters": {"model": "huge"}}, "no preset 'huge'"),
        ({"state_dict": {}}, "does not fit"),
    ):
        with pytest.raises(DvoError, match=match):
            network_of(state | changed)


def test_a_copy_for_the_repository_names_no_folder_and_resumes(tmp_path, runs):
    saver = L.pytorch.callbacks.ModelCheckpoint(tmp_path, filename="step", every_n_train_steps=2, save_top_k=1)
    data = runs.data(textures=None)
    data.hparams["textures"] = str(tmp_path)
    _, losses = runs.fit(tmp_path, 3, callbacks=[saver], data=data)
    state = read_state(tmp_path / "step.ckpt")
    assert str(tmp_path) in absolute_paths(state["callbacks"]) and absolute_paths(state["datamodule_hyper_parameters"])
    export.export_state([str(tmp_path / "step.ckpt"), str(tmp_path / "kept" / "tiny.ckpt")])
    kept = read_state(tmp_path / "kept" / "tiny.ckpt")
    others = {key: value for key, value in kept.items() if key not in ("state_dict", "optimizer_states")}
    assert not absolute_paths(others) and kept["callbacks"] == {}
    assert kept["datamodule_hyper_parameters"]["textures"] == tmp_path.name
    assert str(tmp_path) in absolute_paths(state["callbacks"])  # the original is not changed
    again, then = runs.fit(tmp_path, 3, runs.module(), tmp_path / "kept" / "tiny.ckpt", callbacks=[saver])
    assert then == losses[2:]


def test_absolute_paths_of_any_system():
    assert absolute_paths({"a": ["runs/x", "/home/x"], "/etc": (Path("/tmp"), 3, None)}) == ["/home/x", "/etc", "/tmp"]
    assert absolute_paths(str(PureWindowsPath("C:/Users/x"))) == ["C:\\Users\\x"]
    assert portable({"callbacks": {"a": {"step": 1}, "b": {"path": "/x"}}})["callbacks"] == {"a": {"step": 1}}


@stored
def test_the_state_of_the_shipped_weights_fits_the_program():
    state = read_state(STATE)
    program = make_program(model="small")
    program.load_state_dict(state["state_dict"], strict=True)
    program.on_load_checkpoint(state)
    optimizer = program.configure_optimizers()["optimizer"]
    optimizer.load_state_dict(state["optimizer_states"][0])
    equal(load_any(STATE).model, program.average)


@stored
def test_the_state_in_the_repository_names_no_folder():
    state = read_state(STATE)
    assert not absolute_paths({key: value for key, value in state.items() if key != "state_dict"})


@stored
def test_the_stored_state_goes_on_at_its_clip(tmp_path, recwarn):
    """The position in the stream is restored, not begun anew without a word."""
    state = read_state(STATE)
    data = Renderings(workers=0)
    program = make_program(model="small", learning_rate=4e-4, initial=4)
    trainer = L.Trainer(
        accelerator="cpu", max_steps=state["global_step"], max_epochs=-1, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(program, data, ckpt_path=STATE, weights_only=False)
    assert trainer.global_step == state["global_step"] > 7000
    assert data.clips_seen == state["Renderings"]["clips_seen"] > 7000
    assert next(iter(data.train_dataloader().sampler)) == data.clips_seen
    assert not any("no position" in str(warning.message) for warning in recwarn)


def test_a_position_that_is_lost_is_told(tmp_path, runs):
    class OtherClips(Renderings):
        """The same clips under another name, under which the state holds nothing."""

    runs.fit(tmp_path, 1)
    with pytest.warns(UserWarning, match="no position in .*OtherClips"):
        runs.fit(tmp_path, 2, runs.module(), tmp_path / "last.ckpt", data=OtherClips(**runs.clip))


def test_stopping_gently_saves_the_position(tmp_path, runs):
    class Stop(L.Callback):
        def on_train_batch_end(self, trainer, *_):
            trainer.should_stop = True

    runs.fit(tmp_path, 5, callbacks=[StopGently(str(tmp_path / "kept")), Stop()])
    state = read_state(tmp_path / "kept" / "last.ckpt")
    assert state["global_step"] == state["Renderings"]["clips_seen"] == 1
