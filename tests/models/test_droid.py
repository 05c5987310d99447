"""The dense network: names and shapes of DROID-SLAM, conventions, weights files, both loops on one graph."""

from dataclasses import replace

import pytest
import torch

import dvo
from dvo.ba.kernels import Kernel
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.models.dense_step import (
    DenseOptions,
    DenseState,
    HeldEdges,
    VolumeLookup,
    dense_step,
    frame_graph,
)
from dvo.models.droid import DroidVO, damping_of, neighbour_edges
from dvo.models.registry import network_class
from dvo.models.weights import import_checkpoint, load_weights, save_weights
from dvo.nets.correlation.frame_correlation import PairVolume
from dvo.nets.droid.droid import preset


def droid_table() -> dict[str, tuple[int, ...]]:
    """Tensors of the network of princeton-vl/DROID-SLAM (commit 2dfd39f), from its published layer sizes."""
    table: dict[str, tuple[int, ...]] = {}

    def layer(name: str, *shape: int) -> None:
        table[f"{name}.weight"], table[f"{name}.bias"] = shape, shape[:1]

    for net, outputs in (("fnet", 128), ("cnet", 256)):
        layer(f"{net}.conv1", 32, 3, 7, 7)
        for number, (inputs, channels) in enumerate(((32, 32), (32, 64), (64, 128)), 1):
            for block in (0, 1):
                first = inputs if block == 0 else channels
                layer(f"{net}.layer{number}.{block}.conv1", channels, first, 3, 3)
                layer(f"{net}.layer{number}.{block}.conv2", channels, channels, 3, 3)
            if number > 1:
                layer(f"{net}.layer{number}.0.downsample.0", channels, inputs, 1, 1)
        layer(f"{net}.conv2", outputs, 128, 1, 1)
    layer("update.corr_encoder.0", 128, 196, 1, 1)
    layer("update.corr_encoder.2", 128, 128, 3, 3)
    layer("update.flow_encoder.0", 128, 4, 7, 7)
    layer("update.flow_encoder.2", 64, 128, 3, 3)
    for head in ("weight", "delta"):
        layer(f"update.{head}.0", 128, 128, 3, 3)
        layer(f"update.{head}.2", 2, 128, 3, 3)
    for gate in "zrq":
        layer(f"update.gru.conv{gate}", 128, 448, 3, 3)
        layer(f"update.gru.conv{gate}_glo", 128, 128, 1, 1)
    layer("update.gru.w", 128, 128, 1, 1)
    layer("update.agg.conv1", 128, 128, 3, 3)
    layer("update.agg.conv2", 128, 128, 3, 3)
    layer("update.agg.eta.0", 1, 128, 3, 3)
    layer("update.agg.upmask.0", 576, 128, 1, 1)
    return table


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return DroidVO(preset("tiny")).eval()


def images(*shape, seed=0):
    return torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def camera(frames, batch=1):
    return torch.tensor([60.0, 60, 32, 24]).expand(batch, frames, 4)


def test_full_preset_is_droid_slam_tensor_for_tensor():
    with torch.device("meta"):
        state = DroidVO(preset("full")).state_dict()
    assert {name: tuple(t.shape) for name, t in state.items()} == droid_table()
    assert len(state) == 102 and sum(t.numel() for t in state.values()) == 4_002_565


def test_import_drops_the_prefix_and_the_third_channel_of_the_heads(tmp_path):
    g = torch.Generator().manual_seed(0)
    state = {name: 0.01 * torch.randn(shape, generator=g) for name, shape in droid_table().items()}
    for head in ("weight", "delta"):
        for kind in ("weight", "bias"):
            name = f"update.{head}.2.{kind}"
            state[name] = torch.cat([state[name], torch.ones_like(state[name][:1])])
    torch.save({f"module.{name}": value for name, value in state.items()}, tmp_path / "droid.pth")
    info = import_checkpoint(tmp_path / "droid.pth", tmp_path / "full.safetensors")
    assert (info.architecture, info.preset, info.parameters) == ("droid", "full", 4_002_565)
    assert info.card["origin"] == "DROID-SLAM checkpoint"
    loaded = load_weights(tmp_path / "full.safetensors").model
    assert torch.equal(loaded.update.delta[2].weight, state["update.delta.2.weight"][:2])
    assert torch.equal(loaded.fnet.conv1.weight, state["fnet.conv1.weight"])  # fed RGB, as dvo's images are
    torch.save(state | {"update.gru.w.bias": torch.zeros(3)}, tmp_path / "bad.pth")
    with pytest.raises(DvoError, match="update.gru.w.bias"):
        import_checkpoint(tmp_path / "bad.pth", tmp_path / "bad.safetensors")


def test_sizes_of_the_presets():
    count = {name: sum(p.numel() for p in DroidVO(preset(name)).parameters()) for name in ("tiny", "small")}
    assert 300_000 <= count["small"] <= 1_000_000 and count["tiny"] < 200_000


@pytest.mark.parametrize(("height", "width"), [(48, 64), (52, 75), (32, 32)])
def test_maps_are_at_an_eighth_of_any_size(model, height, width):
    with torch.no_grad():
        state = model(images(1, 3, 3, height, width), camera(3), updates=2)
    assert state.inverse_depth.shape == (1, 3, -(-height // 8), -(-width // 8))
    assert torch.isfinite(state.poses_cw).all() and torch.isfinite(state.inverse_depth).all()
    assert (state.inverse_depth > 0).all()


def test_images_too_small_are_refused(model):
    with pytest.raises(DvoError, match="at least 32x32"):
        model(images(1, 2, 3, 24, 64), camera(2))


def test_clips_do_not_depend_on_their_neighbours(model):
    batch = images(2, 3, 3, 48, 64)
    with torch.no_grad():
        together = model(batch, camera(3, 2), updates=2)
        alone = model(batch[1:], camera(3), updates=2)
    torch.testing.assert_close(together.targets[1:], alone.targets, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", ["tiny", "masked"])
def test_every_parameter_gets_a_gradient(name):
    torch.manual_seed(0)
    config = preset("tiny") if name == "tiny" else replace(preset("tiny"), upsample=True)
    net = DroidVO(config)
    state = net(images(1, 3, 3, 48, 64), camera(3), updates=3)
    total = state.poses_cw.square().sum() + state.inverse_depth.square().mean() + state.targets.square().mean()
    if state.mask is not None:
        total = total + state.mask.square().mean()
    total.backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()] == []
    assert net.update.agg.eta[0].weight.grad.abs().sum() > 0 and net.fnet.conv1.weight.grad.abs().sum() > 0


def start_of(net, clip, intrinsics):
    """State before the first step, and the look-up that tracking uses."""
    features = net.encode(clip)
    n, (h, w) = clip.shape[1], features.matching.shape[-2:]
    ii, jj = neighbour_edges(n, 2)
    depth = torch.ones(1, n, h, w)
    hidden = features.hidden.index_select(1, ii)
    graph = frame_graph(ii, jj, n, h, w)
    state = DenseState(graph, se3.identity(1, n), depth, intrinsics / 8, features.gates, hidden)
    maps, config = features.matching[0], net.config
    volumes = [PairVolume(maps[i], maps[j], config.pyramid, config.radius) for i, j in zip(ii, jj, strict=True)]
    return state, VolumeLookup(volumes)


def test_training_and_tracking_take_the_same_step(model):
    clip, intrinsics = images(1, 3, 3, 48, 64), camera(3)
    with torch.no_grad():
        state, lookup = start_of(model, clip, intrinsics)
        ii, jj = neighbour_edges(3, 2)
        (trained,) = model.unroll(clip, intrinsics, ii, jj, updates=1, poses_cw=se3.identity(1, 3), iterations=1)
        tracked = dense_step(model, state, lookup, DenseOptions(iterations=1, damping=damping_of(0)))
    for name in ("hidden", "targets", "confidence", "damping", "poses_cw", "inverse_depth"):
        torch.testing.assert_close(getattr(tracked, name), getattr(trained, name), atol=1e-5, rtol=1e-4)


def test_modes_move_what_they_should(model):
    with torch.no_grad():
        state, lookup = start_of(model, images(1, 3, 3, 48, 64), camera(3))
        motion = dense_step(model, state, lookup, DenseOptions("motion", fixed=[True, True, False]))
        flow = dense_step(model, state, lookup, DenseOptions("flow"))
    assert torch.equal(motion.inverse_depth, state.inverse_depth) and motion.damping is None
    assert torch.equal(motion.poses_cw[:, :2], state.poses_cw[:, :2])
    assert not torch.equal(motion.poses_cw[:, 2], state.poses_cw[:, 2])
    assert torch.equal(flow.poses_cw, state.poses_cw) and torch.equal(flow.coords, flow.targets)


def test_held_edges_count_in_bundle_adjustment(model):
    with torch.no_grad():
        state, lookup = start_of(model, images(1, 3, 3, 48, 64), camera(3))
        plain = dense_step(model, state, lookup)
        there = state.reprojected().coords[:, :1] + 3.0
        held = HeldEdges(state.graph.ii[:1], state.graph.jj[:1], there, torch.ones_like(there))
        pulled = dense_step(model, state, lookup, DenseOptions(held=held))
    assert torch.equal(plain.targets, pulled.targets) and not torch.equal(plain.poses_cw, pulled.poses_cw)


def test_a_robust_kernel_takes_the_influence_of_far_measurements(model):
    with torch.no_grad():
        state, lookup = start_of(model, images(1, 3, 3, 48, 64), camera(3))
        there = state.reprojected().coords[:, :1] + 3.0
        held = HeldEdges(state.graph.ii[:1], state.graph.jj[:1], there, torch.ones_like(there))
        (plain, wide, robust), alone = (
            [dense_step(model, state, lookup, DenseOptions(iterations=1, held=pull, kernel=kernel)).poses_cw
             for kernel in (Kernel(), Kernel("cauchy", 1e4), Kernel("cauchy", 0.3))]
            for pull in (held, None)
        )  # fmt: skip
    torch.testing.assert_close(wide, plain, atol=1e-6, rtol=1e-4)
    assert (robust - alone[2]).norm() < 0.3 * (plain - alone[0]).norm()


def test_weights_files_name_the_network(model, tmp_path):
    file = tmp_path / "dense.safetensors"
    save_weights(file, model, {}, half=False)
    loaded = dvo.load_model(file)
    assert isinstance(loaded, DroidVO) and loaded.config == model.config and network_class("droid") is DroidVO
    clip = images(1, 2, 3, 48, 64)
    with torch.no_grad():
        a, b = (net(clip, camera(2), updates=1) for net in (loaded, model))
    assert torch.equal(a.targets, b.targets)
