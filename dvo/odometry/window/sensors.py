"""Other sensors whose measurements take part in the steps of a window, such as an inertial unit, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from dvo.ba.blocks import StateBlock
from dvo.ba.problem import Factor
from dvo.core.registry import Registry
from dvo.data.frame import Frame
from dvo.map.window import Window

WINDOW_SENSORS = Registry("window sensor", "dvo.window_sensors")
"""Names to ``"module:builder"``. A builder takes the network and the device of its computation, and gives a
:class:`WindowSensor`; the setting ``sensors`` of the tracker names those that take part."""


class WindowSensor(Protocol):
    """Measurements of a sensor as factors of the bundle adjustment of a window.

    An object serves one sequence. It keeps what it has seen; what it solves for belongs to the keyframes
    (:attr:`dvo.map.window.Keyframe.states`), and comes and goes with them.
    """

    def observe(self, frame: Frame) -> None:
        """Take what a frame carries.

        Args:
            frame: each one, in order of time: also one that repeats an image or shows nothing.
        """
        ...

    def blocks(self, window: Window) -> Mapping[str, StateBlock]:
        """Unknowns beside poses and depths.

        Args:
            window: before a step; ``states`` of its keyframes has the values of the last one.

        Returns:
            Blocks ``(1, n, D)`` by name, one element for each keyframe; none for a sensor without unknowns.
        """
        ...

    def factors(self, window: Window) -> tuple[Factor, ...]:
        """Measurements.

        Args:
            window: before a step; a factor concerns poses by the positions of keyframes, and has a batch of 1.

        Returns:
            Factors for :class:`dvo.ba.patch_problem.PatchProblem`.
        """
        ...
