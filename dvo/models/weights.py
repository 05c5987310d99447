"""Weights files: safetensors with architecture and sizes in the metadata; import of published checkpoints."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from dvo.core.arguments import checked_arguments
from dvo.core.context import use_threads
from dvo.core.errors import DvoError
from dvo.core.limits import limit_error
from dvo.core.text import choice
from dvo.data.files.output import replaced
from dvo.models.pickles import check_plain, load_pickle
from dvo.models.published import read_published
from dvo.models.registry import (
    DEFAULT_ARCHITECTURE,
    NetworkConfig,
    as_network,
    build_network,
    network_class,
    preset_name,
)

FOLDER = Path(__file__).resolve().parent.parent / "weights"
"""Folder of the weights that ship with the package."""

_METADATA = 1_000_000  # characters of the sizes, or of the model card
_OTHER = "give weights of this network"
_DRAWN = {Tensor.normal_, Tensor.log_normal_, Tensor.exponential_, Tensor.cauchy_, Tensor.geometric_}


@dataclass(frozen=True)
class WeightsInfo:
    """Contents of a weights file, without its tensors.

    Attributes:
        name: stem of the file.
        path: the file.
        architecture: name in :data:`dvo.models.registry.ARCHITECTURES`.
        preset: preset with these sizes, or ``custom``.
        config: sizes of the network.
        parameters, tensors: counts.
        sha256: of the file.
        card: free facts of the model card: training steps, hours, licence, validation figures.
    """

    name: str
    path: Path
    architecture: str
    preset: str
    config: NetworkConfig
    parameters: int
    tensors: int
    sha256: str
    card: dict[str, Any]


@dataclass(frozen=True)
class LoadedWeights:
    """A network with its origin.

    Attributes:
        model: the network, in evaluation mode.
        name: of the weights; reports call the odometry ``dvo-NAME``.
        architecture: name in :data:`dvo.models.registry.ARCHITECTURES`.
        preset: preset with the network's sizes, or ``custom``.
        info: the weights file; None for a network from elsewhere, for instance from a training checkpoint.
    """

    model: nn.Module
    name: str
    architecture: str
    preset: str
    info: WeightsInfo | None = None

    @classmethod
    def of(cls, model: nn.Module, name: str, info: WeightsInfo | None = None) -> LoadedWeights:
        """Describe a network that is in memory already.

        Raises:
            DvoError: a module that does not name its architecture and sizes.
        """
        network = as_network(model)
        return cls(model, name, network.architecture, preset_name(network, network.config), info)


def tensor_digest(model: nn.Module) -> str:
    """Digest of the tensors of a network, which tells networks apart whatever file they come from.

    Args:
        model: on any device.

    Returns:
        SHA-256 of names, types, shapes and values, in hexadecimal digits.
    """
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        values = tensor.detach().cpu().contiguous()
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}\n".encode())
        digest.update(values.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


@checked_arguments
def find_weights(name_or_file: str | Path) -> Path:
    """The file of shipped weights by name, or a file by path.

    Args:
        name_or_file: a path wins over a name.

    Raises:
        DvoError: neither.
    """
    path = Path(name_or_file)
    if path.is_file():
        return path
    shipped = FOLDER / f"{name_or_file}.safetensors"
    if path.name == str(name_or_file) and shipped.is_file():
        return shipped
    names = sorted(p.stem for p in FOLDER.glob("*.safetensors"))
    remedy = choice(name_or_file, names or ["none"], "give a file, or one of:")
    raise DvoError("no such weights", file=name_or_file, remedy=remedy)


def architecture_of(name_or_file: str | Path) -> str:
    """Architecture that a weights file names, without reading its tensors.

    Args:
        name_or_file: shipped weights by name, or a safetensors file.

    Raises:
        DvoError: no such file, or not safetensors.
    """
    path = find_weights(name_or_file)
    try:
        with safe_open(path, framework="pt") as file:
            return str((file.metadata() or {}).get("architecture", DEFAULT_ARCHITECTURE))
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise DvoError("not a safetensors file", file=path, remedy="give dvo weights") from error


def _open(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, framework="pt") as file:
            return {key: file.get_tensor(key) for key in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except (
        MemoryError,
        SafetensorError,
        OSError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        RuntimeError,
    ) as error:
        raise limit_error(error, path) or DvoError(
            f"not a safetensors file ({' '.join(str(error).split())[:200]})",
            file=path,
            remedy="give dvo weights; a checkpoint of DPVO is converted by 'dvo weights import FILE'",
        ) from error


def _parse(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> WeightsInfo:
    architecture = metadata.get("architecture", DEFAULT_ARCHITECTURE)
    network = network_class(architecture, path)
    values = _table(path, metadata, "config")
    try:
        config = network.config_type.from_dict(values)
    except (ValueError, TypeError, AttributeError, DvoError) as error:
        raise DvoError(
            f"metadata does not give the sizes of the network ({error})",
            file=path,
            field="config",
            remedy="give dvo weights",
        ) from error
    card = _table(path, {"card": "{}", **metadata}, "card")
    count = sum(t.numel() for t in tensors.values())
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    preset = preset_name(network, config)
    return WeightsInfo(path.stem, path, architecture, preset, config, count, len(tensors), digest, card)


def _table(path: Path, metadata: dict[str, str], name: str) -> dict[str, Any]:
    """Table in JSON that the metadata holds under a name."""
    text = metadata.get(name)
    try:
        value = json.loads(text) if text is not None and len(text) <= _METADATA else None
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        problem = "no" if text is None else "not a table of"
        content = "sizes of the network" if name == "config" else "facts of a model card"
        raise DvoError(f"metadata with {problem} {content}", file=path, field=name, remedy="give dvo weights")
    return value


@checked_arguments
def weights_info(name_or_file: str | Path) -> WeightsInfo:
    """Contents of a weights file, without its tensors.

    Raises:
        DvoError: as :func:`load_weights`, but for the tensors, which are counted and not compared.
    """
    path = find_weights(name_or_file)
    return _parse(path, *_open(path))


def list_weights() -> list[WeightsInfo]:
    """The weights that ship with the package."""
    return [weights_info(path) for path in sorted(FOLDER.glob("*.safetensors"))]


@checked_arguments
def load_weights(name_or_file: str | Path, device: torch.device | str = "cpu") -> LoadedWeights:
    """Read a network of any architecture.

    Args:
        name_or_file: shipped weights by name, or a safetensors file. A file that names no architecture holds
            ``patch_vo``.
        device: where to put the network.

    Raises:
        DvoError: no such file; not safetensors (a pickle is never opened here); an architecture that is not
            registered; tensors that are missing, of the wrong shape, or not finite; a forked process, see
            :func:`dvo.core.context.use_threads`.
    """
    use_threads()
    path = find_weights(name_or_file)
    tensors, metadata = _open(path)
    info = _parse(path, tensors, metadata)
    _compare(_skeleton(info.architecture, info.config), tensors, path)  # before memory of the stated sizes is taken
    model = build_network(info.architecture, info.config)
    _fill(model, tensors, path)
    return LoadedWeights.of(model.to(device).eval(), info.name, info)


@checked_arguments
def load_model(name_or_file: str | Path = "small", device: torch.device | str = "cpu") -> nn.Module:
    """The bare network of a weights file, in evaluation mode.

    Args:
        name_or_file: shipped weights by name, or a safetensors file.
        device: where to put the network.

    Returns:
        The network, in evaluation mode; its class is that of the architecture in the file
        (:class:`dvo.models.patch_vo.PatchVO` of ``small``).

    Raises:
        DvoError: no such file; not safetensors; an architecture that is not registered; tensors that are missing, of
            the wrong shape, or not finite; a forked process.

    Example:
        >>> sum(parameter.numel() for parameter in dvo.load_model("small").parameters())
        462692
    """
    return load_weights(name_or_file, device).model


def _skeleton(architecture: str, config: NetworkConfig) -> nn.Module:
    """Network with shapes and no memory for its tensors, if it can be built so."""
    try:
        with torch.device("meta"), _Undrawn():
            return build_network(architecture, config)
    except (NotImplementedError, RuntimeError):  # a constructor that reads values of its tensors
        return build_network(architecture, config)


class _Undrawn(TorchFunctionMode):
    """Draws no numbers for tensors without memory: torch would import its compiler for it, which takes seconds."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in _DRAWN and args and args[0].is_meta:
            return args[0]
        return func(*args, **(kwargs or {}))


def _compare(model: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Raise DvoError unless names, shapes and kinds of numbers are those of the network."""
    wanted = model.state_dict()
    missing, extra = sorted(set(wanted) - set(tensors)), sorted(set(tensors) - set(wanted))
    shared = [k for k in wanted if k in tensors]
    wrong = [k for k in shared if wanted[k].shape != tensors[k].shape]
    kinds = [k for k in shared if wanted[k].is_floating_point() != tensors[k].is_floating_point()]
    kinds += [k for k in shared if tensors[k].is_complex()]
    for problem, names in (
        ("misses", missing), ("has unknown", extra), ("has wrongly shaped", wrong), ("has wrongly typed", kinds),
    ):  # fmt: skip
        if names:
            raise DvoError(f"{problem} tensors ({len(names)})", file=path, field=names[0][:200], remedy=_OTHER)


def _fill(model: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    _compare(model, tensors, path)
    bad = [k for k, t in tensors.items() if not torch.isfinite(t.float()).all()]
    if bad:
        raise DvoError("holds numbers that are not finite", file=path, field=bad[0], remedy="use another checkpoint")
    model.load_state_dict({k: t.float() if t.is_floating_point() else t for k, t in tensors.items()})


@checked_arguments
def save_weights(path: str | Path, model: nn.Module, card: dict[str, Any], half: bool = True) -> None:
    """Write a network as safetensors, with its architecture and sizes in the metadata.

    Args:
        path: file to write; its folder is made if need be.
        model: a network as :class:`dvo.models.registry.Network` describes it.
        card: facts for the model card, JSON-able.
        half: store float16.

    Raises:
        DvoError: a module that does not name its architecture and sizes, or a file that cannot be written.
    """
    network = as_network(model)
    dtype = torch.float16 if half else torch.float32
    tensors = {
        k: (t.to(dtype) if t.is_floating_point() else t).detach().cpu().contiguous()
        for k, t in model.state_dict().items()
    }
    metadata = {
        "architecture": network.architecture, "config": json.dumps(network.config.to_dict()), "card": json.dumps(card),
        "format": "pt",
    }  # fmt: skip
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as part:
            save_file(tensors, part, metadata)
    except (OSError, SafetensorError) as error:
        raise DvoError(f"cannot be written ({error})", file=path, remedy="give a file in another folder") from error


def import_checkpoint(file: str | Path, out: str | Path) -> WeightsInfo:
    """Convert a published checkpoint (a pickled state dict) into weights of a ``full`` preset.

    The pickle is read with ``weights_only=True``, which runs no code. What is changed in the tensors:
    :func:`dvo.models.published.read_published`; and the input channels of the first convolutions of DPVO and TartanVO
    are swapped, because these are fed BGR and dvo RGB. TartanVO's names, shapes and outputs are tested against the
    published code; its checkpoint itself has not been tried.

    Args:
        file: the checkpoint, ``dpvo.pth``, ``droid.pth`` or ``tartanvo_1914.pkl``.
        out: the safetensors file to write.

    Raises:
        DvoError: no such file, not such a checkpoint, or one that holds more than tensors.
    """
    file, remedy = Path(file), "give an unmodified checkpoint of DPVO, DROID-SLAM or TartanVO"
    state = load_pickle(file, remedy)
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    if not isinstance(state, dict) or not state:
        raise DvoError("holds no state dict", file=file, remedy=remedy)
    check_plain(state, file, remedy)
    found = read_published(state)
    model = build_network(found.architecture, network_class(found.architecture).presets["full"])
    _compare(model, found.tensors, file)
    tensors = found.tensors | {name: found.tensors[name].flip(1) for name in found.bgr}
    _fill(model, tensors, file)
    save_weights(out, model, {"origin": found.origin, "file": file.name}, half=False)
    return weights_info(out)
