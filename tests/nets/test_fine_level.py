"""Fine level of the correlation: off by default, without effect at first, and equal to its plain twin."""

from dataclasses import replace

import pytest
import torch

from dvo.data.frame import Frame
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import full_graph, training_schedule
from dvo.models.weights import LoadedWeights, load_weights, save_weights
from dvo.nets.config import ModelConfig, preset
from dvo.nets.correlation import Correlation, CorrelationVolume, correlate_reference
from dvo.nets.patchifier import cut_fine, normalise_images
from dvo.nets.update import FineLayer
from dvo.odometry.load import build_odometry
from dvo.synth.clip import make_clip
from train.engine.build import make_program

FINE = replace(preset("tiny"), fine_channels=6)


@pytest.fixture(scope="module")
def clip():
    return make_clip(3, 1, frames=5, height=96, width=128, flow_range=(2.0, 4.0))


def unrolled(model, clip):
    stages = training_schedule(5, 12, 3, self_edges=False)
    start = {"poses_cw": se3.identity(1, 5), "generator": torch.Generator().manual_seed(2)}
    return list(model.unroll(clip.images[None], clip.intrinsics[None], stages, **start))[-1]


def with_weights_of(config, model):
    found = PatchVO(config)
    found.load_state_dict({**found.state_dict(), **model.state_dict()})
    return found.eval()


@torch.no_grad()
def test_a_new_level_changes_nothing_and_there_is_none_by_default(clip):
    torch.manual_seed(0)
    plain = PatchVO(preset("tiny")).eval()
    assert plain.patchify.fine is None and plain.update.fine is None
    model = with_weights_of(FINE, plain)
    a, b = unrolled(plain, clip), unrolled(model, clip)
    assert torch.equal(a.poses_cw, b.poses_cw) and torch.equal(a.targets, b.targets)
    model.update.fine.layer.weight.normal_(std=0.1)
    assert not torch.equal(a.targets, unrolled(model, clip).targets)


def test_both_parts_of_a_new_level_learn(clip):
    torch.manual_seed(0)
    model = PatchVO(FINE)
    parts = (model.update.fine.layer.weight, model.patchify.fine.weight)
    first = torch.autograd.grad(unrolled(model, clip).targets.sum(), parts)
    assert first[0].abs().sum() > 0 and first[1].abs().sum() == 0  # the features learn once the columns are not zero
    with torch.no_grad():
        model.update.fine.layer.weight.normal_(std=0.1)
    assert torch.autograd.grad(unrolled(model, clip).targets.sum(), parts)[1].abs().sum() > 0


def test_the_volume_equals_the_reference_in_values_and_gradients():
    torch.manual_seed(0)
    model = PatchVO(replace(FINE, fine_radius=2))
    images = torch.randint(0, 256, (1, 3, 3, 48, 64))
    centres = torch.stack([torch.randint(1, 15, (1, 3, 4)), torch.randint(1, 11, (1, 3, 4))], -1)
    graph = full_graph(3, 4, self_edges=False)
    coords = torch.rand(1, len(graph), 3, 3, 2) * torch.tensor([18.0, 14.0]) - 1  # some outside of the map
    weight = torch.randn(1, len(graph), model.config.fine_correlation_channels)

    def gradients(lookup):
        features = model.patchify.encode(normalise_images(images))
        fine = cut_fine(features, centres, 3)
        found = lookup(fine, features.fine)
        return found, torch.autograd.grad((found * weight).sum(), list(model.patchify.fine.parameters()))

    at, edges = ModelConfig.FINE * coords, (graph.kk, graph.jj)
    values, slopes = gradients(lambda fine, maps: CorrelationVolume(fine, maps, (1,), 2).lookup(at, *edges)[0])
    expected, wanted = gradients(lambda fine, maps: correlate_reference(fine, maps, at, *edges, (1,), 2)[0])
    torch.testing.assert_close(values, expected, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(slopes, wanted, atol=1e-4, rtol=1e-3)


def test_the_order_of_the_channels_does_not_matter():
    torch.manual_seed(0)
    layer = FineLayer(FINE)
    torch.nn.init.normal_(layer.layer.weight)
    by_offset = torch.randn(1, 7, 3, 3, 3, 3)  # x offset, y offset, patch row, patch column
    by_pixel = by_offset.permute(0, 1, 4, 5, 3, 2)
    one = layer(Correlation([], "offsets_first", by_offset.flatten(2)))
    torch.testing.assert_close(layer(Correlation([], "pixels_first", by_pixel.flatten(2))), one)


def test_patches_are_cut_at_the_same_image_pixels():
    """A fine map that holds its own image coordinates: the cut pixels are those of the patch, at stride 4."""
    x, y = torch.arange(0, 64, 2.0), torch.arange(0, 48, 2.0)
    maps = torch.stack(torch.meshgrid(x, y, indexing="xy"))[None, None]
    model = PatchVO(replace(FINE, fine_channels=2))
    features = replace(model.patchify.encode(torch.zeros(1, 1, 3, 48, 64)), fine=maps)
    cut = cut_fine(features, torch.tensor([[[[3, 5]]]]), 3)[0, 0]
    assert torch.equal(cut[0], torch.tensor([8.0, 12, 16]).expand(3, 3))
    assert torch.equal(cut[1], torch.tensor([16.0, 20, 24])[:, None].expand(3, 3))


def test_training_adds_the_level_to_weights_without_it(tmp_path):
    save_weights(tmp_path / "old.safetensors", PatchVO(preset("tiny")), {})
    old = load_weights(tmp_path / "old.safetensors")
    program = make_program(model="tiny", fine_channels=6)
    program.start_from(old)
    assert all(torch.equal(program.net.state_dict()[name], value) for name, value in old.model.state_dict().items())
    assert program.net.update.fine.layer.weight.abs().sum() == 0
    save_weights(tmp_path / "new.safetensors", program.net, {})
    loaded = load_weights(tmp_path / "new.safetensors")
    assert loaded.model.config.fine_channels == 6 and loaded.preset == "custom"
    with pytest.raises(DvoError, match="fine_channels: .*out of range"):
        ModelConfig(fine_channels=-1)


@torch.no_grad()
def test_the_tracker_reads_the_level(clip):
    """Zero columns leave the poses as they were, others do not."""
    shipped = load_weights("small").model
    model = with_weights_of(replace(shipped.config, fine_channels=6), shipped)
    camera = Camera(*clip.intrinsics[0].tolist(), 128, 96)
    frames = [Frame(i, 0.1 * i, image.permute(1, 2, 0).numpy(), camera) for i, image in enumerate(clip.images)]

    def targets(net):
        odometry = build_odometry(LoadedWeights.of(net, "mine"), initial_motion=0.0)
        for frame in frames:
            odometry.track(frame)
        return odometry.window.targets

    plain, zero = targets(shipped), targets(model)
    assert len(plain) and torch.equal(plain, zero)
    model.update.fine.layer.weight.normal_(std=0.01)
    assert not torch.equal(plain, targets(model))


def test_a_look_up_needs_the_level_that_the_network_has():
    graph = full_graph(2, 3, self_edges=False)
    with pytest.raises(AssertionError, match="no fine level"):
        FineLayer(FINE)(Correlation([torch.zeros(1, len(graph), 9)]))
