"""The task of the two-frame network: exact estimates, learning, resuming, augmentation, configuration."""

from dataclasses import fields

import pytest
import torch
import yaml

import dvo
from dvo.core.errors import DvoError
from dvo.geometry import se3, so3
from dvo.models.tartanvo import TwoFrameMotion
from dvo.nets.two_frame.flow_pyramid import Flows
from dvo.nets.two_frame.tartanvo import intrinsics_layer
from dvo.synth.clip import flow_field, make_clip
from train.data.augment import Augmentation, crop_and_resize
from train.engine.build import make_program
from train.engine.checkpoint import read_state
from train.tasks.tartanvo.objective import LossConfig, objective, truth_of
from train.tasks.tartanvo.task import TartanVOTask
from train.tasks.tartanvo.virtual_motions import VirtualMotions, virtual_pairs
from train.tasks.task import StepContext


def program(**changes):
    torch.manual_seed(0)
    return make_program("tartanvo", **({"model": "tiny", "learning_rate": 2e-3, "warmup": 5} | changes))


def exact(truth, levels=3):
    """Output of a network that knows the truth; its translation is of another length."""
    flows = [truth.flow[..., :: 2**k, :: 2**k] / 2**k for k in reversed(range(levels))]
    return TwoFrameMotion(0.3 * truth.translation, truth.rotation, Flows(tuple(flows), truth.flow))


@pytest.mark.parametrize("form", ["distance", "cosine"])
def test_exact_estimates_cost_nothing(runs, form):
    truth = truth_of(runs.batch(0, 1, sizes=[(48, 64)]), 4, 16.0)
    assert truth.valid.float().mean() > 0.7
    loss, found = objective(exact(truth), truth, LossConfig(form=form))
    assert loss < 1e-3
    assert found["px<1"] == 1 and found["flow"] == 0 and found["direction_deg"] < 0.1 and found["rotation_deg"] < 1e-3


def test_the_true_flow_is_that_of_the_renderer():
    clip = make_clip(11, 0, sensor=False, frames=3, height=48, width=64)
    names = ("images", "depth", "poses_cw", "intrinsics")
    batch = {name: torch.as_tensor(getattr(clip, name))[None] for name in names}
    truth = truth_of(batch, 4, 1e9)
    poses_wc = se3.inverse(batch["poses_cw"][0].double()).numpy()
    flow, _ = flow_field(batch["depth"][0].double().numpy(), poses_wc, batch["intrinsics"][0, 0].double().numpy())
    wanted = torch.from_numpy(flow)[:, ::4, ::4].permute(0, 3, 1, 2).float() / 4
    assert truth.valid.float().mean() > 0.9
    where = truth.valid[:, None].expand_as(wanted)
    torch.testing.assert_close(truth.flow[where], wanted[where], atol=1e-3, rtol=1e-3)


def test_a_crop_changes_flow_and_intrinsics_together(runs):
    """Pose and rays stay; what is seen in the enlarged window moves by as much more."""
    batch = runs.batch(0, sizes=[(48, 64)])
    scale, left, top = 2.0, 15.5, 11.5
    clip = {name: value[0] for name, value in batch.items()}
    crop = {name: value[None] for name, value in (clip | crop_and_resize(clip, scale, left, top)).items()}
    before, after = truth_of(batch, 1, 1e9), truth_of(crop, 1, 1e9)
    torch.testing.assert_close(before.rotation, after.rotation)
    x, y = 20, 14  # (u + 0.5 - left) scale - 0.5 of a whole pixel of the image
    u, v = round((x + 0.5 - left) * scale - 0.5), round((y + 0.5 - top) * scale - 0.5)
    depth = batch["depth"][0, 0, y, x]
    assert crop["depth"][0, 0, v, u] == depth
    ratio = after.flow[0, :, v, u] / before.flow[0, :, y, x]
    torch.testing.assert_close(ratio, torch.full((2,), scale), atol=0.1, rtol=0.05)


@pytest.mark.long
def test_the_loss_falls_within_some_steps(runs):
    one = program()
    batch = runs.batch(0, 1, sizes=[(64, 96)])
    optimizer = torch.optim.AdamW(one.net.parameters(), 2e-3)
    losses = []
    for step in range(40):
        found = one.task.compute_loss(StepContext(one.net, step, {}), batch)
        optimizer.zero_grad()
        found.loss.backward()
        torch.nn.utils.clip_grad_norm_(one.net.parameters(), 10.0)
        optimizer.step()
        losses.append((float(found.loss.detach()), float(found.shown["flow"])))
    assert losses[-1][0] < 0.7 * losses[0][0] and losses[-1][1] < 0.5 * losses[0][1]


@pytest.mark.long
def test_resumed_training_equals_uninterrupted_training(tmp_path, runs):
    pytest.importorskip("kornia")
    options = {"augmentation": Augmentation(zoom=1.0, zoom_range=1.3), "true_flow_until": 2}
    runs.check_resuming(tmp_path, 4, lambda: program(**options))


def test_the_true_flow_is_read_at_first_only(runs):
    batch = runs.batch(0)
    gradients = []
    for step in (0, 1):
        one = program(true_flow_until=1, loss={"flow": 0.0})
        one.task.compute_loss(StepContext(one.net, step, {}), batch).loss.backward()
        gradients.append(float(one.net.matching.encoder.conv1.weight.grad.abs().sum()))
    assert gradients[0] == 0 and gradients[1] > 0


def test_clips_without_depth_train_the_motion_alone(runs):
    batch = runs.batch(0)
    batch["depth"] = torch.full_like(batch["depth"], torch.nan)
    one = program()
    found = one.task.compute_loss(StepContext(one.net, 0, {}), batch)
    assert torch.isfinite(found.loss) and found.measures["loss_flow"] == 0 and found.measures["loss_rotation"] > 0
    found.loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in one.net.parameters() if p.grad is not None)


def test_bfloat16_stays_near_full_precision(runs):
    one, batch = program(), runs.batch(0)
    plain = one.task.compute_loss(StepContext(one.net, 0, {}), batch).loss
    with torch.autocast("cpu", torch.bfloat16):
        mixed = one.task.compute_loss(StepContext(one.net, 0, {}), batch)
    assert mixed.loss.dtype == torch.float32 and float(mixed.loss.detach()) == pytest.approx(
        float(plain.detach()), rel=0.1
    )


def test_measures_of_a_clip(runs):
    task, batch = TartanVOTask("tiny"), runs.batch(0)
    torch.manual_seed(0)
    net = task.network()
    found = task.measure(net, batch, seed=0)
    assert found == task.measure(net, batch, seed=1)
    assert {"pose", "flow", "direction_deg", "rotation_deg", "rotation_ratio"} <= set(found)
    assert 0 <= found["direction_deg"] <= 180
    variants = task.loss_variants(net, batch, seed=0)
    assert list(variants) == ["joint", "distance", "cosine"] and all(v.requires_grad for v in variants.values())
    assert set(task.parts(net)) == {"matching", "pose"}


@pytest.mark.parametrize("change", [{"form": 1}, {"rotation": "much"}, {"margin": float("nan")}])
def test_bad_weights_of_the_loss_are_refused(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        LossConfig(**change)


@pytest.mark.long
def test_the_shipped_configuration_trains_and_resumes(tmp_path, runs, command):
    """With sizes for a test; the network is exported, loaded and gives a flow."""
    pytest.importorskip("kornia")
    settings = runs.shipped("tartanvo", tmp_path)
    settings["model"]["model"] = "tiny"
    settings["data"] |= {"batch_size": 1, "frames": 3, "sizes": [[48, 64]], "workers": 0}
    file = tmp_path / "settings.yaml"
    for steps in (2, 4):
        settings["trainer"]["max_steps"] = steps
        file.write_text(yaml.safe_dump(settings))
        command("fit", "--config", file, *(["--resume"] if steps > 2 else []))
    state = read_state(tmp_path / "tartanvo" / "last.ckpt")
    assert state["global_step"] == 4 and state["task"] == "tartanvo" and state["Renderings"] == {"clips_seen": 4}
    weights = tmp_path / "two.safetensors"
    command("export", tmp_path / "tartanvo" / "last.ckpt", weights)
    flow = dvo.load_model(weights).flow(torch.zeros(1, 3, 48, 64), torch.zeros(1, 3, 48, 64))
    assert flow.shape == (1, 2, 12, 16)


def test_rotation_vectors_are_those_of_the_second_camera(runs):
    batch = runs.batch(0)
    truth = truth_of(batch, 4, 16.0)
    poses_wc = se3.inverse(batch["poses_cw"][0])
    poses_ab = torch.cat([truth.translation, so3.exp(truth.rotation)], -1)
    torch.testing.assert_close(
        se3.matrix(se3.compose(poses_wc[:-1], poses_ab)), se3.matrix(poses_wc[1:]), atol=1e-5, rtol=1e-5
    )


@pytest.mark.parametrize("change", [{"model": "huge"}, {"seed": -1}, {"true_flow_until": -1}, {"true_flow_until": 1.5}])
def test_arguments_out_of_range_are_named(change):
    field = {"model": "preset"}.get(next(iter(change)), next(iter(change)))
    with pytest.raises(DvoError, match=field):
        TartanVOTask(**change)


@pytest.mark.parametrize("name", [item.name for item in fields(LossConfig) if item.name != "form"])
def test_weights_of_the_loss_out_of_range_are_named(name):
    for value in (-1.0, float("nan"), "1"):
        with pytest.raises(DvoError, match=name):
            LossConfig(**{name: value})


def virtual(batch, **changes):
    settings = VirtualMotions(**({"pairs": 40, "noise": (1e-9, 1e-9)} | changes))
    depth = batch["depth"].flatten(0, 1)[:, ::4, ::4]
    return virtual_pairs(depth, 4, settings, 3, 7, tuple(batch["depth"].shape[-2:]))


def test_the_flow_of_virtual_pairs_is_that_of_their_motions(runs):
    """Ends of the flow lie on the epipolar lines of the motion (q^T E p = 0), before errors are added."""
    batch = runs.batch(0, 1, sizes=[(48, 64)])
    pairs = virtual(batch)
    assert pairs.valid.float().mean() > 0.5
    h, w = pairs.flow.shape[-2:]
    rays = intrinsics_layer(pairs.intrinsics / 4, h, w)
    p = torch.cat([rays, torch.ones_like(rays[:, :1])], 1).permute(0, 2, 3, 1)
    q = torch.cat([rays + pairs.flow / (pairs.intrinsics[:, :2, None, None] / 4), torch.ones_like(rays[:, :1])], 1)
    turned = so3.rotate(so3.exp(pairs.rotation)[:, None, None], q.permute(0, 2, 3, 1))
    direction = torch.nn.functional.normalize(pairs.translation, dim=-1)[:, None, None]
    triple = (torch.linalg.cross(p, turned) * direction).sum(-1).abs()
    inside = pairs.flow.abs().amax(1) < w  # longer ones are cut off
    assert triple[pairs.valid][inside[pairs.valid]].max() < 1e-3


def test_virtual_pairs_are_drawn_from_the_seed_and_the_step(runs):
    batch = runs.batch(0, 1, sizes=[(48, 64)])
    again, other = virtual(batch), virtual(batch, rotation=(0.2, 0.2))
    assert torch.equal(virtual(batch).flow, again.flow) and not torch.equal(other.rotation, again.rotation)
    noisy = virtual(batch, noise=(0.5, 0.5))
    error = (noisy.flow - again.flow)[again.valid]
    # Linear interpolation along both axes leaves (2/3)^2 of the variance of the errors that neighbours share.
    assert error.std() == pytest.approx(0.5 * (0.5 + 0.5 * 4 / 9) ** 0.5, rel=0.1)
    torch.testing.assert_close(other.rotation.norm(dim=-1), torch.full((40,), 0.2))


def test_virtual_pairs_train_the_pose_network_alone(runs):
    part = program(virtual=VirtualMotions(pairs=6), loss=LossConfig(flow=0.0, translation=0.0, rotation=0.0))
    plain = program(loss=LossConfig(flow=0.0, translation=0.0, rotation=0.0))
    alone = program(virtual=VirtualMotions(pairs=6), matching_from=1)
    batch = runs.batch(0, 1, sizes=[(48, 64)])
    for found in (part, plain, alone):
        found.task.loss = LossConfig(flow=0.0)
    net = part.net
    extra = alone.task.compute_loss(StepContext(net, 0, {}), batch)
    extra.loss.backward()
    assert all(p.grad is None for p in net.matching.parameters())
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.pose.parameters())
    whole = part.task.compute_loss(StepContext(net, 0, {}), batch)
    without = plain.task.compute_loss(StepContext(net, 0, {}), batch)
    torch.testing.assert_close(whole.loss, without.loss + extra.loss)
    assert extra.measures["virtual_rotation_deg"] > 0 and "virtual_rotation_ratio" in whole.measures


def test_the_first_steps_may_train_the_pose_network_alone(runs):
    part = program(virtual=VirtualMotions(pairs=6), matching_from=5)
    batch = runs.batch(0, 1, sizes=[(48, 64)])
    early = part.task.compute_loss(StepContext(part.net, 4, {}), batch)
    both, plain = program(virtual=VirtualMotions(pairs=6)), program()
    whole, without = (one.task.compute_loss(StepContext(part.net, 4, {}), batch) for one in (both, plain))
    torch.testing.assert_close(whole.loss, without.loss + early.loss)
    late = part.task.compute_loss(StepContext(part.net, 5, {}), batch)
    assert "loss_flow" in late.measures and "loss_flow" not in early.measures
    with pytest.raises(DvoError, match="matching_from"):
        TartanVOTask(matching_from=5)


@pytest.mark.parametrize("change", [{"pairs": -1}, {"rotation": (0.2, 0.1)}, {"noise": (0.0, 1.0)}, {"focal": (1, 99)}])
def test_virtual_motions_out_of_range_are_named(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        VirtualMotions(**change)
