"""What torch and NumPy compute with: own settings in place of those of the calling program, full precision, threads."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.core.threads import available_cores

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


@cache
def multiplies_bfloat16(device: torch.device) -> bool:
    """Tell if a device is a CPU with instructions for products of bfloat16, which are twice as fast there or more.

    Args:
        device: any.
    """
    known = getattr(torch.cpu, "_is_avx512_bf16_supported", None)  # torch 2.6 and newer
    return device.type == "cpu" and known is not None and bool(known())


_forks = {"work": False, "after work": False}  # several threads have computed; this process was forked after that


def use_threads() -> None:
    """Note that torch computes, by several threads if it has several; what takes long or many tensors calls it first.

    A forked process has only the thread that forked. Torch would hand parts of its work to the others of its parent,
    and wait for them for ever; with one thread of its own it hands over nothing.

    Raises:
        DvoError: a process with several threads that was forked after those of its parent had computed.
    """
    if torch.get_num_threads() == 1:
        return
    if _forks["after work"]:
        raise DvoError(
            "this process was forked after threads of torch had computed in its parent, and would wait for them",
            field="fork",
            remedy='start it by multiprocessing.get_context("spawn") or get_context("forkserver"), or call '
            "torch.set_num_threads(1) in it first",
        )
    _forks["work"] = True


def _after_fork() -> None:
    _forks["after work"] = _forks["work"]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@contextlib.contextmanager
def core_left(busy: bool = True) -> Iterator[None]:
    """Leave a core to a busy thread of this process: torch computes with one thread less, if all cores have one.

    With more threads than cores those that share a core wait for each other in every parallel loop. On two cores beside
    a busy thread, tracking is faster with one thread than with two.

    Args:
        busy: there is such a thread; nothing changes otherwise.
    """
    count = torch.get_num_threads()
    fewer = min(count, max(1, available_cores() - 1)) if busy else count
    if fewer != count:
        torch.set_num_threads(fewer)
    try:
        yield
    finally:
        if fewer != count:
            torch.set_num_threads(count)


def core_free() -> bool:
    """Tell if a thread beside those of torch would have a core of its own."""
    return torch.get_num_threads() < available_cores()
