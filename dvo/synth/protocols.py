"""Interfaces between the rooms of the synthesis."""

from __future__ import annotations

from typing import Protocol

import numpy as np

Array = np.ndarray


class Motion(Protocol):
    """Anything with a pose at every time: camera paths and the motion of bodies."""

    def poses_wc(self, times: Array) -> Array:
        """Poses from the moving frame to the world.

        Args:
            times: ``(T,)`` seconds.

        Returns:
            ``(T, 7)`` float64.
        """
        ...
