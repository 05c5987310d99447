"""Layers and sizes of the pose-regression network."""

import json

import pytest
import torch

from dvo.core.errors import DvoError
from dvo.nets.two_frame.deepvo import PRESETS, DeepVOConfig, PairEncoder, fit_images


def test_sizes_survive_json():
    for config in PRESETS.values():
        assert DeepVOConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"hidden": 3}, "hidden"),
        ({"height": 8}, "height"),
        ({"width": "wide"}, "width"),
        ({"layers": 1.5}, "layers"),
        ({"channels": [8] * 8}, "channels"),
        ({"channels": [8] * 8 + [0]}, "channels"),
        ({"channels": 8}, "channels"),
        ({"channels": [2048] * 9, "height": 1024, "width": 2048}, "channels"),
    ],
)
def test_sizes_of_no_network_are_refused(values, named):
    with pytest.raises(DvoError, match=f"^{named}: "):
        DeepVOConfig.from_dict(values)


@pytest.mark.parametrize("size", [(120, 160), (121, 129), (64, 200)])
def test_a_pair_has_the_stated_number_of_features(size):
    config = DeepVOConfig(*size, channels=(2,) * 9)
    assert PairEncoder(config)(torch.zeros(2, 4, 3, *size)).shape == (2, 3, config.pair_features)


def test_a_pair_is_two_neighbouring_images_in_their_order():
    torch.manual_seed(0)
    encoder = PairEncoder(PRESETS["tiny"])
    images = torch.rand(1, 4, 3, 48, 64)
    features = encoder(images)
    for k in range(3):
        torch.testing.assert_close(features[:, k : k + 1], encoder(images[:, k : k + 2]))
        assert not torch.allclose(features[:, k : k + 1], encoder(images[:, k : k + 2].flip(1)))


def test_images_are_averaged_where_they_shrink():
    images = torch.randint(0, 256, (2, 3, 96, 128), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    small = fit_images(images, 48, 64)
    assert small.shape == (2, 3, 48, 64)
    assert float(small.mean()) == pytest.approx(float(images.float().mean() / 127.5 - 1), abs=1e-2)
    assert small.std() < 0.7 * (images.float() / 127.5).std()
    assert torch.equal(fit_images(images, 96, 128), images.float() / 127.5 - 1)
