"""Beginning, length and folder of a run: what it starts from, how many steps it takes, where its files go."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.models.weights import LoadedWeights, load_weights
from train.engine.checkpoint import SUFFIXES, State, network_of, read_state
from train.engine.program import TrainingProgram, check_tensors
from train.engine.provenance import Provenance
from train.tasks.registry import DEFAULT_TASK, task_class

ROOT = "runs/train"
"""Folder of the runs."""
LAST = "last.ckpt"
"""Newest training state in the folder of a run."""
OUTPUTS = ("dirpath", "save_dir")
"""Arguments by which callbacks and loggers of Lightning are told where to write."""


@dataclass(frozen=True)
class Start:
    """Beginning of a run.

    Attributes:
        file: a training state, or weights by name or file; None: random weights.
        state: the training state, if it is one.
        weights: the weights, if it is them.
        resumed: the state is that of this run, which goes on.
        record: what the weights have been trained on, where their training state said it.
    """

    file: str | Path | None = None
    state: State | None = None
    weights: LoadedWeights | None = None
    resumed: bool = False
    record: Provenance | None = None

    @property
    def step(self) -> int:
        """Steps that the state has behind it."""
        return 0 if self.state is None else int(self.state["global_step"])

    @property
    def checkpoint(self) -> Path | None:
        """The training state, for Lightning."""
        return None if self.state is None or self.file is None else Path(self.file)


def run_folder(name: str | None, root: str | Path | None, task: str) -> Path:
    """Folder of a run, below which everything lies that it writes.

    Args:
        name: of the run; None: that of the task, or the root itself if there is one.
        root: folder of the runs; None: :data:`ROOT`.
        task: name of the task.

    Raises:
        DvoError: a name that is no name of a folder.
    """
    if name is None:
        return Path(root) if root is not None else Path(ROOT) / task.replace(":", ".")
    if name in ("", ".", "..") or Path(name).name != name or "\\" in name:
        raise DvoError(
            f"'{name}' is no name of a folder",
            field="--name",
            remedy=f"give a single name; --trainer.default_root_dir names the folder of the runs ({ROOT})",
        )
    return Path(root or ROOT) / name


def find_start(folder: Path, source: str | None, resume: bool) -> Start:
    """Beginning of a run.

    Args:
        folder: of the run.
        source: training state or weights of a new run; None: random weights.
        resume: go on with the run in the folder.

    Raises:
        DvoError: a folder that holds a run although nobody asked to go on with it, or none although somebody did; a
            file that cannot be read.
    """
    last = folder / LAST
    if resume and source is not None:
        raise DvoError(
            f"--resume goes on from {last}, --from begins a new run", field="--from", remedy="give one of the two"
        )
    if resume:
        if not last.is_file():
            raise DvoError(
                "there is no run to go on with", file=last, field="--resume", remedy="leave it out, or give --name"
            )
        return Start(last, state=read_state(last), resumed=True)
    if last.is_file():
        raise DvoError(
            f"a run is there already, at step {read_state(last)['global_step']:,}",
            file=last,
            remedy="give --resume to go on with it, or --name RUN for a new one",
        )
    if source is None:
        return Start()
    if Path(source).suffix in SUFFIXES:
        return Start(source, state=read_state(source))
    return Start(source, weights=load_weights(source))


def start_of_task(start: Start, task: str) -> Start:
    """Beginning of a run of a task, which may start from the state of another one.

    Args:
        start: from :func:`find_start`.
        task: name of the task.

    Returns:
        The averaged weights, if the run is new and the start is the state of a task in
        :attr:`train.tasks.task.Task.starts_from`; else the start itself.

    Raises:
        DvoError: no such task, or tensors that are not those of the network.
    """
    state = start.state
    if state is None or start.resumed or start.file is None:
        return start
    theirs = state.get("task", DEFAULT_TASK)
    if theirs == task or theirs not in task_class(task).starts_from:
        return start
    weights = LoadedWeights.of(network_of(state, file=start.file), Path(start.file).stem)
    return Start(start.file, weights=weights, record=Provenance.of_state(state))


def stop_step(start: Start, steps: int | None, max_steps: int) -> int:
    """Step of the state at which a run ends; -1 for none.

    Args:
        start: beginning of the run.
        steps: number of steps to take; None: up to ``max_steps``.
        max_steps: step at which training ends, counted from random weights; -1: never.

    Raises:
        DvoError: no step would be taken.
    """
    if steps is not None:
        if steps < 1:
            raise DvoError(f"{steps} steps would train nothing", field="--steps", remedy="give 1 or more")
        return start.step + steps
    if 0 <= max_steps <= start.step:
        raise DvoError(
            f"{max_steps:,} is not beyond step {start.step:,}, where the run starts, so nothing would be trained",
            file=start.file,
            field="trainer.max_steps",
            remedy="give --steps N for N more steps, or a larger trainer.max_steps",
        )
    return max_steps


def prepare(program: TrainingProgram, start: Start, stop: int) -> None:
    """Check that a program can start there and learns, and give it the weights if the start is not a state.

    A run that goes on keeps the rates of its state; a new one has those of its settings.

    Raises:
        DvoError: weights of another network, or a learning rate of zero at every step.
    """
    if start.weights is not None:
        program.start_from(start.weights)
        if start.record is not None:
            program.provenance = start.record
    if start.state is not None:
        tensors = {name[4:]: value for name, value in start.state["state_dict"].items() if name.startswith("net.")}
        program.check_task(start.state, start.file)
        check_tensors(program.net, tensors, start.file)
    program.new_run = not start.resumed
    program.from_trained = program.new_run and (start.state is not None or start.weights is not None)
    rate, schedule = learning_rate(program, start), program.settings.schedule()
    steps = range(start.step, stop if stop >= 0 else start.step + 1_000_000)
    if not any(rate * schedule(step) > 0 for step in steps):
        raise DvoError(
            f"zero at every step from {start.step:,} on, so nothing would be trained",
            field="model.learning_rate",
            remedy="raise it, or move model.decay_from and model.decay_steps, which count from step 0 of the state",
        )


def learning_rate(program: TrainingProgram, start: Start) -> float:
    """Learning rate at its highest: of the state in a run that goes on, else of the settings."""
    if start.resumed and start.state is not None and start.state.get("lr_schedulers"):
        return float(start.state["lr_schedulers"][0]["base_lrs"][0])
    return program.settings.learning_rate


def describe(program: TrainingProgram, start: Start, stop: int, folder: Path) -> list[str]:
    """Lines that say what a run does, before its first step."""
    length = f" + {stop - start.step:,}" if stop >= 0 else ", without end"
    if start.resumed:
        source = "goes on"
    elif start.state is not None:
        source = f"new run from {start.file} (weights, optimiser, position in the clips)"
    elif start.weights is not None:
        source = f"new run from the weights {start.file}"
    else:
        source = "new run from random weights"
    lines = [f"{folder}: step {start.step:,}{length}; {source}"]
    kept, asked = learning_rate(program, start), program.settings.learning_rate
    if kept != asked:
        lines.append(
            f"note: the learning rate stays {kept:g}, as in the state; model.learning_rate {asked:g} is for new runs"
        )
    before = start.state.get("hyper_parameters", {}) if start.resumed and start.state is not None else {}
    now = program.hparams
    changed = [
        f"model.{name} from {before[name]} to {now[name]}" for name in now if before.get(name, now[name]) != now[name]
    ]
    if changed:
        lines.append(f"note: changed since the last step: {', '.join(changed)}")
    return lines


def place_outputs(parts: Iterable[Mapping[str, Any]], folder: Path) -> None:
    """Let callbacks and loggers write to the folder of the run.

    Args:
        parts: settings of callbacks and loggers (``class_path``, ``init_args``); changed in place.
        folder: of the run.

    Raises:
        DvoError: one that is told to write elsewhere.
    """
    for part in parts:
        arguments = part.get("init_args") or {}
        for name in OUTPUTS:
            if name not in arguments:
                continue
            told = arguments[name]
            if told is None:
                arguments[name] = str(folder)
            elif not Path(told).resolve().is_relative_to(folder.resolve()):
                raise DvoError(
                    f"{told} is outside of the folder of the run, {folder}",
                    field=f"{part.get('class_path')}: {name}",
                    remedy="leave it out; --name and --trainer.default_root_dir move everything that a run writes",
                )
