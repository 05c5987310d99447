"""The distillation of an encoder: the loss falls, the rest is held, and training goes on with everything."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from dvo.core.errors import DvoError
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import save_weights
from dvo.nets.patch.config import PRESETS, preset
from train.data.augment import Augmentation
from train.engine.build import make_program
from train.engine.checkpoint import read_state, task_of
from train.engine.run import Start, start_of_task
from train.tasks.distil.task import DistilTask, agreeing_share, relative_error
from train.tasks.task import StepContext

CONFIGS = Path(__file__).parents[3] / "configs" / "train"


@pytest.fixture
def teacher(tmp_path, monkeypatch):
    """Weights of a tiny teacher; the preset ``light`` has its sizes."""
    torch.manual_seed(0)
    monkeypatch.setitem(PRESETS, "light", replace(preset("tiny"), encoder="light"))
    save_weights(tmp_path / "teacher.safetensors", PatchVO(preset("tiny")), {})
    return str(tmp_path / "teacher.safetensors")


def program(teacher, **changes):
    torch.manual_seed(1)
    return make_program("distil", **({"teacher": teacher, "warmup": 1, "learning_rate": 3e-3} | changes))


@pytest.mark.long
def test_the_loss_falls_and_the_update_operator_is_held(tmp_path, runs, teacher):
    one = program(teacher, augmentation=Augmentation(colour=0.0, zoom=0.5, exposure=0.5))
    given = {name: value.clone() for name, value in one.net.update.state_dict().items()}
    before = {name: value.clone() for name, value in one.net.patchify.state_dict().items()}
    batch = runs.batch(0, sizes=[(48, 64)])

    def loss():
        with torch.no_grad():
            return float(one.task.compute_loss(StepContext(one.net, 0, {}), batch).loss)

    first = loss()
    runs.fit(tmp_path, 10, one, data=runs.data(sizes=[(48, 64)]))
    assert loss() < 0.9 * first
    for net in (one.net, one.average):
        assert all(torch.equal(value, given[name]) for name, value in net.update.state_dict().items())
    assert all(not torch.equal(value, before[name]) for name, value in one.net.patchify.state_dict().items())


def test_the_teacher_itself_has_no_loss(runs, teacher):
    one = DistilTask("tiny", teacher)
    net = one.network()
    net.load_state_dict(one.origin().model.state_dict())
    found = one.compute_loss(StepContext(net, 0, {}), runs.batch(0, 1, sizes=[(48, 64)]))
    assert abs(found.loss) < 1e-5 and found.shown["agreement"] == 1
    assert set(found.shown) == {"matching_error", "context_error", "agreement"}


def test_the_supervised_task_goes_on_with_everything(tmp_path, runs, teacher):
    one, _ = runs.fit(tmp_path, 3, program(teacher), data=runs.data(sizes=[(48, 64)]))
    file = tmp_path / "last.ckpt"
    state = read_state(file)
    assert isinstance(task_of(state), DistilTask)
    start = start_of_task(Start(file, state=state), "patch_vo")
    assert start.state is None and start.record.facts()["started_from"]["name"] == "teacher"
    then = runs.module(model="light")
    then.start_from(start.weights)
    for name, value in one.average.state_dict().items():
        assert torch.equal(then.net.state_dict()[name], value)
    assert all(parameter.requires_grad for parameter in then.net.parameters())
    (tmp_path / "then").mkdir()
    then, losses = runs.fit(tmp_path / "then", 2, then)
    held = one.net.update.state_dict()
    assert len(losses) == 2
    assert any(not torch.equal(value, held[name]) for name, value in then.net.update.state_dict().items())


def test_a_teacher_of_other_sizes_is_refused(teacher):
    with pytest.raises(DvoError, match=r"feature_channels 64.*has 32"):
        DistilTask(teacher="small").network()
    with pytest.raises(DvoError, match="holds another network"):
        DistilTask(teacher="droid").network()
    with pytest.raises(DvoError, match="direction"):
        DistilTask(direction=-1.0)


def test_relative_error():
    torch.manual_seed(0)
    wanted = torch.randn(2, 5, 12, 16) * torch.tensor([1.0, 7.0])[:, None, None, None]
    assert relative_error(wanted, wanted) == 0
    constant = wanted.mean((2, 3), keepdim=True).expand_as(wanted)
    torch.testing.assert_close(relative_error(constant, wanted), torch.ones(()), atol=1e-4, rtol=0)
    torch.testing.assert_close(relative_error(3 * constant, 3 * wanted), relative_error(constant, wanted))
    assert torch.isfinite(relative_error(wanted, torch.zeros_like(wanted)))


def test_agreeing_share():
    torch.manual_seed(0)
    maps = torch.nn.functional.normalize(torch.randn(2, 16, 20, 24), dim=1)
    maps[1] = maps[0].roll((2, -1), (1, 2))
    moved = torch.stack([maps[0], maps[0].roll((1, 1), (1, 2))])
    assert agreeing_share(maps, 2 * maps, 3) == 1
    assert agreeing_share(maps, moved, 3) < 0.2


@pytest.mark.long
def test_the_shipped_configurations(tmp_path, runs, command):
    """A short run of each, the second from the state of the first."""
    for name, more in (("distil", []), ("light", ["--from", tmp_path / "distil" / "last.ckpt"])):
        settings = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
        saver = settings["trainer"]["callbacks"][0]
        saver["init_args"]["every_n_train_steps"] = 1
        settings["trainer"] |= {"accelerator": "cpu", "default_root_dir": str(tmp_path), "callbacks": [saver]}
        settings["trainer"] |= {"enable_progress_bar": False, "enable_model_summary": False}
        settings["data"] |= {"batch_size": 1, "frames": 4, "sizes": [[48, 64]], "workers": 0}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(settings))
        command("fit", "--config", tmp_path / f"{name}.yaml", "--steps", 1, *more)
        state = read_state(tmp_path / name / "last.ckpt")
        assert state["global_step"] == 1 and state["network"]["config"]["encoder"] == "light"
