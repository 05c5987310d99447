"""Maintenance of a map while tracking goes on: one worker, one job at a time, applied at a stated frame.

A job (search for a loop, correction by a pose graph, global adjustment) reads a snapshot, or takes a step with each
frame, which the thread has taken before if it has a core. Its result is applied between two frames: at a frame that is
fixed when the job begins, so that the same frames give the same bytes, or in real time as soon as it is there. What has
moved is told as one message, which everything follows that must.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, Literal, Protocol, TypeVar

from dvo.core.context import core_free
from dvo.map.correction import Moved
from dvo.odometry.maintenance.background import Background, Steps, StepsAhead, Task, all_steps

T = TypeVar("T")
Kind = Literal["search", "correction", "adjustment"]


@dataclass
class Job(Generic[T]):
    """Work on a map.

    Attributes:
        kind: of the work.
        task: gives its result: beside tracking, or in steps, some of which each frame takes.
        apply: called once with the result, between two frames.
        left: calls of :meth:`MapMaintenance.advance` until the result is taken: frames that the network measures, and
            every few that are aligned; a job in steps ends with the last of them.
    """

    kind: Kind
    task: Task[T] | Steps[T] | StepsAhead[T]
    apply: Callable[[T], Moved]
    left: int = 0


class Owner(Protocol):
    """What a map maintenance reports to."""

    def moved(self, moved: Moved) -> None:
        """Follow what has moved.

        Args:
            moved: by the job that has just been applied.
        """
        ...

    def next_job(self, ended: Job[Any], at_once: bool) -> Job[Any] | None:
        """Choose the next job.

        Args:
            ended: that has just been applied.
            at_once: jobs are waited for; those that take their time with the frames are not begun.
        """
        ...


@dataclass
class MapMaintenance:
    """Jobs of a map, one after the other.

    Attributes:
        real_time: take results as soon as they are there, instead of waiting for them at a fixed frame.
        steps: that a frame takes of a job in steps.
        job: in progress; None for none.
        awaited: other work waits for the end of the job: no search begins.
    """

    real_time: bool = False
    steps: int = 1
    job: Job[Any] | None = None
    awaited: bool = False
    _background: Background = field(default_factory=Background)

    @property
    def occupies_core(self) -> bool:
        """A thread computes for long beside tracking; the same frames find the same, but in real time."""
        return self.job is not None and (self.real_time or self.job.kind == "adjustment")

    @property
    def waits(self) -> bool:
        """In real time: a job is in progress whose result is not there."""
        return self.real_time and self.job is not None and not self.job.task.done

    def beside(self, kind: Kind, work: Callable[[], T], apply: Callable[[T], Moved], left: int) -> Job[T]:
        """Job in the thread, which begins at once.

        Args:
            kind: of the work.
            work: called in the thread; what it reads must not change meanwhile.
            apply, left: see :class:`Job`.
        """
        return Job(kind, self._background.start(work), apply, left)

    def in_steps(
        self, kind: Kind, steps: Generator[None, None, T], apply: Callable[[T], Moved], ahead: bool = False
    ) -> Job[T]:
        """Job in steps, some with each frame; in real time in the thread.

        Args:
            kind: of the work.
            steps: see :class:`dvo.odometry.maintenance.background.Steps`.
            apply: see :class:`Job`.
            ahead: what the steps read does not change meanwhile. If a core is free, the thread takes them ahead of the
                frames; the result is taken at the same frame.
        """
        if self.real_time:
            return Job(kind, self._background.start(partial(all_steps, steps)), apply)
        return Job(kind, StepsAhead(steps, self._background) if ahead and core_free() else Steps(steps), apply)

    @property
    def helper(self) -> Callable[[Callable[[], T]], Task[T]] | None:
        """Function that gives work to the thread; None if that has a job, or no core of its own."""
        return self._background.start if self.job is None and core_free() else None

    def advance(self, owner: Owner, at_once: bool = False) -> bool:
        """Take the result of the job in progress if its time has come, and begin the next one; once a frame at most.

        Args:
            owner: of the map.
            at_once: wait for the result.

        Returns:
            True if keyframes have moved.
        """
        job = self.job
        if job is None:
            return False
        try:
            if not (at_once or self._is_due(job)):
                return False
            result = job.task.result()
        except Exception:  # but an interruption of the wait (KeyboardInterrupt) leaves the work to the next call
            self.job = None
            raise
        self.job = None
        moved = job.apply(result)
        if moved:
            owner.moved(moved)
        if self.job is None:
            self.job = owner.next_job(job, at_once)
        return bool(moved)

    def drain(self, owner: Owner) -> bool:
        """Wait for the job in progress, and what follows from it.

        Args:
            owner: of the map.

        Returns:
            True if keyframes have moved.
        """
        moved = False
        while self.job is not None:
            moved |= self.advance(owner, at_once=True)
        return moved

    def _is_due(self, job: Job[Any]) -> bool:
        """Find out if the result of a job is taken with this frame; one in steps takes its next ones."""
        if isinstance(job.task, (Steps, StepsAhead)):
            task = job.task
            return any(task.step() for _ in range(self.steps))
        if job.kind == "search":
            return job.task.done
        job.left -= 1
        return job.task.done if self.real_time else job.left <= 0
