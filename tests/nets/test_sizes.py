"""Sizes of networks: plain values, lists of sizes, presets by name."""

import json

import pytest

from dvo.core.errors import DvoError
from dvo.models.registry import ARCHITECTURES, network_class
from dvo.nets.patch.config import ModelConfig
from dvo.nets.sizes import check_sizes, named_preset


@pytest.mark.parametrize("architecture", ["patch_vo", "deepvo", "tartanvo", "droid"])
def test_presets_survive_json(architecture):
    assert architecture in ARCHITECTURES
    network = network_class(architecture)
    for config in network.presets.values():
        assert network.config_type.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_lists_become_tuples_where_the_attribute_is_one():
    given = {"pyramid": [1, 2]}
    assert ModelConfig.from_dict(given).pyramid == (1, 2) and given == {"pyramid": [1, 2]}
    with pytest.raises(DvoError, match=r"^radius: .*\[3\]"):
        ModelConfig.from_dict({"radius": [3]})
    with pytest.raises(DvoError, match="^colour: unknown setting of ModelConfig"):
        ModelConfig.from_dict({"colour": 1})


@pytest.mark.parametrize("sizes", [[1, 2], 3, (), (1,) * 4, (0,), (9,), (True,), (1.5,)])
def test_lists_that_hold_no_sizes_are_named(sizes):
    check_sizes((1, 8), "channels", (1, 3), 8)
    with pytest.raises(DvoError, match="^channels: "):
        check_sizes(sizes, "channels", (1, 3), 8)


@pytest.mark.parametrize("name", ["huge", 3, None, ["tiny"]])
def test_unknown_presets_are_named(name):
    presets = {"tiny": 1, "small": 2}
    assert named_preset(presets, "tiny") == 1
    with pytest.raises(DvoError, match="^preset: no preset .*one of tiny, small"):
        named_preset(presets, name)
    with pytest.raises(DvoError, match="^model: "):
        named_preset(presets, name, "model")
