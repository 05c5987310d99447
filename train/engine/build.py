"""Training programs from flat settings: those of the task and those of the engine under one heading."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_type_hints

from dvo.core.errors import DvoError
from train.engine.program import EngineSettings, TrainingProgram
from train.tasks.registry import DEFAULT_TASK, task_class
from train.tasks.task import Task


def task_settings(task: str) -> dict[str, inspect.Parameter]:
    """Settings of a task: the arguments of its constructor, with resolved annotations.

    Raises:
        DvoError: no such task.
    """
    return _parameters(task_class(task))


def make_task(task: str = DEFAULT_TASK, **settings: Any) -> Task:
    """Build a task.

    Args:
        task: registered name, or ``"module:Class"``.
        settings: arguments of its constructor. A dict is accepted where a dataclass is expected.

    Raises:
        DvoError: no such task, or a setting that it does not have.
    """
    known = task_settings(task)
    _check(settings, known, task)
    return task_class(task)(**{name: _as_dataclass(value, known[name]) for name, value in settings.items()})


def make_program(task: str = DEFAULT_TASK, **settings: Any) -> TrainingProgram:
    """Build a training program.

    Args:
        task: registered name, or ``"module:Class"``.
        settings: arguments of the task's constructor and attributes of
            :class:`train.engine.program.EngineSettings`, as under ``model:`` in a configuration.

    Raises:
        DvoError: no such task, or a setting that neither has.

    Example:
        >>> program = make_program("patch_vo", model="tiny", learning_rate=1e-3, loss={"weighted": True})
    """
    known = _merged(task)
    _check(settings, known, task)
    values = {name: parameter.default for name, parameter in known.items()} | settings
    missing = [name for name, value in values.items() if value is inspect.Parameter.empty]
    if missing:
        raise DvoError("setting is missing", field=", ".join(missing), remedy=f"give it to the task '{task}'")
    own = {f.name for f in fields(EngineSettings)}
    built = make_task(task, **{name: value for name, value in values.items() if name not in own})
    plain = {name: value for name, value in values.items() if not _of_dataclass(known[name])}
    return TrainingProgram(built, EngineSettings(**{name: values[name] for name in own}), task, plain)


def program_factory(task: str) -> Callable[..., TrainingProgram]:
    """:func:`make_program` for one task, with a signature that lists every setting, for LightningCLI.

    Raises:
        DvoError: no such task, or one that has a setting by the name of one of the engine's.
    """
    return _factory(task, task_class(task))


@functools.cache  # jsonargparse gives every function a class of that name, once
def _factory(task: str, of: type[Task]) -> Callable[..., TrainingProgram]:
    merged = _merged(task)

    def build(**settings: Any) -> TrainingProgram:
        return make_program(task, **settings)

    signature = inspect.Signature(list(merged.values()), return_annotation=TrainingProgram)
    build.__signature__ = signature  # type: ignore[attr-defined]
    build.__annotations__ = {name: p.annotation for name, p in merged.items()} | {"return": TrainingProgram}
    build.__name__ = build.__qualname__ = f"{of.__module__}.{of.__qualname__}.{task}".replace(":", ".")
    build.__doc__ = "\n".join(["Train a network.", "", "Args:", *_documented(of, EngineSettings)])
    return build


def _merged(task: str) -> dict[str, inspect.Parameter]:
    mine, engine = task_settings(task), _parameters(EngineSettings)
    both = sorted(set(mine) & set(engine))
    if both:
        raise DvoError(
            f"the task '{task}' and the engine have settings of the same name",
            field=", ".join(both),
            remedy="rename that of the task",
        )
    return mine | engine


def _parameters(of: type) -> dict[str, inspect.Parameter]:
    """Arguments of a constructor, keyword only, with their types instead of the text of their annotations."""
    hints = get_type_hints(of.__init__)  # type: ignore[misc]
    found = {}
    for name, parameter in inspect.signature(of).parameters.items():
        if parameter.kind not in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD):
            kind, annotation = inspect.Parameter.KEYWORD_ONLY, hints.get(name, Any)
            found[name] = parameter.replace(kind=kind, annotation=annotation)
    return found


def _check(settings: dict[str, Any], known: dict[str, inspect.Parameter], task: str) -> None:
    unknown = sorted(set(settings) - set(known))
    if unknown:
        remedy = f"the settings of the task '{task}' are {', '.join(known)}"
        raise DvoError("unknown setting", field=", ".join(unknown), remedy=remedy)


def _of_dataclass(parameter: inspect.Parameter) -> type | None:
    choices = (parameter.annotation, *get_args(parameter.annotation))
    return next((choice for choice in choices if isinstance(choice, type) and is_dataclass(choice)), None)


def _as_dataclass(value: Any, parameter: inspect.Parameter) -> Any:
    expected = _of_dataclass(parameter)
    if expected is None or not isinstance(value, dict):
        return value
    _check(value, _parameters(expected), f"{parameter.name} of {expected.__name__}")
    return expected(**value)


def _documented(*classes: type) -> list[str]:
    """Lines of the sections Args or Attributes of some docstrings, for the help of the command line."""
    lines: list[str] = []
    for one in classes:
        inside = False
        for line in inspect.cleandoc(one.__doc__ or "").splitlines():
            if line and not line.startswith(" "):
                inside = line in ("Args:", "Attributes:")
            elif inside and line:
                lines.append(line)
    return lines
