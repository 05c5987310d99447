"""``python -m train fit``: beginning, length and folder of a run, and what is refused."""

import sys
from pathlib import Path

import pytest
import yaml

import dvo.models.registry
from dvo.data.files.root import data_root
from dvo.models.weights import load_weights
from train.__main__ import main
from train.engine.checkpoint import read_state

ROOT = Path(__file__).resolve().parents[3]
NAME = "two_frame_rotation"
SETTINGS = {
    "task": "tests.support.rotation_task:RotationTask",
    "trainer": {
        "accelerator": "cpu", "devices": 1, "max_epochs": -1, "log_every_n_steps": 1, "enable_model_summary": False,
        "use_distributed_sampler": False,
        "callbacks": [
            {"class_path": "lightning.pytorch.callbacks.ModelCheckpoint",
             "init_args": {"save_last": True, "every_n_train_steps": 1, "enable_version_counter": False}},
        ],
    },
    "model": {"learning_rate": 1e-2},
    "data": {"frames": 2, "sizes": [[48, 64]], "workers": 0, "seed": 5},
}  # fmt: skip


@pytest.fixture
def fit(tmp_path, monkeypatch):
    """``fit("--name", "a")`` trains a small network of two frames, in an empty working folder."""
    dvo.models.registry.ARCHITECTURES.register(NAME, "tests.support.rotation_task:RotationRegressor")
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(SETTINGS))
    monkeypatch.chdir(tmp_path)

    def call(*arguments, verb=("fit", "--config", "settings.yaml")):
        monkeypatch.setattr(sys, "argv", ["train", *verb, *map(str, arguments)])
        main()

    yield call
    dvo.models.registry.ARCHITECTURES.unregister(NAME)


@pytest.fixture
def refused(fit, capsys):
    """``refused("--steps", 0)`` is the one line with which a run is refused."""

    def call(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            fit(*arguments)
        assert stopped.value.code == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith(("error: ", "train: error: "))
        return line

    return call


@pytest.mark.long
def test_a_run_is_begun_resumed_and_the_start_of_another(fit, refused, capsys, tmp_path):
    fit("--name", "a", "--steps", 2)
    said = capsys.readouterr().out
    assert "runs/train/a: step 0 + 2; new run from random weights\nclips: rendered\n" in said
    assert "step 0 + 2 of 2" in said and "before the first step" not in said
    assert {path.name for path in tmp_path.iterdir()} == {"settings.yaml", "runs"}
    assert {path.name for path in (tmp_path / "runs/train").iterdir()} == {"a"}
    assert {"last.ckpt", "csv", "tensorboard"} < {path.name for path in (tmp_path / "runs/train/a").iterdir()}

    assert "--resume to go on with it, or --name RUN" in refused("--name", "a", "--steps", 2)
    assert read_state("runs/train/a/last.ckpt")["global_step"] == 2
    fit("--name", "a", "--steps", 1, "--resume")
    said = capsys.readouterr().out
    assert "step 2 + 1 of 1" in said and "before the first step" not in said
    assert read_state("runs/train/a/last.ckpt")["global_step"] == 3

    state = "runs/train/a/last.ckpt"
    line = refused("--name", "b", "--from", state, "--trainer.max_steps", 3)
    assert f"{state}: trainer.max_steps: 3 is not beyond step 3" in line and "--steps N" in line
    fit("--name", "b", "--from", state, "--steps", 2, "--model.learning_rate", "1e-3")
    said = capsys.readouterr().out
    assert said.index("before the first step: loss ") < said.index("step 3 + 1 of 2") and "step 3 + 2 of 2" in said
    found = read_state("runs/train/b/last.ckpt")
    assert found["global_step"] == found["Renderings"]["clips_seen"] == found["provenance"]["rendered"] == 5
    assert found["lr_schedulers"][0]["base_lrs"] == [1e-3] and read_state(state)["global_step"] == 3

    fit("runs/train/b/last.ckpt", "w.safetensors", verb=["export"])
    fit("--name", "c", "--from", "w.safetensors", "--steps", 1, "--trainer.default_root_dir", "elsewhere")
    assert "step 0 + 1; new run from the weights w.safetensors" in capsys.readouterr().out
    fit("--name", "d", "--steps", 1, "--trainer.callbacks", "null")  # every run leaves a state
    assert read_state("runs/train/d/last.ckpt")["global_step"] == 1
    fit("elsewhere/c/last.ckpt", "v.safetensors", verb=["export"])
    card = load_weights("v.safetensors").info.card
    assert card["steps"] == 1 and card["started_from"]["card"]["steps"] == 5 and card["licence"] == "MIT"


@pytest.mark.long
def test_what_would_train_nothing_is_refused(refused, tmp_path):
    assert "--steps: 0 steps would train nothing" in refused("--steps", 0)
    assert "model.learning_rate: zero at every step" in refused("--steps", 1, "--model.learning_rate", 0)
    assert "data.real.folders: no recordings are named" in refused("--steps", 1, "--data.real.folders", "[]")
    assert "data.batch_size: 0 is too small" in refused("--steps", 1, "--data.batch_size", 0)
    assert "give --from FILE" in refused("--ckpt_path", "last").replace("Give", "give")
    assert not list(tmp_path.rglob("last.ckpt"))


@pytest.mark.parametrize("options", [("--model.loss.weight", 0), ("--trainer.limit_train_batches", 0)])
def test_a_run_that_trained_nothing_is_an_error(fit, options, capsys):
    with pytest.raises(SystemExit) as stopped:
        fit("--steps", 2, *options, "--trainer.callbacks", "null", "--trainer.enable_checkpointing", "false")
    assert stopped.value.code == 2
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("error: ")


@pytest.mark.long
def test_options_that_do_not_parse_are_one_line(refused):
    assert "unrecognized arguments: --nonsense" in refused("--nonsense")
    assert "model.learning_rate: Expected a float. Got value: abc" in refused("--model.learning_rate", "abc")
    assert "trainer: MemoryError" in refused("--steps", 1, "--trainer.devices", 10**17)
    assert "seed_everything: out of range: -1" in refused("--seed_everything", -1)
    assert "hops: Expected a list. Got value: abc" in refused("--data.real.hops", "abc")


@pytest.mark.parametrize("field", ["seed_everything", "data.batch_size", "model.clip", "trainer.max_steps"])
def test_a_setting_without_a_value_is_named(field, refused, tmp_path):
    """A file with ``batch_size:`` and nothing behind it, which the parser lets pass."""
    section, _, name = field.rpartition(".")
    (tmp_path / "empty.yaml").write_text(yaml.safe_dump({section: {name: None}} if section else {name: None}))
    assert field in refused("--steps", 1, "--config", "empty.yaml")


@pytest.mark.parametrize(("field", "name"), [("loss", "pose"), ("augmentation", "zoom")])
def test_a_setting_of_a_table_without_a_value_is_named(field, name, monkeypatch, tmp_path, capsys):
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump({"task": "patch_vo", "model": {field: {name: None}}}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train", "fit", "--config", "settings.yaml", "--steps", "1"])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"{name}: must be a number, got None" in line


@pytest.mark.parametrize("given", ["nowhere", "[nowhere]"])
def test_a_folder_of_recordings_needs_no_brackets(fit, given, capsys):
    with pytest.raises(SystemExit):
        fit("--steps", 1, "--data.real.folders", given, "--trainer.logger", "false")
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("error: nowhere: no such file or folder")


@pytest.mark.slow
@pytest.mark.skipif(not (data_root(required=False) / "tartanair_v2_10").is_dir(), reason="set DVO_DATA")
def test_fine_tuning_as_the_readme_says(fit, capsys):
    """Its command trains, and the card tells on what; one step on small images instead of many."""
    text = (ROOT / "docs" / "training.md").read_text(encoding="utf-8")
    block = next(block for block in text.split("```bash\n")[1:] if "--name tuned" in block).split("```")[0]
    lines = block.replace("\\\n", " ").strip().splitlines()
    commands = [line.split("#")[0].removeprefix("python -m train ").split() for line in lines]
    training, exporting = (next(words for words in commands if words[0] == verb) for verb in ("fit", "export"))
    training[training.index("DIR")] = str(data_root() / "tartanair_v2_10")
    training[training.index("--steps") + 1] = "1"
    training = [str(ROOT / word) if word.startswith(("configs/", "train/")) else word for word in training]
    quick = ["--data.workers=0", "--data.sizes=[[48,64]]", "--data.frames=4", "--trainer.log_every_n_steps=1"]
    fit(*quick, verb=training)
    assert " + 1 of 1" in capsys.readouterr().out
    fit(verb=exporting)
    card = load_weights("tuned.safetensors").info.card
    assert card["recordings"] == ["tartanair_v2_10"] and card["recorded_clips"] == 1 < card["rendered_clips"]
    assert card["licence"] == "as the recordings allow" and "recordings tartanair_v2_10 (1 clip)" in card["data"]
