"""TartanVO's published network: names, shapes and outputs of the published code, and import of its checkpoint.

``tartanvo_published.json`` was written by the published code on the CPU, with its correlation, which needs a GPU,
computed by :func:`published_correlation`: the tensors, and the outputs for the weights and images below.
"""

import json
from pathlib import Path

import pytest
import torch

from dvo.core.errors import DvoError
from dvo.models.published import read_published
from dvo.models.tartanvo import TartanVO
from dvo.models.weights import LoadedWeights, import_checkpoint, load_weights
from dvo.nets.correlation.local_correlation import local_correlation
from dvo.nets.two_frame.pwc_net import PWCNet, warp_inside
from dvo.nets.two_frame.tartanvo import TartanVOConfig, preset
from dvo.odometry.load import build_odometry

GOLDEN = json.loads(Path(__file__).with_name("tartanvo_published.json").read_text())
HEIGHT, WIDTH = 320, 576


def weight(number, shape):
    """Zero biases, and other weights spread like noise, the same on every machine."""
    if len(shape) == 1:
        return torch.zeros(shape)
    noise = torch.sin(torch.arange(torch.Size(shape).numel(), dtype=torch.float64) * 12.9898 + number) * 43758.5453
    fan = torch.Size(shape[1:]).numel()
    return ((noise - noise.floor()) * 2 - 1).reshape(shape).float() * (4.2 / fan) ** 0.5


def image(shift):
    x, y = torch.arange(WIDTH, dtype=torch.float64), torch.arange(HEIGHT, dtype=torch.float64)[:, None]
    channels = [
        127.5 + 80 * torch.sin((x - shift) / (9 + c)) + 40 * torch.cos((y + 0.5 * shift) / (7 + c) + x / 31)
        for c in range(3)
    ]
    return torch.stack(channels)[None].round().float()


def published_correlation(first, second):
    """Mean over the channels of the products, by displacement: rows first, then columns, each from -4 to 4."""
    h, w = first.shape[-2:]
    padded = torch.nn.functional.pad(second, (4, 4, 4, 4))
    return torch.stack([(first * padded[:, :, k // 9 : k // 9 + h, k % 9 : k % 9 + w]).mean(1) for k in range(81)], 1)


@pytest.fixture(scope="module")
def state():
    """Checkpoint as the published code would have saved it: in the order of the names, and trained in parallel."""
    names = sorted(GOLDEN["tensors"])
    return {f"module.{name}": weight(n, GOLDEN["tensors"][name]) for n, name in enumerate(names)}


def test_full_preset_is_the_published_network_tensor_for_tensor():
    with torch.device("meta"):
        mine = TartanVO(preset("full")).state_dict()
    state = {name: torch.empty(shape, device="meta") for name, shape in GOLDEN["tensors"].items()}
    blank = read_published(state).tensors
    assert {name: tuple(t.shape) for name, t in mine.items()} == {name: tuple(t.shape) for name, t in blank.items()}
    assert (len(mine), sum(t.numel() for t in mine.values())) == (248, 24_509_482)


@pytest.mark.long
def test_an_imported_checkpoint_gives_the_published_outputs(state, tmp_path):
    torch.save(state, tmp_path / "tartanvo.pkl")
    info = import_checkpoint(tmp_path / "tartanvo.pkl", tmp_path / "full.safetensors")
    assert (info.architecture, info.preset, info.tensors) == ("tartanvo", "full", 248)
    assert info.card["origin"] == "TartanVO checkpoint"
    model = load_weights(tmp_path / "full.safetensors").model
    # The published code takes the centre of the image's corner pixel for 0.5.
    intrinsics = torch.tensor([[400.0, 410.0, 288.0 - 0.5, 150.0 - 0.5]])
    with torch.no_grad():
        motion = model(image(0.0), image(3.0), intrinsics)
    flow = motion.flows.flow[0, :, ::16, ::24] * model.STRIDE
    torch.testing.assert_close(flow.flatten(0, 1), torch.tensor(GOLDEN["flow"]), atol=1e-3, rtol=1e-3)
    # The published order of the axes is forward, right, down.
    forward, right, down, roll, pitch, yaw = GOLDEN["pose"]
    torch.testing.assert_close(motion.translation[0], torch.tensor([right, down, forward]), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(motion.rotation[0], torch.tensor([pitch, yaw, roll]), atol=1e-6, rtol=1e-4)


def test_the_intrinsics_layer_is_that_of_the_published_code():
    """Rays of image pixels 4u + 1.5: the mean of those that a map at a quarter of the resolution covers."""
    net = TartanVO(preset("full")).pose
    seen = []
    net.firstconv.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    with torch.no_grad():
        net(torch.ones(1, 2, 64, 96), torch.tensor([[400.0, 410.0, 190.0, 120.0]]))
    x, y = torch.arange(384.0).unflatten(0, (96, 4)).mean(1), torch.arange(256.0).unflatten(0, (64, 4)).mean(1)
    torch.testing.assert_close(seen[0][0, 2, 0], (x - 190) / 400)
    torch.testing.assert_close(seen[0][0, 3, :, 0], (y - 120) / 410)
    torch.testing.assert_close(seen[0][0, :2], torch.full((2, 64, 96), 0.2))  # 4 image pixels of 20


def test_the_correlation_is_that_of_the_published_code():
    first, second = torch.randn(2, 1, 8, 6, 7, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(local_correlation(first, second, 4) / 8**0.5, published_correlation(first, second))


def test_pixels_at_the_border_are_not_faded_out():
    features, flow = torch.ones(1, 2, 4, 5), torch.zeros(1, 2, 4, 5)
    flow[:, 0] = 0.5
    assert (warp_inside(features, flow)[..., -1] == 0).all() and (warp_inside(features, flow)[..., :-1] == 1).all()
    torch.testing.assert_close(warp_inside(features, flow * 0), features)


def test_sides_that_are_no_multiples_of_64_are_taken():
    torch.manual_seed(0)
    model = TartanVO(preset("full")).eval()
    a, b = torch.randint(0, 256, (2, 1, 3, 131, 210), dtype=torch.uint8)
    with torch.no_grad():
        assert model.flow(a, b).shape == (1, 2, 33, 53)
        assert torch.isfinite(model(a, b, torch.tensor([[200.0, 200, 105, 65]])).poses_ab()).all()
    with pytest.raises(DvoError, match="at least 128x128"):
        model.flow(a[..., :127], b[..., :127])
    assert build_odometry(LoadedWeights.of(model, "full")).config.pixels == 640 * 480


def test_every_used_parameter_gets_a_gradient():
    torch.manual_seed(0)
    net = PWCNet()
    a, b = torch.rand(2, 1, 3, 128, 128)
    flows = net.match(net.encode(a), net.encode(b))
    sum(level.square().mean() for level in flows.levels).backward()
    missing = [name for name, p in net.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()]
    assert missing == ["deconv2.weight", "deconv2.bias"]  # which the published code does not use


def test_other_checkpoints_are_refused(state, tmp_path):
    path = tmp_path / "x.pkl"
    short = dict(list(state.items())[:-1])
    for wrong, message in ((short, "misses"), (state | {"module.flowNet.conv9.weight": torch.zeros(1)}, "unknown")):
        torch.save(wrong, path)
        with pytest.raises(DvoError, match=message):
            import_checkpoint(path, tmp_path / "out.safetensors")
    assert not (tmp_path / "out.safetensors").exists()


def test_sizes_of_the_published_network_are_fixed():
    with pytest.raises(DvoError, match="design"):
        TartanVOConfig(design="published", radius=2)
    with pytest.raises(DvoError, match="design"):
        TartanVOConfig(design="wide")
    assert TartanVOConfig.from_dict(preset("full").to_dict()) == preset("full")
