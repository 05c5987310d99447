"""Settings of torch and NumPy in a context: own ones in place of those of the calling program, and full precision."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
import torch

P = ParamSpec("P")
R = TypeVar("R")
_ERRORS = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}  # as NumPy begins


@contextlib.contextmanager
def own_context() -> Iterator[None]:
    """Compute with the settings that torch and NumPy begin with, whatever the calling program has set.

    These are the default type (float32) and device (the CPU) of new tensors, no automatic mixed precision, gradients
    as the code asks for them, and warnings in place of NumPy's floating-point errors. All are restored at the end.
    The default type is one of the process: threads that make tensors in the meantime get float32.
    """
    with contextlib.ExitStack() as stack:
        before = torch.get_default_dtype()
        if before is not torch.float32:
            torch.set_default_dtype(torch.float32)
            stack.callback(torch.set_default_dtype, before)
        if str(torch.get_default_device()) != "cpu":
            stack.enter_context(torch.device("cpu"))
        for kind in ("cpu", *_accelerator()):
            if torch.is_autocast_enabled(kind):
                stack.enter_context(torch.autocast(kind, enabled=False))
        if np.geterr() != _ERRORS:
            stack.enter_context(np.errstate(**_ERRORS))  # type: ignore[arg-type]
        yield


def _accelerator() -> tuple[str, ...]:
    """Type of the accelerator, if there is one."""
    accelerator = getattr(torch, "accelerator", None)  # torch 2.6 and newer
    found = accelerator.current_accelerator() if accelerator is not None and accelerator.is_available() else None
    return () if found is None else (found.type,)


def in_own_context(function: Callable[P, R]) -> Callable[P, R]:
    """Call a function in :func:`own_context`: a decorator.

    Args:
        function: any.
    """

    @wraps(function)
    def call(*args: P.args, **keywords: P.kwargs) -> R:
        with own_context():
            return function(*args, **keywords)

    return call


@contextlib.contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """Compute geometry without autocast and without TF32 matrix products, whatever the networks around it run in.

    Ten bits of mantissa resolve a coordinate of 1000 pixels to one pixel only.

    Args:
        device: on which the computation runs.
    """
    matmul = torch.backends.cuda.matmul
    name, exact = ("fp32_precision", "ieee") if hasattr(matmul, "fp32_precision") else ("allow_tf32", False)
    before = getattr(matmul, name)
    change = device.type == "cuda" and before != exact
    if change:
        setattr(matmul, name, exact)
    try:
        if torch.is_autocast_enabled(device.type):
            with torch.autocast(device.type, enabled=False):
                yield
        else:
            yield
    finally:
        if change:
            setattr(matmul, name, before)
