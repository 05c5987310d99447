"""Work in processes that are replaced now and then, as what they have loaded or rendered stays in their memory."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from dvo.core.processes import die_with_parent
from dvo.core.threads import settle_threads

Task = TypeVar("Task")
Done = TypeVar("Done")


def in_fresh_processes(
    work: Callable[[Task], Done], tasks: Sequence[Task], *, jobs: int = 1, each: int = 1
) -> Iterator[Done]:
    """Results of a function on tasks, in their order, from processes that end after some tasks, or with this one.

    ``max_tasks_per_child`` of the pool is not used: Python 3.11 stops for ever where a process has had its share.

    Args:
        work: function at the top level of a module.
        tasks: its arguments.
        jobs: processes at the same time.
        each: tasks of a process.

    Yields:
        What ``work`` returns.

    Raises:
        concurrent.futures.process.BrokenProcessPool: a process was killed.
    """
    share = jobs * each
    for begin in range(0, len(tasks), share):
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _begin) as pool:
            yield from pool.map(work, tasks[begin : begin + share])


def _begin() -> None:
    die_with_parent()
    settle_threads()
