"""A controlled study of losses: arms that differ in their loss, on the same clips.

The study that comes with the project compares DPVO's loss, V2V's weighting, and weighting with balance.
``python -m train study --config configs/train/study.yaml`` trains every arm with every learning rate and seed, and
writes curves of the validation error and a table. For a seed, the clips, the patches drawn and the weights at the start
are the same for all arms: the differences are paired. A run that is done is not run again; one that was interrupted
goes on from its last checkpoint.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.text import print_line
from dvo.data.files.output import replaced, write_text
from train.engine.build import task_settings
from train.engine.checkpoint import network_of, read_state
from train.engine.program import TrainingProgram
from train.studies.clips import DiskClips, StudyClips
from train.studies.config import StudyConfig
from train.studies.report import write_report
from train.studies.training import StepClock, fit, task_program
from train.tasks.task import Task

VALIDATION_SEED = 920_001


def validation_error(task: Task, net: nn.Module, clips: DiskClips) -> dict[str, float]:
    """Measures of a task over held-out clips: means, and medians of those whose name ends with ``_ratio``.

    Args:
        task: measures, see :meth:`train.tasks.task.Task.measure`.
        net: the network.
        clips: held out; the number of a clip is the seed of what the network draws.
    """
    rows: list[dict[str, float]] = []
    for index in range(clips.count):
        batch = {name: value[None] for name, value in clips[index].items()}
        rows.append(task.measure(net, batch, index))
    found = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        found[name] = float(torch.tensor(values).median()) if name.endswith("_ratio") else sum(values) / len(values)
    return found


class Curve(StepClock):
    """Measures the validation error every so many steps, and once before the first; kept with the checkpoint.

    Args:
        clips: held out.
        every: steps between measurements.
        judge: program with the settings of the task that all arms are judged with; its network gets the weights of the
            arm.
    """

    def __init__(self, clips: DiskClips, every: int, judge: TrainingProgram) -> None:
        super().__init__()
        self.clips, self.every, self.judge = clips, every, judge
        self.rows: list[dict[str, float]] = []

    def _measure(self, step: int, program: Any) -> None:
        if not self.rows or self.rows[-1]["step"] < step:
            self.judge.net.load_state_dict(program.net.state_dict())
            found = validation_error(self.judge.task, self.judge.net, self.clips)
            self.rows.append({"step": float(step)} | found)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Measure before the first step."""
        self._measure(trainer.global_step, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Measure if it is time."""
        super().on_train_batch_end(trainer, pl_module)
        if trainer.global_step % self.every == 0:
            self._measure(trainer.global_step, pl_module)

    def state_dict(self) -> dict[str, Any]:
        """Time and measurements so far."""
        return super().state_dict() | {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self.rows = state_dict["rows"]


def _program(config: StudyConfig, seed: int, **settings: Any) -> TrainingProgram:
    common = {"model": config.model, "seed": seed, "updates": config.updates}
    return task_program(config.task, common, **(config.settings | settings))


def _start_of(seed: int, config: StudyConfig, clips: DiskClips) -> dict[str, Tensor]:
    """Weights that all arms of a seed start from."""
    if config.state:
        net = network_of(read_state(config.state), "net", config.state)
        return net.state_dict()
    folder = Path(config.folder) / f"start_seed{seed}"
    done = folder / "done.pt"
    if not done.is_file():
        torch.manual_seed(seed)
        program = _program(config, seed, learning_rate=config.start_rate, cycle=config.start_steps, **config.start)
        if config.start_steps > 0:
            fit(folder, program, StudyClips(clips), config.start_steps, [], 100)
        folder.mkdir(parents=True, exist_ok=True)
        with replaced(done) as part, part.open("wb") as stream:
            torch.save(program.net.state_dict(), stream)
    return torch.load(done, weights_only=True)


def run_arm(arm: str, rate: float, seed: int, config: StudyConfig) -> dict[str, Any]:
    """Train one arm, or read the result of a run that is done.

    Args:
        arm: key of ``config.arms``.
        rate: learning rate.
        seed: of clips, patches and weights.
        config: the study.

    Returns:
        arm, rate, seed, ``curve`` (a row a measurement), ``skipped`` and ``recovered`` steps, ``seconds_a_step``.
    """
    name = f"{arm.replace(' ', '_').replace('+', 'and')}_rate{rate:g}_seed{seed}"
    folder = Path(config.folder) / name
    done = folder / "result.json"
    if done.is_file():
        return json.loads(done.read_text(encoding="utf-8"))
    options, own = config.clip_options, config.arm_clips.get(arm, {})
    clips = DiskClips(Path(config.folder) / "clips", 31 + seed, config.clips, config, options | own)
    held_out = DiskClips(Path(config.folder) / "clips", VALIDATION_SEED, config.validation_clips, config, options)
    start = _start_of(seed, config, clips)
    trained = {"warmup_until": 0.0} if "warmup_until" in task_settings(config.task) else {}
    trained |= config.arm_settings.get(arm, {})
    loss = config.base | config.arms[arm]
    program = _program(config, seed, learning_rate=rate, cycle=config.steps, loss=loss, **trained)
    try:
        program.net.load_state_dict(start)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise DvoError(
            f"does not fit the network of '{arm}' ({reason})", file=config.state or None, field="state",
            remedy=f"give a state of the size '{config.model}', and arms of the same network",
        ) from error  # fmt: skip
    program.average.load_state_dict(start)
    curve = Curve(held_out, config.validate_every, _program(config, seed, loss=loss))
    fit(folder, program, StudyClips(clips), config.steps, [curve], config.validate_every)
    result = {
        "arm": arm, "rate": rate, "seed": seed, "curve": curve.rows, "skipped": int(program.skipped),
        "recovered": program.recovered, "seconds_a_step": curve.train_seconds / max(config.steps, 1),
    }  # fmt: skip
    write_text(done, json.dumps(result, indent=1))
    return result


def main(arguments: list[str]) -> None:
    """``python -m train study --config FILE [--rehearse STEPS] [--seeds ...]``.

    Raises:
        DvoError: no such file, or a setting that does not exist.
    """
    parser = OneLineParser(prog="python -m train study", description=__doc__.split("\n")[0])
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--rehearse", type=int, metavar="STEPS", help="run every arm for so many steps, elsewhere")
    parser.add_argument("--seeds", type=int, nargs="*")
    options = parser.parse_args(arguments)
    config = StudyConfig.read(options.config)
    if options.seeds:
        config = replace(config, seeds=tuple(options.seeds))
    if options.rehearse:
        n = options.rehearse
        config = replace(
            config, folder=f"{config.folder}_rehearsal", out=f"{config.folder}_rehearsal/report", steps=n,
            start_steps=min(n, config.start_steps), validate_every=max(1, n // 3), validation_clips=4,
        )  # fmt: skip
    results = []
    for seed in config.seeds:
        for rate in config.rates:
            for arm in config.arms:
                result = run_arm(arm, rate, seed, config)
                results.append(result)
                last = result["curve"][-1]
                errors = ", ".join(f"{label} {last[name]:.4f}" for name, label in config.measures.items())
                print(f"seed {seed} rate {rate:g} {arm}: {errors}, {result['seconds_a_step']:.2f} s a step", flush=True)
    for file in write_report(results, config, options.config):
        print_line(str(file))
