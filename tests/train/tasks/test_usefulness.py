"""Training of the score of patches: what is regressed, and that nothing else of the network changes."""

from dataclasses import replace

import pytest
import torch

from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import full_graph
from dvo.models.step import UpdateState
from dvo.models.weights import load_weights, save_weights
from dvo.nets.config import preset
from dvo.nets.selection import SELECTIONS
from train.engine.build import make_program
from train.tasks.patch_vo.objective import LossConfig
from train.tasks.patch_vo.task import PatchVOTask
from train.tasks.patch_vo.usefulness import ERROR, score_loss, usefulness


def state_of(frames, patches, joined, **changes):
    """State whose first ``joined`` frames have edges."""
    graph = full_graph(joined, patches, self_edges=True)
    nothing = torch.zeros(1, joined * patches, 3, 3, 3)
    return UpdateState(graph, se3.identity(1, joined), nothing, torch.ones(1, joined, 4), nothing, nothing, **changes)


def test_usefulness_is_the_mean_confidence_of_exact_edges():
    state = state_of(3, 1, 3)
    error = torch.full((1, 9), torch.inf)  # patch k, frame j: edge 3 k + j
    confidence = torch.rand(1, 9, 2)
    error[0, 1], error[0, 2] = 0.0, ERROR  # of patch 0
    error[0, 4], error[0, 3] = 0.0, 3 * ERROR  # of patch 1: its own frame does not count
    value, counted = usefulness(confidence, error, state)
    means = confidence[0].mean(-1)
    torch.testing.assert_close(value[0], torch.stack([(means[1] + means[2] / 2) / 2, means[3] / 10, means[8] * 0]))
    assert counted.tolist() == [[True, True, False]]


def test_the_loss_is_least_where_the_scores_are_the_usefulness():
    torch.manual_seed(0)
    state = state_of(4, 5, 3)
    error, confidence = torch.rand(1, 45), torch.rand(1, 45, 2)
    wanted, _ = usefulness(confidence, error, state)
    scores = torch.cat([wanted.logit(), torch.full((1, 5), 50.0)], 1).requires_grad_()  # of a frame that comes later
    state = UpdateState(**{**vars(state), "confidence": confidence, "scores": scores})
    loss, correlation = score_loss(state, error)
    loss.backward()
    assert scores.grad.abs().max() < 1e-6 and correlation == pytest.approx(1.0)
    unknown, _ = score_loss(state, torch.full((1, 45), torch.inf))
    assert unknown == 0 and torch.isfinite(unknown)


def test_the_head_alone_is_trained_from_weights_without_one(tmp_path, runs):
    torch.manual_seed(3)
    save_weights(tmp_path / "old.safetensors", PatchVO(preset("tiny")), {})
    old = load_weights(tmp_path / "old.safetensors")
    program = runs.module(train_only="score", selection="learned")
    program.start_from(old)
    first = {name: value.clone() for name, value in program.net.state_dict().items()}
    program, losses = runs.fit(tmp_path, 3, program)
    now, average = program.net.state_dict(), program.average.state_dict()
    assert len(losses) == 3 and int(program.skipped) == 0
    for name, value in now.items():
        if name.startswith("score."):
            assert not torch.equal(value, first[name]) and not torch.equal(average[name], first[name])
        else:
            old_value = old.model.state_dict()[name]
            assert torch.equal(value, old_value) and torch.equal(average[name], old_value)
    assert program.net.config.selection == "learned" and program.net.config.score_head
    save_weights(tmp_path / "new.safetensors", program.average, {})
    assert load_weights(tmp_path / "new.safetensors").model.selection() is SELECTIONS.resolve("learned")


def test_weights_may_lack_nothing_but_the_head(tmp_path, runs):
    save_weights(tmp_path / "old.safetensors", PatchVO(preset("tiny")), {})
    old = load_weights(tmp_path / "old.safetensors")
    lacking = torch.nn.Module()
    lacking.update = old.model.update
    with pytest.raises(DvoError, match="patchify.*has nothing where"):
        runs.module(train_only="score").start_from(replace(old, model=lacking))
    with pytest.raises(DvoError, match="score.conv1.bias: has .* where the network of the configuration has nothing"):
        make_program(model="tiny").start_from(replace(old, model=PatchVO(replace(preset("tiny"), score_head=True))))
    make_program(model="tiny").start_from(old)


def test_the_head_learns_beside_the_rest(runs):
    program = make_program(model="tiny", updates=3, warmup_until=0.0, selection="learned")
    program.log_dict = lambda *a, **k: None
    program.training_step(runs.batch(), 0).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in program.net.parameters())


def test_parameters_that_cannot_learn_alone_are_refused():
    with pytest.raises(DvoError, match="train_only: no parameter begins with 'scores'. Name one of patchify, update"):
        PatchVOTask("tiny", train_only="scores").network()
    with pytest.raises(DvoError, match="balance compares"):
        PatchVOTask("tiny", train_only="score", loss=LossConfig(balance="v2v")).network()
