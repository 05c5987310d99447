"""Training states: reading them, and the network, the task and the facts in them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Literal

from torch import nn

from dvo.core.errors import DvoError
from dvo.models.pickles import check_plain, load_pickle
from dvo.models.registry import DEFAULT_ARCHITECTURE, build_network, network_class, preset_name
from dvo.models.weights import LoadedWeights, load_weights
from train.engine.build import make_task, task_settings
from train.engine.provenance import Provenance, clips_seen
from train.tasks.registry import DEFAULT_TASK
from train.tasks.task import Task

State = dict[str, Any]
Which = Literal["average", "net"]
SUFFIXES = (".ckpt", ".pt")
KINDS = {
    "state_dict": dict,
    "hyper_parameters": dict,
    "global_step": int,
    "network": dict,
    "callbacks": dict,
    "task": str,
}


def read_state(file: str | Path) -> State:
    """Read a training state.

    The file is a pickle; it is read as plain tensors and containers, so that no code in it runs.

    Args:
        file: as :class:`lightning.pytorch.callbacks.ModelCheckpoint` writes it.

    Raises:
        DvoError: no such file, or one that is no training state.
    """
    path, remedy = Path(file), "give a checkpoint that 'python -m train fit' wrote"
    state = load_pickle(path, remedy)
    if not isinstance(state, dict) or not {"state_dict", "hyper_parameters", "global_step"} <= set(state):
        raise DvoError("is no training state", file=path, remedy=remedy)
    for name, kind in KINDS.items():
        if not isinstance(state.get(name, kind()), kind):
            raise DvoError(
                f"is no training state (a {type(state[name]).__name__})", file=path, field=name, remedy=remedy
            )
    said = state.get("network", {})
    if not isinstance(said.get("architecture", ""), str) or not isinstance(said.get("config", {}), dict):
        raise DvoError("names no network", file=path, field="network", remedy=remedy)
    check_plain(state["state_dict"], path, remedy)
    return state


def network_of(state: State, which: Which = "average", file: object | None = None) -> nn.Module:
    """Network of a training state, in evaluation mode.

    Args:
        state: from :func:`read_state`. One that names no architecture is of ``patch_vo``, with a preset's sizes.
        which: ``average``, the moving average of the weights; or ``net``, the weights in training.
        file: where the state was read, for messages.

    Raises:
        DvoError: an architecture that is not registered, or tensors that are not those of the network.
    """
    said = state.get("network", {})
    architecture = said.get("architecture", DEFAULT_ARCHITECTURE)
    network = network_class(architecture, file)
    if "config" in said:
        config = network.config_type.from_dict(said["config"])
    else:
        preset = state["hyper_parameters"].get("model")
        if not isinstance(preset, str) or preset not in network.presets:
            raise DvoError(f"no preset '{preset}'", file=file, field="model", remedy="give a state of this version")
        config = network.presets[preset]
    model = build_network(architecture, config)
    fill(model, state, which, file)
    return model.eval()


def fill(model: nn.Module, state: State, which: Which = "average", file: object | None = None) -> None:
    """Load the weights of a training state into a network.

    Raises:
        DvoError: tensors that are not those of the network.
    """
    prefix = f"{which}."
    tensors = {k.removeprefix(prefix): v for k, v in state["state_dict"].items() if k.startswith(prefix)}
    try:
        model.load_state_dict(tensors)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise DvoError(f"does not fit the network ({reason})", file=file, remedy="give a state of this task") from error


def task_of(state: State, **changes: Any) -> Task:
    """Task of a training state, with the settings that the state holds (dataclasses, as the loss, are not among them).

    Args:
        state: from :func:`read_state`.
        changes: settings to use instead; those that the task does not have are left out.

    Raises:
        DvoError: the task cannot be imported.
    """
    name = state.get("task", DEFAULT_TASK)
    known = task_settings(name)
    settings = dict(state["hyper_parameters"]) | changes
    return make_task(name, **{key: value for key, value in settings.items() if key in known})


def facts_of(state: State) -> dict[str, Any]:
    """Facts of a training state for the model card: steps, clips, seed, preset, licence, data, starting weights."""
    said = state.get("network", {})
    settings = state["hyper_parameters"]
    preset = settings.get("model")
    if "config" in said:
        network = network_class(said.get("architecture", DEFAULT_ARCHITECTURE))
        preset = preset_name(network, network.config_type.from_dict(said["config"]))
    return {
        "steps": state["global_step"],
        "clips": clips_seen(state),
        "seed": settings.get("seed"),
        "preset": preset,
        **Provenance.of_state(state).facts(),
    }


def load_any(name_or_file: str | Path, which: Which = "average") -> LoadedWeights:
    """Network of a training checkpoint (``.ckpt``, ``.pt``), or of weights by name or file.

    Raises:
        DvoError: see :func:`read_state` and :func:`dvo.models.weights.load_weights`.
    """
    path = Path(name_or_file)
    if path.suffix not in SUFFIXES:
        return load_weights(name_or_file)
    return LoadedWeights.of(network_of(read_state(path), which, path), path.stem)


def portable(state: State) -> State:
    """The state without paths of the machine that it comes from.

    Callbacks whose state holds an absolute path lose that state (it names files that are elsewhere);
    other absolute paths are cut down to their last part. Weights, optimiser and positions are not touched.

    Args:
        state: from :func:`read_state`; it is not changed.
    """
    kept = ("state_dict", "optimizer_states", "lr_schedulers", "loops")
    found = {key: value if key in kept else _without_paths(value) for key, value in state.items()}
    callbacks = state.get("callbacks", {})
    found["callbacks"] = {key: value for key, value in callbacks.items() if not absolute_paths(value)}
    return found


def absolute_paths(value: Any) -> list[str]:
    """Absolute paths, of any operating system, among the texts in nested containers."""
    if isinstance(value, Mapping):
        return [path for pair in value.items() for part in pair for path in absolute_paths(part)]
    if isinstance(value, (list, tuple)):
        return [path for part in value for path in absolute_paths(part)]
    if isinstance(value, (str, Path)) and _is_absolute(str(value)):
        return [str(value)]
    return []


def _is_absolute(text: str) -> bool:
    return PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute()


def _without_paths(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_paths(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_without_paths(part) for part in value)
    if isinstance(value, (str, Path)) and _is_absolute(str(value)):
        return PureWindowsPath(value).name
    return value
