"""The self-supervised task: learning without labels, the teacher's state, resuming, starts, configuration."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import yaml

import dvo
from dvo.core.errors import DvoError
from dvo.losses.consistency import Limits
from dvo.models.weights import save_weights
from train.data.augment import Augmentation
from train.data.degrade import Degradation
from train.data.mixture import LabelledRenderings, Mixture
from train.engine.build import make_program
from train.engine.checkpoint import read_state
from train.engine.run import Start, start_of_task
from train.tasks.patch_vo.objective import LossConfig
from train.tasks.selfsup import task as selfsup
from train.tasks.selfsup.objective import ConsistencyConfig
from train.tasks.selfsup.task import SelfSupervisedTask
from train.tasks.selfsup.teacher import TeacherConfig, flat_weights, teach
from train.tasks.task import StepContext

ALL = Limits(confidence=0.0, residual=1e9, disagreement=1e9, share=0.0)
SHORT = TeacherConfig(updates=4, patches=4)


def program(**changes):
    torch.manual_seed(0)
    options = {"model": "tiny", "updates": 3, "initial": 3, "settle": 1, "teacher": SHORT, "limits": ALL, "warmup": 1}
    one = make_program("selfsup", **(options | changes))
    one.trained.fill_(True)  # as if the random weights had been loaded
    return one


def mixture(**changes):
    return Mixture(**({"seed": 5, "frames": 4, "sizes": [(48, 64)], "workers": 0} | changes))


def unlabelled(batch):
    return batch | {name: torch.full_like(batch[name], torch.nan) for name in ("depth", "poses_cw")}


def test_a_lesson_without_trust_teaches_nothing(runs):
    one, batch = program(limits=Limits(residual=0.0)), unlabelled(runs.batch(0, sizes=[(48, 64)]))
    found = one.task.compute_loss(one.context, batch)
    assert found.loss == 0 and found.shown["trusted"] == 0
    found.loss.backward()
    assert all(p.grad is None or (p.grad == 0).all() for p in one.net.parameters())


@pytest.mark.long
def test_the_loss_falls_without_labels(runs):
    """A student away from its teacher comes back to it, on clips that it sees degraded."""
    one = program(limits=replace(ALL, share=0.0), degradation=Degradation(noise=1.0, light=0.0, blur=0.0))
    batch = unlabelled(runs.batch(0, sizes=[(48, 64)]))
    one.task.compute_loss(one.context, batch)  # the teacher is set
    with torch.no_grad():
        for number, parameter in enumerate(one.net.parameters()):
            parameter += (
                0.2
                * parameter.std(correction=0)
                * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(number))
            )
    optimizer = torch.optim.AdamW(one.net.parameters(), 1e-3)
    targets = []
    for _ in range(15):
        found = one.task.compute_loss(StepContext(one.net, 0, one.context.buffers), batch)
        optimizer.zero_grad()
        found.loss.backward()
        torch.nn.utils.clip_grad_norm_(one.net.parameters(), 10.0)
        optimizer.step()
        targets.append(float(found.measures["target"]))
    assert targets[-1] < 0.7 * targets[0]


# -- the teacher's state ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("decay", [1.0, 0.5])
def test_a_teacher_stays_or_follows(runs, decay, monkeypatch):
    pytest.importorskip("kornia")
    one = program(teacher=replace(SHORT, decay=decay))
    batch, start = unlabelled(runs.batch(0, sizes=[(48, 64)])), flat_weights(one.net)
    teachers = []
    monkeypatch.setattr(selfsup, "teach", lambda net, *given: teachers.append(net) or teach(net, *given))
    found = one.task.compute_loss(one.context, batch)
    assert torch.equal(one.teacher, start)
    with torch.no_grad():
        for parameter in one.net.parameters():
            parameter += 1
    one.task.accept_loss(one.context, found)
    torch.testing.assert_close(one.teacher, start + (1 - decay))
    one.task.compute_loss(one.context, batch)
    assert torch.equal(flat_weights(teachers[1]), one.teacher)


@pytest.mark.slow
def test_resumed_training_equals_uninterrupted_training(tmp_path, runs):
    pytest.importorskip("kornia")
    options = {
        "augmentation": Augmentation(zoom=1.0, exposure=1.0), "degradation": Degradation(0.5, noise=1.0, blur=1.0),
        "teacher": replace(SHORT, decay=0.9), "learning_rate": 1e-3,
    }  # fmt: skip
    data = {"seed": 1, "labelled": LabelledRenderings(share=0.5)}
    assert {mixture(**data).kind(batch) for batch in range(4)} == {"labelled", "rendered"}
    whole = runs.check_resuming(tmp_path, 4, lambda: program(**options), lambda: mixture(**data))
    saved = read_state(tmp_path / "stopped" / "last.ckpt")["state_dict"]
    assert saved["teaching"] and not torch.equal(saved["teacher"], torch.zeros_like(saved["teacher"]))
    assert not torch.equal(whole.teacher, flat_weights(whole.net))


def test_clips_with_poses_are_those_of_the_supervised_task(runs):
    one, batch = program(supervised=LossConfig(flow=0.3, balance="fixed", beta=7.0)), runs.batch(0)
    other = runs.module(loss=LossConfig(flow=0.3, balance="fixed", beta=7.0))
    found = one.task.compute_loss(one.context, batch)
    wanted = other.task.compute_loss(StepContext(one.net, 0, other.context.buffers), batch)
    assert torch.equal(found.loss, wanted.loss) and "labelled_translation" in found.measures
    assert one.task.measure(one.net, batch, 0) == other.task.measure(one.net, batch, 0)
    with pytest.raises(DvoError, match="supervised.balance"):
        SelfSupervisedTask(supervised=LossConfig(balance="v2v"))


# -- beginning and configuration -------------------------------------------------------------------------------------


def test_a_run_starts_from_weights_or_from_the_average_of_a_supervised_state(tmp_path, runs):
    torch.manual_seed(0)
    blank = make_program("selfsup", model="tiny", teacher=SHORT)
    with pytest.raises(DvoError, match="--from: there are no trained weights"):
        blank.task.compute_loss(blank.context, unlabelled(runs.batch(0)))
    runs.fit(tmp_path, 2)
    file = tmp_path / "last.ckpt"
    state = read_state(file)
    start = start_of_task(Start(file, state), "selfsup")
    assert start.state is None and start.step == 0 and start.record.rendered == 2
    for name, value in start.weights.model.state_dict().items():
        assert torch.equal(value, state["state_dict"][f"average.{name}"])
    same = Start(file, state)
    assert start_of_task(same, "patch_vo") is same and start_of_task(same, "deepvo") is same
    resumed = Start(file, state, resumed=True)
    assert start_of_task(resumed, "selfsup") is resumed


@pytest.mark.parametrize("change", [{"window": 4}, {"flow": -1.0}, {"reach": 0}])
def test_bad_weights_of_the_loss_are_refused(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        ConsistencyConfig(**change)


def test_a_teacher_with_too_few_updates_is_refused(runs):
    one = program(initial=2, settle=3, teacher=TeacherConfig(updates=2, patches=0))
    with pytest.raises(DvoError, match="model.teacher.updates"):
        one.task.compute_loss(one.context, unlabelled(runs.batch(0)))


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "walk"
    folder.mkdir()
    noise = np.random.default_rng(1).integers(0, 255, (60, 200, 3), dtype=np.uint8)
    wall = cv2.GaussianBlur(noise, (0, 0), 2.0)
    for number in range(10):
        cv2.imwrite(str(folder / f"{number:04d}.png"), wall[4:52, 3 * number : 3 * number + 64])
    (folder / "calib.txt").write_text("50 50 31.5 23.5\n")
    return folder


@pytest.mark.slow
def test_the_shipped_configuration_trains_resumes_and_exports(tmp_path, runs, recording, command):
    """With sizes for a test, from a state of ``patch_vo``, on a folder of images without poses."""
    pytest.importorskip("kornia")
    settings = runs.shipped("selfsup", tmp_path)
    settings["trainer"] |= {"max_steps": -1, "logger": False}
    settings["model"] |= {"model": "tiny", "updates": 3, "initial": 3, "settle": 1, "teacher": {"updates": 4}}
    settings["model"]["limits"] = {"confidence": 0.0, "residual": 1e9, "disagreement": 1e9, "share": 0.0}
    settings["data"] |= {"frames": 4, "sizes": [[48, 64]], "workers": 0, "labelled": {"share": 0.0}}
    file = tmp_path / "settings.yaml"
    file.write_text(yaml.safe_dump(settings))
    (tmp_path / "start").mkdir()
    runs.fit(tmp_path / "start", 1)

    def refused(*arguments):
        with pytest.raises(SystemExit) as stopped:
            command("fit", "--config", file, *arguments)
        assert stopped.value.code == 2

    refused("--steps", 1)  # no recordings
    folders = ("--data.real.folders", recording, "--data.real.calib", "calib.txt")
    refused("--steps", 1, "--name", "blank", *folders)  # random weights
    command("fit", "--config", file, "--from", tmp_path / "start" / "last.ckpt", "--steps", 2, *folders)
    command("fit", "--config", file, "--resume", "--steps", 1, *folders)
    state = read_state(tmp_path / "selfsup" / "last.ckpt")
    assert state["global_step"] == 3 and state["task"] == "selfsup" and state["Mixture"] == {"clips_seen": 3}
    assert state["provenance"]["recordings"] == ["walk"] and state["provenance"]["rendered"] == 1
    weights = tmp_path / "mine.safetensors"
    command("export", tmp_path / "selfsup" / "last.ckpt", weights)
    last = tmp_path / "last.safetensors"
    command("export", tmp_path / "selfsup" / "last.ckpt", last, "--which", "net")
    for exported, which in ((weights, "average"), (last, "net")):
        found = dvo.load_model(exported).state_dict()["update.d.1.weight"]
        torch.testing.assert_close(found, state["state_dict"][f"{which}.update.d.1.weight"], atol=1e-3, rtol=1e-3)
    assert weights.read_bytes() != last.read_bytes()
    card = dvo.models.weights.load_weights(weights).info.card
    assert card["recorded_clips"] == 3 and "recordings allow" in card["licence"]
    save_weights(tmp_path / "w.safetensors", program().average, {"licence": "MIT"}, half=False)
    command("fit", "--config", file, "--from", tmp_path / "w.safetensors", "--steps", 1, "--name", "w", *folders)
    assert read_state(tmp_path / "w" / "last.ckpt")["state_dict"]["trained"]
