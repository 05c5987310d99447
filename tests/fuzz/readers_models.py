"""Readers of networks: weights, their import, and the states of training."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz import text
from tests.fuzz.mutations import mutate_folder
from tests.fuzz.target import Target, chance, require

MODULES = ("torch", "safetensors.torch", "dvo.models.weights", "dvo.models.patch_vo", "dvo.odometry.load",
           "dvo.odometry.patch.tracker")  # fmt: skip
TRAINING = (*MODULES, "train.engine.export", "train.engine.checkpoint", "train.tasks.patch_vo.task",
            "train.validation.validate")  # fmt: skip


def _network(preset: str) -> Any:
    import torch

    from dvo.models.registry import build_network, network_class

    torch.manual_seed(0)
    return build_network("patch_vo", network_class("patch_vo").presets[preset])


def _weights(folder: Path) -> None:
    from dvo.models.weights import save_weights

    save_weights(folder / "w.safetensors", _network("tiny"), {"steps": 3, "licence": "MIT"})


def _read_weights(folder: Path, random: np.random.Generator | None) -> None:
    from dvo.models.weights import list_weights, load_weights, weights_info

    weights_info(folder / "w.safetensors")
    model = load_weights(folder / "w.safetensors").model
    require(all(bool(tensor.isfinite().all()) for tensor in model.state_dict().values()), "weights not finite")
    require(list_weights(), "no shipped weights")


def mutate_header(folder: Path, random: np.random.Generator) -> str:
    """Change a file of the input; half of the time, the header of a safetensors file as text.

    Args:
        folder: of the input.
        random: source of all choices.

    Returns:
        Description of the change.
    """
    if random.random() < 0.4:
        return mutate_folder(folder, random)
    file = folder / "w.safetensors"
    data = file.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    part, said = folder / "part.json", "metadata"
    if random.random() < 0.7:  # keys inside the texts of the metadata
        name = ("config", "card", "architecture")[int(random.integers(3))]
        part.write_text(header["__metadata__"][name], encoding="utf-8")
        said = f"{name}: {text.MUTATIONS[int(random.integers(5))](part, random)}"
        header["__metadata__"][name] = part.read_bytes().decode("utf-8", errors="replace")
        changed = json.dumps(header).encode()
    else:
        part.write_text(json.dumps(header), encoding="utf-8")
        said = f"header: {text.MUTATIONS[int(random.integers(5))](part, random)}"
        changed = part.read_bytes()
    part.unlink()
    file.write_bytes(struct.pack("<Q", len(changed)) + changed + data[8 + length :])
    return said


def _checkpoint(folder: Path) -> None:
    import torch

    torch.save({f"module.{key}": value for key, value in _network("full").state_dict().items()}, folder / "dpvo.pth")


def _import(folder: Path, random: np.random.Generator | None) -> None:
    from dvo.models.weights import import_checkpoint

    import_checkpoint(folder / "dpvo.pth", folder / "out.safetensors")


ODD: list[Any] = [None, 3, "text", [], {}, [1, "a"], {"a": 1}, 1.5, -1, float("nan"), b"x", (), {"b": [None]}, 10**400,
                  "../../x", True]  # fmt: skip


def mutate_pickle(folder: Path, random: np.random.Generator) -> str:
    """Change a file of the input; half of the time, one entry of a pickled dictionary.

    Args:
        folder: of the input, with one pickled file.
        random: source of all choices.

    Returns:
        Description of the change.
    """
    import torch

    if random.random() < 0.5:
        return mutate_folder(folder, random)
    file = next(path for path in sorted(folder.iterdir()) if path.suffix in (".pth", ".ckpt"))
    whole = torch.load(file, weights_only=False)
    inner, said = whole, ""
    while True:
        key = list(inner)[int(random.integers(len(inner)))]
        said += f".{key}"
        if not isinstance(inner[key], dict) or not inner[key] or random.random() < 0.3:
            break
        inner = inner[key]
    odd: list[Any] = [*ODD, torch.zeros(3), torch.full((2, 2), torch.nan), torch.zeros(1, dtype=torch.complex64),
                      torch.zeros(4, 4).to_sparse(), torch.zeros((1,)).expand(10**6, 10**6)]  # fmt: skip
    value = odd[int(random.integers(len(odd)))]
    if random.random() < 0.3:
        del inner[key]
        said += " removed"
    else:
        inner[key] = value
        said += f" is {str(value)[:40]}"
    torch.save(whole, file)
    return said


def _state(folder: Path) -> None:
    import torch

    state = {key: value for key, value in _network("tiny").state_dict().items()}
    network = _network("tiny")
    torch.save(
        {
            "state_dict": {f"{name}.{key}": value for name in ("net", "average") for key, value in state.items()},
            "hyper_parameters": {"model": "tiny", "seed": 0, "learning_rate": 4e-4},
            "global_step": 10,
            "network": {"architecture": "patch_vo", "config": network.config.to_dict()},
            "task": "patch_vo",
            "Renderings": {"clips_seen": 10},
            "callbacks": {},
        },
        folder / "s.ckpt",
    )
    (folder / "card.json").write_text('{"hours": 3, "text": "a card"}', encoding="utf-8")


def _export(folder: Path, random: np.random.Generator | None) -> None:
    from train.engine.export import export, export_state

    file = str(folder / "s.ckpt")
    if not chance(random, 0.3):
        export([file, str(folder / "out.safetensors"), "--card", str(folder / "card.json")])
    else:
        export_state([file, str(folder / "out.ckpt")])


def _validate(folder: Path, random: np.random.Generator | None) -> None:
    from train.engine.checkpoint import task_of
    from train.validation.validate import main

    main([str(folder / "s.ckpt"), "--sequences"])
    if not chance(random, 0.5):
        from train.engine.checkpoint import read_state

        task_of(read_state(folder / "s.ckpt"))


TARGETS = (
    Target("weights", _weights, _read_weights, mutate_header, MODULES),
    Target("weights_import", _checkpoint, _import, mutate_pickle, MODULES),
    Target("train_export", _state, _export, mutate_pickle, TRAINING),
    Target("train_validate", _state, _validate, mutate_pickle, TRAINING),
)
