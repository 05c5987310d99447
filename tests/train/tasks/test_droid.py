"""The task of the dense network: exact estimates, gradients, learning, resuming, configuration."""

from dataclasses import replace

import pytest
import torch
import yaml

import dvo
from dvo.ba.layer.dense import dense_patches
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.losses.pose import edge_pose_errors
from dvo.models.dense_step import DenseState, frame_graph
from dvo.models.droid import DroidVO, neighbour_edges
from dvo.nets.droid.dense_update import MASK
from dvo.synth.clip import flow_field, make_clip
from train.engine.build import make_program
from train.engine.checkpoint import read_state
from train.tasks.droid.objective import LossConfig, mean_error, objective, true_positions, truth_of, upsampled_error
from train.tasks.droid.task import DroidTask
from train.tasks.task import StepContext

SIZES = {"sizes": [(48, 64)]}


def program(**changes):
    torch.manual_seed(0)
    return make_program("droid", **({"model": "tiny", "updates": 2, "learning_rate": 2e-3, "warmup": 5} | changes))


def exact(truth):
    """State of a network that knows the truth."""
    b, n, h, w = truth.inverse_depth.shape
    ii, jj = neighbour_edges(n, 2)
    coords, _ = true_positions(truth.inverse_depth, truth.poses_cw, truth.intrinsics, ii, jj, 2.0)
    depth = torch.where(torch.isfinite(truth.inverse_depth), truth.inverse_depth, 1.0)
    nothing = torch.zeros(())
    return DenseState(
        frame_graph(ii, jj, n, h, w), truth.poses_cw, depth, truth.intrinsics, nothing, nothing, coords, coords,
        torch.ones_like(coords),
    )  # fmt: skip


@pytest.mark.parametrize("known", [1, 2])
def test_exact_estimates_cost_nothing(runs, known):
    truth = truth_of(runs.batch(0, 2), 8)
    loss, found = objective([exact(truth)], truth, LossConfig(), known=known)
    assert loss < 1e-3 and found["px<0.5"] == 1 and found["rotation_deg"] < 1e-2
    moved = replace(exact(truth), poses_cw=se3.identity(*truth.poses_cw.shape[:2]))
    assert objective([moved], truth, LossConfig(), known=known)[1]["loss_pose"] > 0.01


def test_true_positions_are_those_of_the_renderer():
    clip = make_clip(11, 0, sensor=False, frames=3, height=48, width=64)
    names = ("images", "depth", "poses_cw", "intrinsics")
    batch = {name: torch.as_tensor(getattr(clip, name))[None] for name in names}
    truth = truth_of(batch, 8)
    ii, jj = torch.tensor([0, 1]), torch.tensor([1, 2])
    found, valid = true_positions(truth.inverse_depth, truth.poses_cw, truth.intrinsics, ii, jj, 1e9)
    flow, _ = flow_field(
        batch["depth"][0].double().numpy(), se3.inverse(batch["poses_cw"][0].double()).numpy(),
        batch["intrinsics"][0, 0].double().numpy(),
    )  # fmt: skip
    start = dense_patches(truth.inverse_depth)[:, ii, :2].permute(0, 1, 3, 4, 2)
    wanted = start + torch.from_numpy(flow)[None, :, ::8, ::8].float() / 8
    assert valid.float().mean() > 0.9
    torch.testing.assert_close(found[valid], wanted[valid], atol=1e-3, rtol=1e-3)


def test_pixels_without_depth_or_out_of_view_do_not_count(runs):
    batch = runs.batch(0, **SIZES)
    batch["depth"] = batch["depth"].clone()
    batch["depth"][0, 0] = torch.nan
    truth = truth_of(batch, 8)
    ii, jj = neighbour_edges(4, 2)
    there, valid = true_positions(truth.inverse_depth, truth.poses_cw, truth.intrinsics, ii, jj, 2.0)
    assert not valid[:, ii == 0].any() and valid[:, ii > 0].float().mean() > 0.5 and torch.isfinite(there).all()
    error, each = mean_error(there + 1.0, there, torch.zeros_like(valid), 8.0)
    assert error == 0 and torch.isinf(each).all()


def test_the_cap_bounds_one_pixel():
    truth, valid = torch.zeros(1, 1, 1, 2, 2), torch.ones(1, 1, 1, 2, dtype=torch.bool)
    positions = torch.tensor([[3.0, 4.0], [300.0, 400.0]]).view(1, 1, 1, 2, 2).requires_grad_()
    error, _ = mean_error(positions, truth, valid, 8.0)
    assert float(error.detach()) == pytest.approx((5 + 8) / 2)
    error.backward()
    assert (positions.grad[0, 0, 0, 1] == 0).all() and (positions.grad[0, 0, 0, 0] != 0).all()


def test_gradients_of_the_losses_are_the_derivatives():
    g = torch.Generator().manual_seed(0)
    positions = torch.randn(1, 2, 2, 2, 2, generator=g, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([True, True, False, True]).view(1, 1, 2, 2).expand(1, 2, 2, 2)
    assert torch.autograd.gradcheck(lambda x: mean_error(x, torch.zeros_like(x), valid, 8.0)[0], (positions,))
    xi = (0.3 * torch.randn(1, 3, 6, generator=g, dtype=torch.float64)).requires_grad_()
    truth = se3.exp(0.3 * torch.randn(1, 3, 6, generator=g, dtype=torch.float64))
    ii, jj = neighbour_edges(3, 2)

    def errors(xi):
        found = edge_pose_errors(se3.exp(xi), truth, ii, jj)
        return found.translation, found.rotation

    assert torch.autograd.gradcheck(errors, (xi,))


def test_edge_errors_see_the_scale_and_not_the_world():
    truth = se3.exp(0.3 * torch.randn(1, 3, 6, generator=torch.Generator().manual_seed(0)))
    ii, jj = neighbour_edges(3, 2)
    world = se3.exp(torch.tensor([0.5, 0.2, -0.4, 0.3, 0.1, 0.2]))
    moved = se3.compose(truth, world.expand(1, 3, 7))
    same = edge_pose_errors(moved, truth, ii, jj)
    assert same.translation < 1e-5 and same.rotation < 1e-5
    larger = torch.cat([2 * truth[..., :3], truth[..., 3:]], -1)
    assert edge_pose_errors(larger, truth, ii, jj).translation > 0.05


def test_the_upsampled_depth_is_compared_at_the_resolution_of_the_image(runs):
    truth = truth_of(runs.batch(0, **SIZES), 8)
    b, n, h, w = truth.inverse_depth.shape
    mask = torch.full((b, n, MASK, h, w), -1e4)
    mask.view(b, n, 9, 8, 8, h, w)[:, :, 4] = 1e4
    flat = replace(truth, fine=torch.ones_like(truth.fine))
    state = replace(exact(truth), inverse_depth=torch.ones(b, n, h, w), mask=mask)
    assert upsampled_error(state, flat, LossConfig()) < 1e-4
    farther = replace(state, inverse_depth=state.inverse_depth * 0.5)
    assert upsampled_error(farther, flat, LossConfig()) > 0.01
    _, found = objective([state], flat, LossConfig())
    assert found["loss_upsampled"] < 1e-4


@pytest.mark.long
def test_the_loss_falls_within_some_steps(runs):
    one = program(updates=2)
    batch = runs.batch(0, **SIZES)
    optimizer = torch.optim.AdamW(one.net.parameters(), 2e-3)
    targets = []
    for step in range(20):
        found = one.task.compute_loss(StepContext(one.net, step, {}), batch)
        optimizer.zero_grad()
        found.loss.backward()
        torch.nn.utils.clip_grad_norm_(one.net.parameters(), 2.5)
        optimizer.step()
        targets.append(float(found.shown["target"]))
    assert targets[-1] < 0.8 * targets[0]


@pytest.mark.long
def test_resumed_training_equals_uninterrupted_training(tmp_path, runs):
    options = {"flow_steps": 1, "further": 2, "reach": 1}
    runs.check_resuming(tmp_path, 3, lambda: program(**options))


def test_further_edges_are_drawn_anew_and_the_same_again():
    task = DroidTask("tiny", reach=1, further=3)
    drawn = [tuple(map(tuple, torch.stack(task.edges(6, step)).T.tolist())) for step in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2] and len(drawn[0]) == len(set(drawn[0])) == 10 + 3
    assert all(abs(i - j) > 1 for i, j in drawn[0][10:])
    assert len(task.edges(2, 0)[0]) == 2  # no frames so far apart


def test_the_first_steps_train_the_flow_alone(runs):
    batch = runs.batch(0, **SIZES)
    gradients = []
    for step in (0, 1):
        one = program(flow_steps=1)
        found = one.task.compute_loss(StepContext(one.net, step, {}), batch)
        found.loss.backward()
        gradients.append(one.net.update.agg.eta[0].weight.grad)
        assert ("loss_pose" in found.measures) == (step == 1)
    assert gradients[0] is None and gradients[1].abs().sum() > 0


def test_clips_without_depth_train_the_poses_alone(runs):
    batch = runs.batch(0, **SIZES)
    batch["depth"] = torch.full_like(batch["depth"], torch.nan)
    one = program()
    found = one.task.compute_loss(StepContext(one.net, 0, {}), batch)
    assert torch.isfinite(found.loss) and found.measures["loss_target"] == 0 and found.measures["loss_pose"] > 0
    found.loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in one.net.parameters() if p.grad is not None)


@pytest.mark.long
def test_bfloat16_stays_near_full_precision(runs):
    one, batch = program(), runs.batch(0, **SIZES)
    plain = one.task.compute_loss(StepContext(one.net, 0, {}), batch).loss
    with torch.autocast("cpu", torch.bfloat16):
        mixed = one.task.compute_loss(StepContext(one.net, 0, {}), batch)
    assert mixed.loss.dtype == torch.float32
    assert float(mixed.loss.detach()) == pytest.approx(float(plain.detach()), rel=0.1)


def test_measures_of_a_clip(runs):
    task, batch = DroidTask("tiny", updates=2), runs.batch(0, **SIZES)
    torch.manual_seed(0)
    net = task.network()
    found = task.measure(net, batch, seed=0)
    assert found == task.measure(net, batch, seed=1)
    assert {"pose", "flow", "target", "rotation_deg", "rotation_ratio", "px<1"} <= set(found)
    assert task.parts(net)["gru"] is net.update.gru


@pytest.mark.parametrize("change", [{"decay": 2.0}, {"flow": "much"}, {"margin": float("nan")}])
def test_bad_weights_of_the_loss_are_refused(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        LossConfig(**change)


@pytest.mark.slow
def test_the_shipped_configuration_trains_and_resumes(tmp_path, runs, command):
    """With sizes for a test; the network is exported and loaded."""
    pytest.importorskip("kornia")
    settings = runs.shipped("droid", tmp_path)
    settings["model"] |= {"model": "tiny", "updates": 2}
    settings["data"] |= {"frames": 3, "sizes": [[48, 64]], "workers": 0}
    file = tmp_path / "settings.yaml"
    for steps in (1, 2):
        settings["trainer"]["max_steps"] = steps
        file.write_text(yaml.safe_dump(settings))
        command("fit", "--config", file, *(["--resume"] if steps > 1 else []))
    state = read_state(tmp_path / "droid" / "last.ckpt")
    assert state["global_step"] == 2 and state["task"] == "droid" and state["Renderings"] == {"clips_seen": 2}
    weights = tmp_path / "dense.safetensors"
    command("export", tmp_path / "droid" / "last.ckpt", weights)
    assert isinstance(dvo.load_model(weights), DroidVO)
