"""Ways that come back: there and back again, and to an earlier place within a moment of darkness.

Both put the control points of a planned way (:class:`SplinePath`) into another order, so that the camera stays where
the way was found to be free. The shake is a function of time, and differs when a place is passed again.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dvo.synth.motion.motion import SplinePath

INTERVAL = 0.6
"""Largest number of seconds between the control points of a way with a jump: a cubic B-spline needs three intervals
from one way to another, and the rendered suites are dark for two seconds."""


def there_and_back(path: SplinePath, duration: float) -> SplinePath:
    """Way that is gone until half of the duration and then, looking the same way, back to its start.

    Args:
        path: of half the duration or more.
        duration: of the result, seconds.
    """
    half = min(max(2, round(duration / 2 / path.interval)), len(path.control) - 2)
    ahead = path.control[: half + 2]
    control = np.concatenate([ahead, ahead[-2::-1]])  # symmetric about the control point of the pose at half time
    return replace(path, kind="return", control=control, interval=duration / 2 / half)


def begun_again(path: SplinePath, duration: float) -> SplinePath:
    """Way until just before half of the duration, a jump back to its start (see :func:`jump`), and the same way again.

    During the jump the camera may pass through things: nothing is to be seen in that time.

    Args:
        path: its control points are taken, :func:`jump_parts` ``+ 3`` or more.
        duration: of the result, seconds.
    """
    parts = jump_parts(duration)
    first = path.control[: parts + 3]
    again = first.copy()
    again[:, 3] += 2 * np.pi * np.round((first[-1, 3] - again[0, 3]) / (2 * np.pi))  # turn by the shorter way
    return replace(path, kind="kidnap", control=np.concatenate([first, again]), interval=duration / (2 * parts + 3))


def jump_parts(duration: float) -> int:
    """Intervals of :func:`begun_again` before the jump, and after it.

    Args:
        duration: seconds.
    """
    return max(2, math.ceil((duration / INTERVAL - 3) / 2))


def jump(duration: float) -> tuple[float, float]:
    """Time in which :func:`begun_again` jumps, in the middle of the duration, at most 1.8 seconds (of a duration of
    four seconds or more).

    Args:
        duration: seconds.

    Returns:
        Begin and end, seconds.
    """
    interval = duration / (2 * jump_parts(duration) + 3)
    return (duration - 3 * interval) / 2, (duration + 3 * interval) / 2
