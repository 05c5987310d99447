"""Measurements of a window at a moment, for what is computed from them later, and only if somebody asks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar
from weakref import ref

from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem
from dvo.graph.window import Window
from dvo.odometry.window_step import WindowStep

T = TypeVar("T")

MOST_WAITING = 16
"""Values that may wait to be computed; each holds the measurements of a window, some 100 kB."""


@dataclass(frozen=True)
class WindowMeasurements:
    """Poses, depths and measurements of a window. It shares tensors with the window, which replaces its own.

    Attributes:
        per_frame, poses_cw, targets, confidence, jj, kk: as in :class:`dvo.graph.window.Window`.
        centres: ``(n * M, 3)`` x, y and inverse depth of the patch centres.
        camera: ``(4,)`` fx fy cx cy of each frame.
        depths: ``(M, 2)`` measured inverse depths and weights of each frame, None without any.
        timestamps: of the frames, seconds.
        bounds, kernel: of bundle adjustment.
    """

    per_frame: int
    poses_cw: Tensor
    centres: Tensor
    targets: Tensor
    confidence: Tensor
    jj: Tensor
    kk: Tensor
    camera: tuple[Tensor, ...]
    depths: tuple[Tensor | None, ...]
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
        w: Window = step.window
        middle = w.patches.shape[-1] // 2
        return cls(
            w.per_frame, w.poses_cw, w.patches[:, :, middle, middle].clone(), w.targets, w.confidence, w.jj, w.kk,
            tuple(frame.intrinsics for frame in w.frames), tuple(frame.measured for frame in w.frames),
            tuple(frame.timestamp for frame in w.frames), step.bounds, step.kernel,
        )  # fmt: skip

    def at(self, problem: PatchProblem) -> WindowMeasurements:
        """Same measurements at another solution.

        Args:
            problem: of the patch centres, at the solution.

        Returns:
            The measurements with these poses and centres.
        """
        return replace(
            self, poses_cw=problem.poses_cw.to(self.poses_cw), centres=problem.patches[..., 0, 0].to(self.centres)
        )


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
