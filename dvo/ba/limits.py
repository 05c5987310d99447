"""Limits of the numbers of a problem, and checks of options."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.settings import shown

LARGEST = 1e8
"""Largest magnitude of a coordinate (scene units or pixels), inverse depth or focal length, and of a step: products of
a few of them are numbers of float32."""
HEAVIEST = 1e16
"""Largest weight of a measurement of a graph: its product with the square of a residual is a number of float32."""
SHORTEST_FOCAL = 1e-3
"""Least focal length, pixels (1 in normalised coordinates)."""
RETRIES = 6
"""Attempts after a failed factorisation, each with ten times the damping."""
LARGEST_TURN = 10.0
"""Largest step of the logarithm of a focal length, or of a principal point in focal lengths."""


def check_kind(value: Any, field: str, kind: type) -> None:
    """Check that an option is an object of a class.

    Raises:
        DvoError: something else.
    """
    if not isinstance(value, kind):
        raise DvoError(f"is {shown(value)}", field=field, remedy=f"give a {kind.__name__} object")


def check_number(value: Any, field: str, low: float, high: float = math.inf) -> None:
    """Check that an option is a number within limits.

    Args:
        value: the option.
        field: its name.
        low, high: smallest and largest valid value; infinity is valid only if ``high`` is infinite.

    Raises:
        DvoError: something else, or NaN.
    """
    if isinstance(value, Real) and not isinstance(value, bool) and low <= float(value) <= high:
        return
    limits = f"from {low:g} to {high:g}" if math.isfinite(high) else f"of at least {low:g}"
    raise DvoError(f"is {shown(value)}, not a number {limits}", field=field, remedy=f"give a number {limits}")


def check_positive(value: Any, field: str) -> None:
    """Check that an option is a positive number whose square is one of float32: from 1e-12 to 1e12.

    Raises:
        DvoError: something else, or NaN.
    """
    if isinstance(value, Real) and not float(value) > 0:
        raise DvoError(f"is {shown(value)}, not positive", field=field, remedy="give a positive number")
    check_number(value, field, 1e-12, 1e12)


def check_size(value: Any, field: str = "bounds") -> None:
    """Check that an option is a width and a height, positive and at most :data:`LARGEST` pixels.

    Raises:
        DvoError: something else, or NaN.
    """
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise DvoError(f"is {shown(value)}, not two numbers", field=field, remedy="give (width, height) in pixels")
    for x in value:
        if not (isinstance(x, Real) and not isinstance(x, bool) and 0 < float(x) <= LARGEST):
            raise DvoError(f"is {shown(value)}, no size", field=field, remedy="give a positive (width, height)")


def check_whole(value: Any, field: str) -> None:
    """Check that an option is a whole number, not negative.

    Raises:
        DvoError: something else.
    """
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise DvoError(f"is {shown(value)}, not a whole number", field=field, remedy="give a whole number")
    if value < 0:
        raise DvoError(f"is {value}, negative", field=field, remedy="give 0 or more")


def check_range(value: Any, field: str, low: float, high: float) -> None:
    """Check that an option is a pair of numbers, the smaller one first, within limits.

    Args:
        value: the option.
        field: its name.
        low, high: smallest and largest valid value.

    Raises:
        DvoError: something else, or NaN.
    """
    pair = isinstance(value, (tuple, list)) and len(value) == 2
    if not pair or not all(isinstance(x, Real) and not isinstance(x, bool) for x in value):
        raise DvoError(f"is {shown(value)}, not two numbers", field=field, remedy="give (low, high)")
    if not low <= value[0] <= value[1] <= high:
        remedy = f"give (low, high) from {low:g} to {high:g}, the smaller one first"
        raise DvoError(f"is {shown(value)}, no range", field=field, remedy=remedy)


def check_switch(value: Any, field: str) -> None:
    """Check that an option is true or false.

    Raises:
        DvoError: something else.
    """
    if not isinstance(value, bool):
        raise DvoError(f"is {shown(value)}, not true or false", field=field, remedy="give True or False")
