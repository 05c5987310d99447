"""A new beginning of an odometry that has tracked a sequence."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def start_again(odometry: T, new: T) -> None:
    """Put the state of a new odometry in the place of that of one that has been used.

    The network and what else the two share are not copied. What was taken out of the old one, such as its graph or its
    results, stays as it is.

    Args:
        odometry: in any state; afterwards as ``new``.
        new: of the same class, newly built; not used otherwise.
    """
    state = vars(odometry)
    state.clear()
    state.update(vars(new))
