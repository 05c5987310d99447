"""Measurements of a window at a moment, for what is computed from them later, and only if somebody asks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar
from weakref import ref

from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem
from dvo.graph.measured_depths import depth_factors
from dvo.graph.window import Window
from dvo.odometry.window_step import WindowStep

T = TypeVar("T")

MOST_WAITING = 16
"""Values that may wait to be computed; each holds the measurements of a window, some 100 kB."""


@dataclass(frozen=True)
class WindowMeasurements:
    """Measurements of a window at a moment.

    Attributes:
        problem: of the patch centres, weighted by the confidence of the network, with measured depths as factors. It
            shares tensors with the window, which replaces its own.
        timestamps: of the frames, seconds.
        bounds, kernel: of bundle adjustment.
    """

    problem: PatchProblem
    timestamps: tuple[float, ...]
    bounds: tuple[int, int]
    kernel: Kernel

    @classmethod
    def of(cls, step: WindowStep) -> WindowMeasurements:
        """Measurements of the window of a step.

        Args:
            step: of the model, after a step.

        Returns:
            What no later step changes.
        """
        window: Window = step.window
        middle = window.patches.shape[-1] // 2
        centres = window.patches[:, :, middle : middle + 1, middle : middle + 1].clone()
        depths = depth_factors(window.measured)
        problem = window.problem().with_values(patches=centres, weights=window.confidence, factors=depths)
        return cls(problem, tuple(frame.timestamp for frame in window.frames), step.bounds, step.kernel)

    def at(self, problem: PatchProblem) -> WindowMeasurements:
        """Same measurements at another solution.

        Args:
            problem: at the solution.

        Returns:
            The measurements with its poses and patches.
        """
        own = self.problem
        now = own.with_values(poses_cw=problem.poses_cw.to(own.poses_cw), patches=problem.patches.to(own.patches))
        return replace(self, problem=now)


class Later(Generic[T]):
    """Value that is computed when it is first asked for.

    Args:
        compute: function of the value, called once at most and then released with all that it holds.
    """

    def __init__(self, compute: Callable[[], T]) -> None:
        self._compute: Callable[[], T] | None = compute
        self._value: T | None = None

    @property
    def waits(self) -> bool:
        """True until it is computed."""
        return self._compute is not None

    def __call__(self) -> T:
        compute = self._compute  # of two threads that ask at once, both compute the same
        if compute is not None:
            self._value = compute()
            self._compute = None
        return self._value  # type: ignore[return-value]


class Waiting(Generic[T]):
    """Values that nobody has asked for yet: of more than :data:`MOST_WAITING`, the oldest that is held is computed.

    Without this a list of all estimates of a long sequence would hold all of its measurements.
    """

    def __init__(self) -> None:
        self._values: deque[ref[Later[T]]] = deque()

    def add(self, value: Later[T]) -> None:
        """Add a value.

        Args:
            value: held by its user alone.
        """
        self._values.append(ref(value))
        if len(self._values) > MOST_WAITING:
            oldest = self._values.popleft()()
            if oldest is not None:
                oldest()
