"""Beginning, length and folder of a run; runs that would train nothing."""

from pathlib import Path

import lightning as L
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.models.weights import LoadedWeights, load_weights, save_weights
from train.engine.callbacks import RefuseStandstill, StopGently
from train.engine.checkpoint import read_state
from train.engine.run import Start, describe, find_start, place_outputs, prepare, run_folder, stop_step
from train.tasks.patch_vo.objective import LossConfig


def test_the_folder_of_a_run():
    assert run_folder("tuned", None, "patch_vo") == Path("runs/train/tuned")
    assert run_folder("tuned", "/data", "patch_vo") == Path("/data/tuned")
    assert run_folder(None, "/data/x", "patch_vo") == Path("/data/x")
    assert run_folder(None, None, "package.module:Class") == Path("runs/train/package.module.Class")
    for name in ("", "..", "a/b", "/tmp/a", "a\\b"):
        with pytest.raises(DvoError, match="--name: .* is no name of a folder"):
            run_folder(name, None, "patch_vo")


@pytest.fixture(scope="module")
def last(tmp_path_factory):
    """A state at step 3, in the folder of a run."""
    file = tmp_path_factory.mktemp("run") / "last.ckpt"
    torch.save({"state_dict": {}, "hyper_parameters": {}, "global_step": 3}, file)
    return file


def test_a_run_goes_on_only_if_asked_to(last, tmp_path):
    assert find_start(tmp_path, None, False) == Start()
    resumed = find_start(last.parent, None, True)
    assert resumed.resumed and resumed.checkpoint == last and resumed.step == 3
    for folder, source, resume, match in (
        (last.parent, None, False, r"a run is there already, at step 3\. Give --resume .* or --name"),
        (last.parent, str(last), False, "a run is there already"),
        (last.parent, str(last), True, "give one of the two|Give one of the two"),
        (tmp_path, None, True, "there is no run to go on with"),
        (tmp_path, str(tmp_path / "none.ckpt"), False, "no such file"),
        (tmp_path, "no_such_weights", False, "no such weights"),
    ):
        with pytest.raises(DvoError, match=match):
            find_start(folder, source, resume)


def test_a_new_run_begins_with_a_state_or_weights(last, tmp_path):
    state, weights = find_start(tmp_path, str(last), False), find_start(tmp_path, "small", False)
    assert (state.resumed, state.checkpoint, state.step) == (False, last, 3)
    assert (weights.checkpoint, weights.step) == (None, 0) and weights.weights.name == "small"


def test_steps_count_from_the_state(last):
    start = find_start(last.parent, None, True)
    assert stop_step(start, 20, 2) == 23 and stop_step(Start(), 20, -1) == 20
    assert stop_step(start, None, 4) == 4 and stop_step(start, None, -1) == -1
    for steps, most, match in ((None, 3, "--steps N"), (None, 0, "not beyond step 3"), (0, 9, "train nothing")):
        with pytest.raises(DvoError, match=match):
            stop_step(start, steps, most)


def test_a_learning_rate_of_zero_is_refused(last, runs):
    prepare(runs.module(), Start(), 10)
    prepare(runs.module(decay_from=5, decay_steps=5), Start(), -1)
    state = {"state_dict": {f"net.{k}": v for k, v in runs.module().net.state_dict().items()}, "global_step": 10}
    resumed = Start(last, state | {"lr_schedulers": [{"base_lrs": [0.0]}]}, resumed=True)
    for settings, start in (
        ({"learning_rate": 0.0}, Start()),
        ({"decay_from": 5, "decay_steps": 5}, Start(last, state)),
        ({}, resumed),
    ):
        with pytest.raises(DvoError, match="model.learning_rate: zero at every step from"):
            prepare(runs.module(**settings), start, 20)


def test_the_rate_of_a_state_stays_in_its_run_and_is_told(last, runs):
    program = runs.module(learning_rate=1e-3)
    state = {"global_step": 3, "lr_schedulers": [{"base_lrs": [5e-4]}]}
    told = describe(program, Start(last, state, resumed=True), 23, last.parent)
    assert told[0].endswith("step 3 + 20; goes on") and "stays 0.0005" in told[1]
    assert describe(program, Start(last, state), -1, last.parent)[0].startswith(
        f"{last.parent}: step 3, without end; new"
    )
    assert len(describe(program, Start(last, state), 4, last.parent)) == 1


def test_settings_that_differ_from_those_of_the_state_are_told(last, runs):
    program = runs.module(updates=5)
    state = {"global_step": 3, "hyper_parameters": dict(program.hparams) | {"updates": 3, "no_longer": 1}}
    told = describe(program, Start(last, state, resumed=True), 23, last.parent)
    assert told[1:] == ["note: changed since the last step: model.updates from 3 to 5"]


def test_a_start_of_another_network_is_refused(runs, tmp_path):
    with pytest.raises(DvoError, match="small.*where the network of the configuration has"):
        prepare(runs.module(), Start("small", weights=load_weights("small")), 5)
    runs.fit(tmp_path, 1)
    state = read_state(tmp_path / "last.ckpt")
    with pytest.raises(DvoError, match="where the network"):
        prepare(runs.module(model="small"), Start(tmp_path / "last.ckpt", state), 5)
    with pytest.raises(DvoError, match="task 'other'"):
        prepare(runs.module(), Start(tmp_path / "last.ckpt", state | {"task": "other"}), 5)


def test_weights_are_the_start_of_network_and_average(runs, tmp_path):
    save_weights(tmp_path / "tiny.safetensors", runs.module().average, {"licence": "MIT"}, half=False)
    weights = load_weights(tmp_path / "tiny.safetensors")
    torch.manual_seed(9)
    program = runs.module(warmup_until=0.5)
    for parameter in program.net.parameters():
        parameter.data.zero_()
    prepare(program, Start("tiny", weights=weights), 5)
    for module in (program.net, program.average):
        for name, value in module.state_dict().items():
            assert torch.equal(value, weights.model.state_dict()[name]), name
    assert not program.warming  # of a network that does not see flow yet
    assert isinstance(weights, LoadedWeights) and program.provenance.start["name"] == "tiny"


@pytest.mark.long
@pytest.mark.parametrize("resumed", [True, False])
def test_a_new_run_from_a_state_has_rates_of_its_own(runs, tmp_path, resumed):
    runs.fit(tmp_path, 1, runs.module(learning_rate=1e-3, warmup=1))
    program = runs.module(learning_rate=1e-5, warmup=1)
    prepare(program, Start(tmp_path / "last.ckpt", read_state(tmp_path / "last.ckpt"), resumed=resumed), 3)
    rates = []

    class Rates(L.Callback):
        def on_before_optimizer_step(self, trainer, pl_module, optimizer):
            rates.append(optimizer.param_groups[0]["lr"])

    runs.fit(tmp_path, 3, program, tmp_path / "last.ckpt", callbacks=[Rates()])
    assert rates == [1e-3 if resumed else 1e-5] * 2 and program.global_step == 3
    assert program.provenance.rendered == 3


@pytest.mark.long
@pytest.mark.parametrize("shortest", [2, 3])
def test_a_run_without_gradients_ends(tmp_path, runs, shortest):
    program = runs.module(loss=LossConfig(pose=0.0, flow=0.0, target=0.0))
    with pytest.raises(DvoError, match="each of 2 steps, so nothing is trained"):
        runs.fit(tmp_path, shortest, program, callbacks=[RefuseStandstill(steps=2)])
    runs.fit(tmp_path, 2, callbacks=[RefuseStandstill(steps=1)], accumulate_grad_batches=3)


def test_outputs_go_to_the_folder_of_the_run(tmp_path):
    parts = [{"class_path": "a", "init_args": {"dirpath": None, "every": 3}}, {"class_path": "b"},
             {"class_path": "c", "init_args": {"save_dir": str(tmp_path / "x")}}]  # fmt: skip
    place_outputs(parts, tmp_path)
    assert parts[0]["init_args"] == {"dirpath": str(tmp_path), "every": 3} and parts[1] == {"class_path": "b"}
    with pytest.raises(DvoError, match="c: save_dir: .* outside of the folder of the run"):
        place_outputs(parts[1:], tmp_path / "y")


def test_stopping_saves_in_the_folder_of_the_trainer(tmp_path):
    trainer = L.Trainer(default_root_dir=tmp_path, logger=False, accelerator="cpu")
    assert StopGently().path(trainer) == tmp_path / "last.ckpt"
