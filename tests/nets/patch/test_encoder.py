"""Encoders of the patch-flow network: centring, reach, standardised images, sizes and weights of the light one."""

import json
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save_file

from dvo.core.errors import DvoError
from dvo.core.kernels import available
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import load_weights, save_weights
from dvo.nets.patch.config import ModelConfig, preset
from dvo.nets.patch.encoder import Encoder, LightEncoder, local_contrast, normalise, standardise_whole
from dvo.nets.patch.patchifier import ENCODERS

SIZE, PLACE = (160, 192), (20, 24)


def influence(encoder, part):
    """Rows and columns of the image that a feature in the middle depends on, with the weights made positive."""
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.abs_().add_(0.01)
    images = torch.rand(1, 3, *SIZE, dtype=torch.float64, requires_grad=True)
    row, column = PLACE
    getattr(encoder.double(), part)(images)[0, :, row, column].sum().backward()
    seen = images.grad[0].abs().sum(0) > 0
    return [torch.nonzero(seen.any(axis))[:, 0] for axis in (1, 0)]


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize(("part", "stride"), [("stem", 2), ("trunk", 4)])
def test_features_are_centred_on_multiples_of_the_stride(name, part, stride):
    """What a feature depends on reaches equally far to all sides of its image pixel."""
    for seen, place in zip(influence(ENCODERS[name](4, 8, 6, "none"), part), PLACE, strict=True):
        assert seen[0] + seen[-1] == 2 * stride * place


def test_the_light_encoder_sees_no_less_of_the_image():
    rows, light = (influence(one(4, 8, 6, "none"), "trunk")[0] for one in (Encoder, LightEncoder))
    assert len(light) == 57 and len(rows) == 51


@pytest.mark.parametrize("norm", ["instance", "none"])
@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize("size", [(64, 48), (62, 50), (61, 51)])
def test_sizes_of_the_maps(name, norm, size):
    encoder = ENCODERS[name](4, 8, 6, norm).eval()
    images = torch.randn(2, 3, *size)
    h, w = (-(-side // 4) for side in size)
    with torch.no_grad():
        maps = encoder(images)
        weight, bias = encoder.head(slice(2, 5))
        part = torch.einsum("ct,nthw->nchw", weight, encoder.trunk(images)) + bias[:, None, None]
    assert maps.shape == (2, 6, h, w)
    torch.testing.assert_close(part, maps[:, 2:5], atol=1e-4, rtol=1e-4)


def test_light_features_do_not_depend_on_brightness_and_contrast():
    torch.manual_seed(0)
    encoder, images = LightEncoder(4, 8, 6, "instance").eval(), torch.rand(1, 3, 48, 64)
    with torch.no_grad():
        torch.testing.assert_close(encoder(0.5 * images - 0.3), encoder(images), atol=1e-2, rtol=1e-2)
        flat = encoder(torch.full((1, 3, 48, 64), 0.7))
    assert torch.isfinite(flat).all()


def test_standardised_images():
    torch.manual_seed(0)
    images = torch.randn(2, 3, 20, 30) * torch.tensor([2.0, 0.1])[:, None, None, None] + 0.4
    found = standardise_whole(images)
    torch.testing.assert_close(found.mean((1, 2, 3)), torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.std((1, 2, 3)), torch.ones(2), atol=1e-2, rtol=0)
    assert (standardise_whole(torch.full((1, 3, 8, 8), 0.3)).abs() < 1e-3).all()
    dark = standardise_whole(torch.rand(1, 3, 20, 30) * 1e-3)
    assert dark.std() < 0.1


def test_faint_texture_beside_a_bright_window_has_the_contrast_of_strong_texture():
    torch.manual_seed(0)
    texture = torch.randn(1, 1, 64, 96).expand(1, 3, 64, 96)
    images = torch.cat([0.05 * texture[..., :48] - 0.3, 0.5 * texture[..., 48:] + 0.9], -1)
    found = local_contrast(images)
    faint, strong = found[..., 12:-12, 12:30].std(), found[..., 12:-12, 66:84].std()
    assert found.shape == (1, 1, 64, 96) and 0.8 < faint < 1.2 and 0.8 < strong < 1.2
    assert local_contrast(torch.full((2, 3, 61, 50), 0.7)).abs().max() < 1e-3


def test_local_contrast_of_a_part_is_that_of_the_whole():
    torch.manual_seed(0)
    images = torch.randn(1, 3, 96, 96)
    part = local_contrast(images[..., 8:, 16:])  # shifted by cells of four pixels, its borders away from them
    torch.testing.assert_close(part[..., 24:, 24:], local_contrast(images)[..., 32:, 40:], atol=1e-5, rtol=1e-5)


# -- sizes and weights -------------------------------------------------------------------------------------------------


def test_the_preset():
    config = preset("light")
    assert config == replace(preset("small"), encoder="light") != preset("small")
    assert ModelConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    with pytest.raises(DvoError, match="encoder"):
        ModelConfig(encoder="heavy")


def test_weights_of_the_light_network(tmp_path):
    torch.manual_seed(0)
    model = PatchVO(replace(preset("tiny"), encoder="light")).eval()
    save_weights(tmp_path / "w.safetensors", model, {})
    loaded = load_weights(tmp_path / "w.safetensors").model
    images = torch.randint(0, 256, (1, 3, 48, 64), dtype=torch.uint8)
    with torch.no_grad():
        for mine, theirs in zip(loaded.encoder(images), model.encoder(images), strict=True):
            torch.testing.assert_close(mine, theirs, atol=5e-3, rtol=1e-2)  # the file holds half precision


def test_sizes_that_name_no_encoder_are_of_the_residual_one(tmp_path):
    model = PatchVO(preset("tiny"))
    values = {name: value for name, value in model.config.to_dict().items() if name != "encoder"}
    save_file(model.state_dict(), tmp_path / "old.safetensors", {"config": json.dumps(values), "card": "{}"})
    loaded = load_weights(tmp_path / "old.safetensors")
    assert loaded.preset == "tiny" and isinstance(loaded.model.patchify.fnet, Encoder)
    assert load_weights("small").preset == "small"


@given(
    sizes=st.tuples(st.integers(1, 2), st.sampled_from([5, 8, 24]), st.integers(4, 40), st.integers(4, 40)),
    rectified=st.booleans(), skips=st.booleans(), mean=st.floats(-50, 50), seed=st.integers(0, 99),
)  # fmt: skip
def test_the_kernel_normalises_and_rectifies_as_its_twin(sizes, rectified, skips, mean, seed):
    generator = torch.Generator().manual_seed(seed)
    order = {"memory_format": torch.channels_last}
    x, skip = ((torch.randn(sizes, generator=generator) + shift).contiguous(**order) for shift in (mean, 0))
    found = normalise(x.clone(), torch.nn.InstanceNorm2d(sizes[1]), rectified, skip if skips else None)
    exact = torch.nn.functional.instance_norm(x.double())
    exact = exact.relu() if rectified else exact
    exact = (skip + exact).relu() if skips else exact
    torch.testing.assert_close(found.double(), exact, atol=1e-4, rtol=1e-4)


@pytest.mark.skipif(not available(), reason="kernels are not wanted")
@given(rectified=st.booleans(), skips=st.booleans(), seed=st.integers(0, 99))
def test_the_kernel_takes_and_gives_bfloat16_to_the_nearest(rectified, skips, seed):
    """As single precision of the same numbers, rounded at the end alone."""
    generator, order = torch.Generator().manual_seed(seed), {"memory_format": torch.channels_last}
    given = [torch.randn(1, 16, 9, 7, generator=generator).bfloat16().contiguous(**order) for _ in range(2)]
    norm, skip = torch.nn.InstanceNorm2d(16), given[1] if skips else None
    single = normalise(given[0].float(), norm, rectified, None if skip is None else skip.float())
    found = normalise(given[0].clone(), norm, rectified, skip)
    assert found.dtype == torch.bfloat16
    # Sums of vectorised loops may differ in the last bits, by which a few numbers are rounded to the other side.
    assert (found == single.bfloat16()).float().mean() > 0.97
    torch.testing.assert_close(found.float(), single, atol=1e-6, rtol=2**-8)


def test_the_kernel_computes_without_gradients_alone(monkeypatch):
    encoder = Encoder(8, 16, 6, "instance")
    images = torch.randn(1, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    recorded = encoder(images)
    recorded.sum().backward()
    assert encoder.conv1.weight.grad is not None and encoder.conv1.weight.grad.abs().sum() > 0
    with torch.no_grad():
        by_kernel = encoder(images)
        monkeypatch.setenv("DVO_KERNELS", "torch")
        by_twin = encoder(images)
    torch.testing.assert_close(by_kernel, by_twin, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(recorded.detach(), by_twin, atol=1e-4, rtol=1e-4)


def test_the_kernel_keeps_what_is_not_a_number():
    x = torch.ones(1, 8, 4, 4).contiguous(memory_format=torch.channels_last)
    x[0, 1, 2, 2] = torch.nan
    for kept in (x.bfloat16(), x):
        with torch.no_grad():
            found = normalise(kept, torch.nn.InstanceNorm2d(8))
        assert found[0, 0].eq(0).all() and found[0, 1].isnan().all()


@pytest.mark.skipif(not available(), reason="kernels are not wanted")
def test_channels_stay_last_for_the_kernel():
    """An image as a camera gives it, whose batch dimension has a stride of its own."""
    image = torch.randint(0, 256, (48, 64, 3), dtype=torch.uint8)
    with torch.no_grad():
        trunk = Encoder(8, 16, 6, "instance").trunk(image.permute(2, 0, 1)[None].float())
    assert trunk.is_contiguous(memory_format=torch.channels_last)
    trained = Encoder(8, 16, 6, "instance").trunk(torch.rand(1, 3, 48, 64))  # torch normalises this order slowly
    assert trained.is_contiguous()
