"""Checks of tensors that are given as arguments."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dvo.ba.limits import LARGEST
from dvo.core.errors import DvoError

REAL = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Types of tensors of numbers."""
WHOLE = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
"""Types of tensors of indices."""


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
    # A limit may be infinite in half precision.
    if tensor.numel() and not bool((torch.isfinite(tensor) & (tensor >= low) & (tensor <= high)).all()):
        limits = f"from {low:g} to {high:g}"
        raise DvoError(f"a number that is not {limits}", field=field, remedy=f"give finite numbers {limits}")
