"""Weights files and checkpoints that are cut, damaged, or claim more than they hold: one error, no code, no memory."""

import json
import zipfile

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from dvo.core.errors import DvoError
from dvo.models import weights
from dvo.models.patch_vo import PatchVO
from dvo.models.registry import build_network
from dvo.models.weights import import_checkpoint, load_weights, save_weights, weights_info
from dvo.nets.patch.config import preset

HUGE = {
    "channels": ({"hidden_channels": 10**9}, "hidden_channels"),
    "more channels than memory": ({"stem_channels": 10**18}, "stem_channels"),
    "a number of 5,000 digits": ('{"radius": ' + "9" * 5000 + "}", "sizes of the network"),
    "a radius": ({"radius": 10**6}, "radius"),
    "a patch": ({"patch_size": 10**5 + 1}, "patch_size"),
    "a pyramid": ({"pyramid": [1] * 10**5}, "pyramid"),
    "a coarse pyramid": ({"pyramid": [10**9]}, "pyramid"),
    "all within their ranges": ({"radius": 16, "patch_size": 9, "pyramid": [1, 2, 4]}, "correlation channels"),
    "a boolean": ({"stem_channels": True}, "stem_channels"),
    "a text": ({"stem_channels": "8"}, "stem_channels"),
    "a text for the pyramid": ({"pyramid": "14"}, "pyramid"),
    "a number for the pyramid": ({"pyramid": 4}, "pyramid"),
    "an unknown operator": ({"update_operator": "os:system"}, "update operator"),
    "a number for the operator": ({"update_operator": 3}, "update_operator"),
    "a list": ("[]", "sizes of the network"),
    "nested lists": ("[" * 100_000, "sizes of the network"),
    "no JSON": ("{", "sizes of the network"),
}


@pytest.mark.parametrize("case", HUGE)
def test_metadata_that_claims_too_much_is_refused(tmp_path, case):
    config, message = HUGE[case]
    path = tmp_path / "w.safetensors"
    save_file({"a": torch.zeros(1)}, path, {"config": config if isinstance(config, str) else json.dumps(config)})
    with pytest.raises(DvoError, match=message) as error:
        load_weights(path)
    assert str(error.value).startswith(f"{path}: ") or case == "an unknown operator"
    assert len(str(error.value)) < len(str(path)) + 300


def test_no_memory_is_taken_for_sizes_that_the_file_does_not_hold(tmp_path, monkeypatch):
    path, devices = tmp_path / "w.safetensors", []

    def spy(architecture, config):
        devices.append(torch.empty(0).device.type)
        return build_network(architecture, config)

    monkeypatch.setattr(weights, "build_network", spy)
    config = {"stem_channels": 512, "trunk_channels": 512, "feature_channels": 1024, "hidden_channels": 2048}
    save_file({"a": torch.zeros(1)}, path, {"config": json.dumps(config)})
    with pytest.raises(DvoError, match="misses tensors"):
        load_weights(path)
    assert devices == ["meta"]


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.uint8])
def test_whole_numbers_for_weights_are_refused(tmp_path, dtype):
    path = tmp_path / "w.safetensors"
    save_weights(path, PatchVO(preset("tiny")), {})
    with safe_open(path, "pt") as file:
        tensors, metadata = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()  # noqa: SIM118
    name = "update.norm.weight"
    save_file(tensors | {name: torch.ones(tensors[name].shape, dtype=dtype)}, path, metadata)
    with pytest.raises(DvoError, match="update.norm.weight: has wrongly typed tensors"):
        load_weights(path)


@pytest.mark.parametrize("card", ["[1]", "3", "{", "[" * 100_000])
def test_a_card_that_is_no_table_is_refused(tmp_path, card):
    path = tmp_path / "w.safetensors"
    config = json.dumps(preset("tiny").to_dict())
    save_file({"a": torch.zeros(1)}, path, {"config": config, "card": card})
    with pytest.raises(DvoError, match="card: metadata with not a table of facts"):
        weights_info(path)


@pytest.mark.parametrize("kept", [0, 1, 3, 7, 8, 9, 40, 200, 700, 900, 0.25, 0.5, 0.9, 0.999])
def test_cut_weights_are_refused(tmp_path, kept):
    path = tmp_path / "w.safetensors"
    save_weights(path, PatchVO(preset("tiny")), {})
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with pytest.raises(DvoError, match="not a safetensors file"):
        load_weights(path)


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
@pytest.mark.parametrize("kept", [0, 1, 2, 3, 4, 30, 64, 100, 0.1, 0.5, 0.9, 0.99, 0.9999])
def test_cut_checkpoints_are_refused(tmp_path, kept, zipped):
    path = tmp_path / "x.pth"
    torch.save({"w": torch.arange(20_000.0), "b": torch.zeros(7)}, path, _use_new_zipfile_serialization=zipped)
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with pytest.raises(DvoError, match="cannot be read as plain tensors") as error:
        import_checkpoint(path, tmp_path / "out.safetensors")
    assert "\n" not in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_damaged_checkpoints_never_raise_another_error(tmp_path, zipped):
    path, generator = tmp_path / "x.pth", np.random.default_rng(0)
    torch.save({"w": torch.arange(20.0), "b": torch.zeros(7)}, path, _use_new_zipfile_serialization=zipped)
    data = path.read_bytes()
    for _ in range(100):
        damaged = bytearray(data)
        for place in generator.integers(0, len(data), 6):
            damaged[place] = generator.integers(0, 256)
        path.write_bytes(damaged)
        with pytest.raises(DvoError):
            import_checkpoint(path, tmp_path / "out.safetensors")


CONTENTS = {
    "a number": 3,
    "nothing": {},
    "numbers for names": {1: torch.zeros(2)},
    "a sparse tensor": {"w": torch.eye(3).to_sparse()},
    "a tensor without memory": {"w": torch.zeros(3, device="meta")},
    "texts": {"w": "text"},
    "a state that is a list": {"state_dict": [1]},
}


@pytest.mark.parametrize("case", CONTENTS)
def test_checkpoints_of_other_content(tmp_path, case):
    path = tmp_path / "x.pth"
    torch.save(CONTENTS[case], path)
    with pytest.raises(DvoError, match=r"no state dict|no dense tensor|misses tensors"):
        import_checkpoint(path, tmp_path / "out.safetensors")


def test_a_tensor_that_repeats_one_number_is_not_spread_out(tmp_path):
    path = tmp_path / "x.pth"
    official = PatchVO(preset("full")).state_dict()
    torch.save(official | {"patchify.fnet.conv1.weight": torch.zeros(1).half().expand(2**40)}, path)
    with pytest.raises(DvoError, match="wrongly shaped"):
        import_checkpoint(path, tmp_path / "out.safetensors")


def test_a_compressed_checkpoint_is_not_unpacked(tmp_path):
    path, bomb = tmp_path / "x.pth", tmp_path / "bomb.pth"
    torch.save({"w": torch.zeros(10**6)}, path)
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            new.writestr(entry, old.read(entry))
    assert bomb.stat().st_size < 10**5
    with pytest.raises(DvoError, match="compressed entries"):
        import_checkpoint(bomb, tmp_path / "out.safetensors")


def test_weights_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DvoError, match="cannot be written"):
        save_weights(tmp_path / "file" / "w.safetensors", PatchVO(preset("tiny")), {})
    with pytest.raises(DvoError, match="cannot be written"):
        save_weights(tmp_path, PatchVO(preset("tiny")), {})


def test_a_checkpoint_of_4_gb_is_not_read(tmp_path):
    path = tmp_path / "x.pth"
    torch.save({"w": torch.zeros(3)}, path)
    with path.open("r+b") as file:
        file.truncate(4 * 1024**3)  # without taking the place on the disk
    with pytest.raises(DvoError, match="larger than 2 GB"):
        import_checkpoint(path, tmp_path / "out.safetensors")
