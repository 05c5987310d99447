"""Processes of the runs of the benchmark of loops: one by itself, or two that take turns."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing.synchronize import Semaphore

from dvo.core.errors import DvoError
from dvo.core.processes import die_with_parent
from eval.benchmarks.loops.runs import Run, Task, Turns, carry_out


def alone(task: Task) -> Run:
    """Carry out a task in a process of its own, so that its memory is its own.

    Args:
        task: to carry out.

    Raises:
        DvoError: the process ended without a result.
    """
    with _process() as pool:
        return _result(pool.submit(carry_out, task), task)


class Alternating:
    """Processes of two runs of a sequence at the same time, which take turns, frame by frame.

    Called with one of the two tasks it carries out both; called with the other one next, it has its run already.
    """

    def __init__(self) -> None:
        self._done: dict[Task, Run] = {}

    def __call__(self, task: Task) -> Run:
        """Carry out a task.

        Args:
            task: to carry out.

        Raises:
            DvoError: a process ended without a result.
        """
        if task not in self._done:
            is_dark = task.mode == "blackout"
            other = replace(task, dark=not task.dark) if is_dark else replace(task, loops=not task.loops)
            turns = [multiprocessing.get_context("spawn").Semaphore(first) for first in (1, 0)]
            with _process(*turns) as one, _process(*reversed(turns)) as two:
                futures = {task: one.submit(_in_turns, task), other: two.submit(_in_turns, other)}
                self._done = {each: _result(future, each) for each, future in futures.items()}
        return self._done.pop(task)


_turns: list[Turns] = []  # of this process


def _process(*turns: Semaphore) -> ProcessPoolExecutor:
    """Process that ends with this one; with the semaphores of two runs that take turns, its own first."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=context, initializer=_begin, initargs=turns)


def _begin(*turns: Semaphore) -> None:
    die_with_parent()
    _turns[:] = [Turns(*turns)] if turns else []


def _in_turns(task: Task) -> Run:
    try:
        return carry_out(task, _turns[0])
    finally:
        _turns[0].give()  # a run that fails does not hold up the other one


def _result(future: Future[Run], task: Task) -> Run:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise DvoError("the run ended without a result", field=task.sequence.name, remedy="see above") from error
