"""``python -m train fit``: LightningCLI for the task that a configuration names."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import lightning as L
import yaml
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from dvo.core.errors import DvoError
from dvo.core.settings import shown
from train.engine.baseline import LossBeforeTraining
from train.engine.build import program_factory
from train.engine.callbacks import RefuseStandstill, StopGently
from train.engine.config_files import check_files
from train.engine.parser import OneLineParser, in_one_line
from train.engine.progress import StepBar
from train.engine.run import ROOT, describe, find_start, place_outputs, prepare, run_folder, start_of_task, stop_step
from train.tasks.registry import DEFAULT_TASK, task_class

LARGEST_SEED = 2**32 - 1  # of numpy


class TaskCLI(LightningCLI):
    """LightningCLI with keys for the task and for the run at the top of a configuration.

    One folder holds everything that a run writes. A new run starts from random weights or ``from`` a file; only
    ``resume`` goes on with the run in the folder.
    """

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Training only; ``python -m train`` has programs of its own for the rest."""
        return {"fit": LightningCLI.subcommands()["fit"] | {"weights_only"}}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the keys, so that they are accepted, checked and written to the run's ``config.yaml``."""
        parser.add_argument(
            "--task", type=str, default=DEFAULT_TASK,
            help="registered name of the task, or module:Class (default: %(default)s)",
        )  # fmt: skip
        parser.add_argument(
            "--name", type=str | None, default=None,
            help=f"name of the run; everything that it writes goes to {ROOT}/NAME, or to NAME in "
            "trainer.default_root_dir (default: the name of the task)",
        )  # fmt: skip
        parser.add_argument(
            "--from", type=str | None, default=None,
            help="start a new run from a training state (weights, optimiser, position in the clips), or from weights "
            "by name or file",
        )  # fmt: skip
        parser.add_argument("--resume", action="store_true", help="go on with the run of that name, from its last.ckpt")
        parser.add_argument(
            "--steps", type=int | None, default=None,
            help="steps to take from there on; without it, training ends at step trainer.max_steps of the state",
        )  # fmt: skip

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse the command line, and find folder, start and end of the run.

        Raises:
            DvoError: see :mod:`train.engine.run`.
        """
        super().parse_arguments(parser, args)
        settings = self.config["fit"]
        if settings.get("ckpt_path") is not None:
            raise DvoError(
                "says neither whether a run is new nor whether it goes on",
                field="ckpt_path",
                remedy="give --from FILE for a new run that starts there, or --resume",
            )
        trainer = settings["trainer"]
        defaults = self._subcommand_parsers["fit"].get_defaults()
        for name, value in settings.items():
            if value is None and defaults.get(name) is not None:  # a file may leave out any value, for the parser
                raise DvoError("has no value", field=name, remedy=f"give one, or leave {name} out")
        seed = settings["seed_everything"]
        if not isinstance(seed, bool) and not 0 <= seed <= LARGEST_SEED:
            remedy = f"give a whole number from 0 to {LARGEST_SEED}"
            raise DvoError(f"out of range: {shown(seed)}", field="seed_everything", remedy=remedy)
        self.folder = run_folder(settings["name"], trainer["default_root_dir"], settings["task"])
        parts = [*_as_list(trainer["logger"]), *_as_list(trainer["callbacks"])]
        place_outputs([part for part in parts if not isinstance(part, bool)], self.folder)
        start = find_start(self.folder, settings["from"], settings["resume"])
        self.start = start_of_task(start, settings["task"])
        self.stop = stop_step(self.start, settings["steps"], trainer["max_steps"])

    def instantiate_classes(self) -> None:
        """Build trainer, program and data.

        Raises:
            DvoError: also for a value that a settings dataclass refuses, which jsonargparse reports as a ValueError.
        """
        try:
            super().instantiate_classes()
        except ValueError as error:
            if "Does not validate against any" not in str(error):
                raise
            reason = in_one_line(str(error)).split(" Given value: ")[0]
            raise DvoError(reason, field="settings", remedy="see python -m train fit --help") from error

    def instantiate_trainer(self, **changes: Any) -> L.Trainer:
        """Trainer whose files lie in the folder of the run.

        Raises:
            DvoError: the start does not fit the program, nothing would be learnt, or settings that Lightning refuses.
        """
        prepare(self.model, self.start, self.stop)
        given = self._get(self.config_init, "trainer")
        theirs = _as_list(given["callbacks"])
        own: list[L.Callback] = [RefuseStandstill(), LossBeforeTraining()]
        if given["enable_progress_bar"] is not False and not given["barebones"]:
            own.append(StepBar())
        if given["enable_checkpointing"] is not False and not any(isinstance(c, StopGently) for c in theirs):
            own.append(StopGently())  # every run leaves a state
        changes |= {"callbacks": [*theirs, *own]}
        changes |= {"default_root_dir": self.folder, "max_steps": self.stop}
        if given["logger"] in (None, True) and not given["barebones"]:
            changes["logger"] = default_loggers(self.folder)
        try:
            return super().instantiate_trainer(**changes)
        except (MisconfigurationException, TypeError, ValueError, MemoryError) as error:  # of 10^15 devices
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DvoError(reason, field="trainer", remedy="see the arguments of lightning.pytorch.Trainer") from error

    def fit(self, **arguments: Any) -> None:
        """Train.

        Raises:
            DvoError: the run ended without a step.
        """
        lines = describe(self.model, self.start, self.stop, self.folder)
        if hasattr(self.datamodule, "summary"):
            lines.insert(1, f"clips: {self.datamodule.summary()}")
        rank_zero_only(print)("\n".join(lines), flush=True)
        self.trainer.fit(**(arguments | {"ckpt_path": self.start.checkpoint, "weights_only": False}))
        if self.trainer.global_step <= self.start.step and not self.trainer.interrupted:
            raise DvoError(
                "the run ended without a step, so nothing was trained",
                file=self.folder,
                remedy="look at trainer.max_epochs, trainer.max_time, trainer.limit_train_batches and for empty data",
            )


def _as_list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list) else [] if value is None else [value]


def default_loggers(folder: Path) -> list[Logger]:
    """CSV and TensorBoard in the folder of a run."""
    return [CSVLogger(folder, name="csv"), TensorBoardLogger(folder, name="tensorboard", version="")]


def named_task(arguments: list[str]) -> str:
    """Task named by ``--task``, else by the key ``task`` of the last configuration that has it, else the default.

    The settings that a command line may hold depend on the task, so it is looked up before anything is parsed.

    Args:
        arguments: of the command line, without the name of the program.
    """
    given = _values(arguments, "--task")
    if given:
        return given[-1]
    for name in reversed(_values(arguments, "--config", "-c")):
        settings: Any = None
        if Path(name).is_file():
            try:
                settings = yaml.safe_load(Path(name).read_text(encoding="utf-8"))
            except yaml.YAMLError:
                continue  # LightningCLI reports it
        if isinstance(settings, dict) and "task" in settings:
            return str(settings["task"])
    return DEFAULT_TASK


def _values(arguments: list[str], *names: str) -> list[str]:
    found = []
    for position, argument in enumerate(arguments):
        name, separator, value = argument.partition("=")
        if name in names:
            if not separator:
                value = arguments[position + 1] if position + 1 < len(arguments) else ""
            found.append(value)
    return found


def train() -> None:
    """Run LightningCLI on the command line of this process.

    Raises:
        DvoError: no such task, or a configuration that is not valid YAML.
    """
    check_files(sys.argv[1:])
    task = named_task(sys.argv[1:])
    # The seed is in config.yaml; devices that are not there, and tips, are no news.
    for name in ("fabric.utilities.seed", "pytorch.utilities.rank_zero", "pytorch.accelerators.cuda"):
        logging.getLogger(f"lightning.{name}").setLevel(logging.WARNING)
    TaskCLI(
        program_factory(task),
        task_class(task).data_type,
        seed_everything_default=0,
        save_config_kwargs={"overwrite": True},
        parser_class=OneLineParser,
    )
