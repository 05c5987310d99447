"""The task of the patch-flow network: warm-up, modes, precision, augmentation."""

import math

import pytest
import torch

from dvo.core.errors import DvoError
from train.data.augment import Augmentation
from train.engine.build import make_program
from train.tasks.patch_vo.objective import LossConfig
from train.tasks.patch_vo.task import PatchVOTask


def test_warm_up_ends_when_the_flow_has_clicked():
    program = make_program(model="tiny", warmup_until=0.5)
    for _ in range(30):
        program.task.follow(program.context, torch.tensor(0.6))
    assert bool(program.warming)
    for _ in range(100):
        program.task.follow(program.context, torch.tensor(0.6))
    assert not bool(program.warming)
    program.task.follow(program.context, torch.tensor(0.0))
    assert not bool(program.warming)


def test_warm_up_ends_after_its_steps(tmp_path, runs):
    program, _ = runs.fit(tmp_path, 2, runs.module(warmup_until=2.0, warmup_steps=2, warmup_mode="structure"))
    assert bool(program.warming)
    program, _ = runs.fit(tmp_path, 3, program, tmp_path / "last.ckpt")
    assert not bool(program.warming)


@pytest.mark.parametrize("mode", ["joint", "structure", "flow"])
def test_every_mode_trains_every_part_it_uses(mode, runs):
    program = make_program(model="tiny", updates=3, warmup_mode=mode, warmup_until=1.0)
    program.log_dict = lambda *a, **k: None
    program.training_step(runs.batch(), 0).backward()
    idle = [name for name, p in program.net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    expected = [n for n, _ in program.net.named_parameters() if n.startswith("update.w.")] if mode == "flow" else []
    assert idle == expected or (mode == "flow" and set(expected) <= set(idle) and len(idle) <= len(expected) + 1)


@pytest.mark.slow
def test_the_full_network_takes_a_step_of_dpvos_recipe(tmp_path, runs):
    """The real layer sizes, on few patches of small frames: grows from 3 frames, structure only at first."""
    program = make_program(
        model="full",
        updates=4,
        initial=3,
        settle=2,
        cycle=100,
        warmup_mode="structure",
        warmup_until=2.0,
        warmup_steps=1,
    )
    program.net.config = program.average.config = type(program.net.config)(training_patches=6)
    _, losses = runs.fit(tmp_path, 2, program)
    assert all(torch.isfinite(torch.tensor(x)) for x in losses)
    assert int(program.skipped) == 0 and not bool(program.warming)


@pytest.mark.long
@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"loss": LossConfig()}, id="plain", marks=pytest.mark.slow),
        pytest.param({"loss": LossConfig(weighted=True, balance="v2v", balance_every=1)}, id="v2v"),
        pytest.param({"update_operator": "mamba"}, id="mamba"),
    ],
)
def test_mixed_precision_stays_near_full_precision(tmp_path, runs, changes):
    """Encoder and update operator in bfloat16; poses, bundle adjustment and loss in float32."""
    _, exact = runs.fit(tmp_path, 2, runs.module(**changes))
    program, mixed = runs.fit(tmp_path, 2, runs.module(**changes), precision="bf16-mixed")
    assert mixed[0] == pytest.approx(exact[0], rel=0.05) and mixed != exact
    assert int(program.skipped) == 0 and all(p.dtype == torch.float32 for p in program.parameters())
    seen = []
    program.net.update.register_forward_hook(lambda m, i, out: seen.append(out[1].dtype))
    with torch.autocast("cpu", torch.bfloat16):
        terms, _, _ = program.task.terms(program.context, runs.batch(), "joint")
    assert seen == [torch.bfloat16] * 3
    assert terms.rotation[-1].dtype == terms.flow[-1].dtype == torch.float32


def test_augmentation_is_part_of_a_step_and_repeats(tmp_path, runs):
    pytest.importorskip("kornia")
    options = {"augmentation": Augmentation(colour=1.0, zoom=1.0)}
    _, a = runs.fit(tmp_path, 2, runs.module(**options))
    _, b = runs.fit(tmp_path, 2, runs.module(**options))
    _, plain = runs.fit(tmp_path, 2)
    assert a == b != plain


def test_the_selection_of_patches_is_that_of_the_run():
    assert PatchVOTask("tiny").network().config.selection == "random"
    assert PatchVOTask("tiny", selection="structure").network().config.selection == "structure"


def test_the_update_operator_is_that_of_the_run(runs):
    assert PatchVOTask("tiny").network().config.update_operator == "gated"
    program = make_program(model="tiny", updates=3, warmup_until=0.0, update_operator="mamba")
    program.log_dict = lambda *a, **k: None
    program.training_step(runs.batch(), 0).backward()
    idle = [name for name, p in program.net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert program.net.config.update_operator == "mamba" and idle == []


TREND = LossConfig(balance="trend", balance_every=2, trend_window=1, pose_from=1)


def test_the_penalty_for_trends_weights_the_flow_and_is_off_by_default(tmp_path, runs):
    program, losses = runs.fit(tmp_path, 3, runs.module(loss=TREND))
    task = program.task
    assert len(task.trend.flow) == len(task.trend.pose) == 1 and task.trend.value != 1
    assert len(task.beta.recent) == 1 and task.rotation.value == 1
    assert all(math.isfinite(loss) for loss in losses)
    _, plain = runs.fit(tmp_path, 3, runs.module(loss=LossConfig(pose_from=1)))
    assert losses[0] == plain[0] and losses[1] != plain[1]
    assert runs.module().task.loss.balance == "none" and runs.module().task.trend.value == 1


@pytest.mark.long
def test_the_penalty_goes_on_after_a_stop(tmp_path, runs):
    whole, losses = runs.fit(tmp_path, 4, runs.module(loss=TREND))
    runs.fit(tmp_path, 2, runs.module(loss=TREND))
    resumed, then = runs.fit(tmp_path, 4, runs.module(loss=TREND), tmp_path / "last.ckpt")
    assert then == losses[2:] and resumed.task.trend == whole.task.trend


def test_a_balance_on_a_parameter_that_is_not_there_is_refused():
    with pytest.raises(DvoError, match="balance_parameter: no parameter 'update.gru.1.res.0.weight'"):
        PatchVOTask("tiny", update_operator="mamba", loss=LossConfig(balance="v2v")).network()
    loss = LossConfig(balance="v2v", balance_parameter="update.history.enter.weight")
    assert PatchVOTask("tiny", update_operator="mamba", loss=loss).network() is not None
