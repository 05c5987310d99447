"""Checks of options, and of tensors that are given as arguments."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor

from dvo.ba.limits import LARGEST
from dvo.core.errors import DvoError
from dvo.core.settings import shown

REAL = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Types of tensors of numbers."""
WHOLE = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
"""Types of tensors of indices."""


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


def check_tensor(value: Any, field: str, dtypes: tuple[torch.dtype, ...], device: torch.device | None) -> None:
    """Check that an argument is a dense tensor of some types on a device. Nothing is read from it.

    Args:
        value: the argument.
        field: its name.
        dtypes: :data:`REAL` or :data:`WHOLE`, or some of them.
        device: of all arguments; None if it does not matter.

    Raises:
        DvoError: something else.
    """
    if not isinstance(value, Tensor):
        raise DvoError(f"is {type(value).__name__}, not a tensor", field=field, remedy="give a torch.Tensor")
    if value.dtype not in dtypes:
        remedy = "give whole numbers" if dtypes is WHOLE else "give floating-point numbers"
        raise DvoError(f"has dtype {value.dtype}", field=field, remedy=remedy)
    if device is not None and value.device != device:
        raise DvoError(f"is on {value.device}, not on {device}", field=field, remedy="give all tensors on one device")
    if value.layout != torch.strided:
        raise DvoError(f"has layout {value.layout}", field=field, remedy="give a dense tensor")


def check_within(tensor: Tensor, field: str, low: float = -LARGEST, high: float = LARGEST) -> None:
    """Check that all numbers of a tensor lie within limits. Waits for the device on an accelerator.

    Args:
        tensor: of any shape.
        field: its name.
        low, high: smallest and largest valid value.

    Raises:
        DvoError: a number that does not, or NaN.
    """
    if not tensor.numel():
        return
    ends = torch.stack(tensor.aminmax())  # NaN if any number is
    # A limit may be infinite in half precision.
    if not bool((torch.isfinite(ends) & (ends >= low) & (ends <= high)).all()):
        limits = f"from {low:g} to {high:g}"
        raise DvoError(f"a number that is not {limits}", field=field, remedy=f"give finite numbers {limits}")
