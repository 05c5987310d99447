"""Training tasks by name."""

from __future__ import annotations

from typing import cast

from dvo.core.registry import Registry, is_target, resolve_target
from train.tasks.task import Task

DEFAULT_TASK = "patch_vo"
"""Task of configurations and training states that name none."""

TASKS = Registry(
    "task",
    "dvo.tasks",
    {
        "patch_vo": "train.tasks.patch_vo.task:PatchVOTask",
        "deepvo": "train.tasks.deepvo.task:DeepVOTask",
        "tartanvo": "train.tasks.tartanvo.task:TartanVOTask",
        "droid": "train.tasks.droid.task:DroidTask",
        "selfsup": "train.tasks.selfsup.task:SelfSupervisedTask",
        "distil": "train.tasks.distil.task:DistilTask",
    },
)
"""Task name to ``"module:Class"`` of a :class:`train.tasks.task.Task`."""


def task_class(name: str) -> type[Task]:
    """Class of a task.

    Args:
        name: a registered name, or ``"module:Class"``.

    Raises:
        DvoError: no such name, or its module or class cannot be imported.
    """
    return cast(type[Task], resolve_target(name, "task") if is_target(name) else TASKS.resolve(name))
