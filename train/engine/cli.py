"""``python -m train fit``: LightningCLI for the task that a configuration names."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from train.engine.build import program_factory
from train.engine.config_files import check_files
from train.tasks.registry import DEFAULT_TASK, task_class


class TaskCLI(LightningCLI):
    """LightningCLI with the key ``task`` at the top of a configuration."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the key, so that it is accepted, checked and written to the run's ``config.yaml``."""
        help_text = "registered name of the task, or module:Class (default: %(default)s)"
        parser.add_argument("--task", type=str, default=DEFAULT_TASK, help=help_text)


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
    TaskCLI(
        program_factory(task),
        task_class(task).data_type,
        seed_everything_default=0,
        save_config_kwargs={"overwrite": True},
    )
