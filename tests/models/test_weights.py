"""Names and shapes of DPVO's checkpoint; reading and importing weights, good and bad."""

import json
import pickle
import subprocess
import sys

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import dvo
from dvo.core.errors import DvoError
from dvo.models.patch_vo import PatchVO
from dvo.models.registry import ARCHITECTURES, as_network
from dvo.models.weights import import_checkpoint, load_weights, save_weights, weights_info
from dvo.nets.patch.config import PRESETS, ModelConfig, preset
from dvo.nets.update.mamba import MambaUpdate
from dvo.nets.update.update import Update
from dvo.odometry.load import build_odometry
from dvo.odometry.patch.config import TRACKER_PRESETS


def dpvo_table() -> dict[str, tuple[int, ...]]:
    """Tensors of the official network, from its published layer sizes."""
    table: dict[str, tuple[int, ...]] = {}

    def layer(name: str, *shape: int) -> None:
        table[f"{name}.weight"], table[f"{name}.bias"] = shape, shape[:1]

    for net, outputs in (("fnet", 128), ("inet", 384)):
        at = f"patchify.{net}"
        layer(f"{at}.conv1", 32, 3, 7, 7)
        for block in (0, 1):
            for conv in (1, 2):
                layer(f"{at}.layer1.{block}.conv{conv}", 32, 32, 3, 3)
                inputs = 32 if (block, conv) == (0, 1) else 64
                layer(f"{at}.layer2.{block}.conv{conv}", 64, inputs, 3, 3)
        layer(f"{at}.layer2.0.downsample.0", 64, 32, 1, 1)
        layer(f"{at}.conv2", outputs, 64, 1, 1)
    d = 384
    names = [f"update.{c}.{i}" for c in ("c1", "c2") for i in (0, 2)]
    names += [f"update.{a}.{x}" for a in ("agg_kk", "agg_ij") for x in "fgh"]
    names += [f"update.gru.{g}.{x}" for g in (1, 3) for x in ("gate.0", "res.0", "res.2")]
    for name in [*names, "update.corr.2", "update.corr.5"]:
        layer(name, d, d)
    for name in ("update.norm", "update.gru.0", "update.gru.2", "update.corr.3"):
        layer(name, d)
    layer("update.corr.0", d, 882)
    layer("update.d.1", 2, d)
    layer("update.w.1", 2, d)
    return table


def official(seed: int = 0) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {name: torch.randn(shape, generator=g) * 0.01 for name, shape in dpvo_table().items()}


def test_full_preset_is_dpvo_tensor_for_tensor():
    state = PatchVO(preset("full")).state_dict()
    assert {name: tuple(t.shape) for name, t in state.items()} == dpvo_table()
    assert len(state) == 94
    assert sum(t.numel() for t in state.values()) == 3_384_324


def test_import_strips_prefix_and_swaps_colour_channels(tmp_path):
    state = official()
    wrapped = {f"module.{k}": v for k, v in state.items()} | {"module.update.lmbda": torch.zeros(1)}
    torch.save(wrapped, tmp_path / "dpvo.pth")
    info = import_checkpoint(tmp_path / "dpvo.pth", tmp_path / "full.safetensors")
    assert (info.preset, info.tensors, info.parameters) == ("full", 94, 3_384_324)
    loaded = load_weights(tmp_path / "full.safetensors")
    # BGR weights on a BGR image equal the imported ones on the RGB image.
    image = torch.rand(1, 3, 16, 16)
    first = loaded.model.patchify.fnet.conv1
    expected = torch.nn.functional.conv2d(image.flip(1), state["patchify.fnet.conv1.weight"], first.bias, 2, 3)
    torch.testing.assert_close(first(image), expected)
    torch.testing.assert_close(loaded.model.update.corr[0].weight, state["update.corr.0.weight"])


def test_half_precision_round_trip_keeps_card_and_architecture(tmp_path):
    model = PatchVO(preset("tiny"))
    save_weights(tmp_path / "t.safetensors", model, {"steps": 3})
    info = weights_info(tmp_path / "t.safetensors")
    assert (info.preset, info.card) == ("tiny", {"steps": 3})
    loaded = load_weights(tmp_path / "t.safetensors").model
    for a, b in zip(loaded.parameters(), model.parameters(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=1e-3)


def metadata(path):
    with safe_open(path, "pt") as file:
        return file.metadata()


def test_sizes_without_an_update_operator_are_of_the_gated_one(tmp_path):
    """Weights that are older than the word load as before, and give the same revisions."""
    torch.manual_seed(0)
    model = PatchVO(preset("tiny")).eval()
    values = {name: value for name, value in model.config.to_dict().items() if name != "update_operator"}
    said = {"config": json.dumps(values), "card": "{}", "format": "pt"}
    save_file(model.state_dict(), tmp_path / "old.safetensors", said)
    old = load_weights(tmp_path / "old.safetensors")
    assert old.preset == "tiny" and type(old.model.update) is Update
    images, intrinsics = torch.randint(0, 256, (1, 4, 3, 48, 64), dtype=torch.uint8), torch.tensor([50.0, 50, 32, 24])
    states = [
        network(images, intrinsics.expand(1, 4, 4), updates=2, generator=torch.Generator().manual_seed(1))
        for network in (model, old.model)
    ]
    assert torch.equal(states[0].targets, states[1].targets) and torch.equal(states[0].poses_cw, states[1].poses_cw)


def test_parts_that_networks_do_not_have_may_be_off_in_a_file(tmp_path):
    model, file = PatchVO(preset("tiny")), tmp_path / "older.safetensors"
    save_weights(file, model, {})
    with safe_open(file, "pt") as opened:
        metadata, tensors = opened.metadata(), {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    for parts, loads in (
        ({"fine_channels": 0, "fine_radius": 1, "score_head": False}, True),
        ({"fine_channels": 6}, False),
        ({"score_head": True}, False),
    ):
        config = json.dumps(json.loads(metadata["config"]) | parts)
        save_file(tensors, file, {**metadata, "config": config})
        if loads:
            assert load_weights(file).preset == "tiny"
            continue
        with pytest.raises(DvoError, match=f"older.safetensors.*{next(iter(parts))}.*Use weights without it"):
            load_weights(file)


def test_the_state_space_operator_is_carried_by_its_weights(tmp_path):
    save_weights(tmp_path / "m.safetensors", PatchVO(preset("mamba")), {})
    loaded = load_weights(tmp_path / "m.safetensors")
    assert loaded.preset == "mamba" and type(loaded.model.update) is MambaUpdate
    assert build_odometry(loaded).config == TRACKER_PRESETS["mamba"]


def test_a_file_names_its_architecture_and_one_without_is_patch_vo(tmp_path):
    model = PatchVO(preset("tiny"))
    save_weights(tmp_path / "new.safetensors", model, {})
    written = metadata(tmp_path / "new.safetensors")
    assert written["architecture"] == "patch_vo"
    del written["architecture"]
    save_file({k: t.half() for k, t in model.state_dict().items()}, tmp_path / "old.safetensors", written)
    new, old = (load_weights(tmp_path / f"{name}.safetensors") for name in ("new", "old"))
    assert new.architecture == old.architecture == old.info.architecture == "patch_vo"
    for a, b in zip(new.model.state_dict().values(), old.model.state_dict().values(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", ["never_imported:Class", "not_registered", ""])
def test_a_file_cannot_choose_what_is_imported(tmp_path, monkeypatch, name):
    (tmp_path / "never_imported.py").write_text("class Class: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "x.safetensors"
    save_file({"a": torch.zeros(1)}, path, {"architecture": name, "config": "{}"})
    with pytest.raises(DvoError, match="architecture") as caught:
        load_weights(path)
    assert str(path) in str(caught.value) and "patch_vo" in str(caught.value)
    assert "never_imported" not in sys.modules


class CountingConfig:
    """Sizes of a network of another architecture."""

    def __init__(self, width=2):
        self.width = width

    def __eq__(self, other):
        return self.width == other.width

    def to_dict(self):
        return {"width": self.width}

    @classmethod
    def from_dict(cls, values):
        return cls(**values)


class Counting(torch.nn.Module):
    """A network of another architecture, with a whole number in its state."""

    architecture = "counting"
    config_type = CountingConfig
    presets = {"wide": CountingConfig(9)}  # noqa: RUF012

    def __init__(self, config):
        super().__init__()
        self.config = config
        self.linear = torch.nn.Linear(config.width, 1)
        self.register_buffer("steps", torch.tensor(2**53 + 1))


def test_networks_of_another_architecture_by_name(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "another_package", type(sys)("another_package"))
    sys.modules["another_package"].Counting = Counting
    path = tmp_path / "c.safetensors"
    save_weights(path, Counting(CountingConfig(9)), {})
    with pytest.raises(DvoError, match="no architecture 'counting'"):
        dvo.load_model(path)
    ARCHITECTURES.register("counting", "another_package:Counting")
    try:
        loaded = load_weights(path)
        assert isinstance(loaded.model, Counting) and (loaded.architecture, loaded.preset) == ("counting", "wide")
        assert int(loaded.model.steps) == 2**53 + 1 and loaded.model.linear.weight.dtype == torch.float32
        assert isinstance(dvo.load_model(path), Counting)
        with pytest.raises(DvoError, match="no odometry.*counting"):
            dvo.load(str(path))
    finally:
        ARCHITECTURES.unregister("counting")


def test_a_module_without_an_architecture_is_no_network():
    with pytest.raises(DvoError, match="Linear.*'architecture'"):
        as_network(torch.nn.Linear(1, 1))


class Malicious:
    def __reduce__(self):
        return (print, ("executed",))


def bad_files(folder):
    (folder / "noise.safetensors").write_bytes(b"\x00" * 100)
    with open(folder / "pickle.safetensors", "wb") as file:
        pickle.dump(Malicious(), file)
    config = {"config": '{"hidden_channels": 48}', "card": "{}"}
    save_file({"a": torch.zeros(1)}, folder / "no_metadata.safetensors")
    save_file({"a": torch.zeros(1)}, folder / "wrong_tensors.safetensors", config)
    save_file({"a": torch.zeros(1)}, folder / "unknown_key.safetensors", {"config": '{"colour": 1}'})
    save_file({"a": torch.zeros(1)}, folder / "no_size.safetensors", {"config": json.dumps({"hidden_channels": -4})})
    model = PatchVO(preset("tiny"))
    torch.nn.init.constant_(model.update.norm.weight, torch.nan)
    save_weights(folder / "nan.safetensors", model, {})
    return sorted(folder.glob("*.safetensors"))


def test_bad_weights_give_one_clear_error(tmp_path, capsys):
    files = bad_files(tmp_path)
    assert len(files) == 7
    for path in [*files, tmp_path / "absent.safetensors"]:
        with pytest.raises(DvoError) as caught:
            load_weights(path)
        assert str(path) in str(caught.value)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("content", ["malicious", "empty", "noise", "list", "other", "misshapen"])
def test_bad_checkpoints_are_refused_without_running_code(tmp_path, capsys, content):
    path = tmp_path / "x.pth"
    if content == "malicious":
        torch.save({"module.x": Malicious()}, path)
    elif content == "list":
        torch.save([torch.zeros(2)], path)
    elif content == "other":
        torch.save({"w": torch.zeros(2)}, path)
    elif content == "misshapen":
        torch.save(official() | {"update.norm.weight": torch.zeros(3)}, path)
    else:
        path.write_bytes(b"" if content == "empty" else b"not a checkpoint")
    with pytest.raises(DvoError) as caught:
        import_checkpoint(path, tmp_path / "out.safetensors")
    assert str(path) in str(caught.value)
    assert "executed" not in capsys.readouterr().out
    assert not (tmp_path / "out.safetensors").exists()


@pytest.mark.parametrize(
    "wrong", [{"hidden_channels": 0}, {"pyramid": []}, {"pyramid": [1, -4]}, {"radius": 2.5}, {"patch_size": 2}]
)
def test_sizes_that_make_no_network_are_named(wrong):
    with pytest.raises(DvoError, match=next(iter(wrong))):
        ModelConfig.from_dict(wrong)


def test_unknown_setting_is_named():
    with pytest.raises(DvoError, match="colour"):
        ModelConfig.from_dict({"colour": 1})
    assert ModelConfig.from_dict(PRESETS["small"].to_dict()) == PRESETS["small"]


@pytest.mark.long
def test_loading_does_not_import_the_compiler_of_torch():
    names = ("small", "droid", "tartanvo", "deepvo")
    program = f"import sys, dvo; [dvo.load_model(name) for name in {names}]; assert 'torch._dynamo' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)
