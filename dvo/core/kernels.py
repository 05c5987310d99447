"""Choice between compiled kernels and their plain PyTorch twins.

On the CPU, kernels are loops of numba (:func:`use_kernels`); on CUDA, they are written in Triton, which comes with such
builds of torch (:func:`use_device_kernels`), in files named ``*_triton.py``.

A kernel is a loop over numbers, compiled by numba when it is first called and then kept on the disk. The twin is its
specification: it serves on an accelerator, where derivatives are asked for that no kernel computes, where numba cannot
be imported, and everywhere with ``DVO_KERNELS=torch``. Kernels stand in files named ``*_kernels.py``, which import
numba and are imported where :func:`use_kernels` says so, since that takes half a second.
"""

from __future__ import annotations

import importlib
import os
import threading
from functools import cache

import torch
from torch import Tensor
from torch.autograd import forward_ad

from dvo.core.errors import DvoError
from dvo.core.text import print_line

VARIABLE = "DVO_KERNELS"
CHOICES = ("numba", "torch")
_IMPORTING = threading.Lock()
_FOUND: list[str] = []  # packages that were imported


def use_kernels(*tensors: Tensor, double: bool = False, half: bool = False, adjoint: bool = False) -> bool:
    """Tell if a computation on these tensors is one for kernels.

    Args:
        tensors: the floating-point arguments.
        double: the kernels take float64 as well.
        half: the kernels take bfloat16 as well.
        adjoint: first derivatives have kernels too, hence autograd may record.

    Returns:
        True for float32 tensors (or float64 or bfloat16, where these are taken) on the CPU of which no derivative is
        recorded, by autograd (unless ``adjoint``), as dual numbers or within ``torch.func``, if kernels are there and
        wanted; False while operations are traced, for ONNX.

    Raises:
        DvoError: ``DVO_KERNELS`` has another value than ``numba`` or ``torch``.
    """
    if not available() or is_transformed() or forward_ad._current_level >= 0 or torch.jit.is_tracing():
        return False
    wider = (torch.float64,) * double + (torch.bfloat16,) * half
    dtype = next((x.dtype for x in tensors if x.dtype in wider), torch.float32)
    plain = all(type(x) is Tensor and x.device.type == "cpu" and x.dtype == dtype for x in tensors)
    return plain and (adjoint or not (torch.is_grad_enabled() and any(x.requires_grad for x in tensors)))


def use_device_kernels(*tensors: Tensor) -> bool:
    """Tell if a computation on these tensors is one for kernels of Triton.

    The first call with tensors of a CUDA device imports triton and tries a kernel on the device; if that fails, one
    line says so, and the twins compute everything on it.

    Args:
        tensors: the floating-point arguments.

    Returns:
        True for float32 tensors on one CUDA device of which no derivative is recorded (see :func:`use_kernels`), if
        kernels are there and wanted.

    Raises:
        DvoError: see :func:`use_kernels`.
    """
    device = tensors[0].device
    if device.type != "cuda" or _chosen() != CHOICES[0] or is_transformed() or forward_ad._current_level >= 0:
        return False
    if any(type(x) is not Tensor or x.device != device or x.dtype != torch.float32 for x in tensors):
        return False
    return not (torch.is_grad_enabled() and any(x.requires_grad for x in tensors)) and _works_on(device)


@cache
def _works_on(device: torch.device) -> bool:
    try:
        importlib.import_module("dvo.core.device_triton").check(device)
    except Exception as error:  # of Triton, of its compiler or of the driver
        reason = " ".join(f"{type(error).__name__} {error}".split())[:200]
        print_line(f"dvo: note: no kernels on {device} ({reason}): computing without them, slower", error=True)
        return False
    return True


def is_transformed() -> bool:
    """True within ``torch.func`` (grad, vjp, jvp, vmap, ...)."""
    return torch._C._are_functorch_transforms_active()


def is_batched(x: Tensor) -> bool:
    """True for a tensor of ``torch.autograd.grad(..., is_grads_batched=True)``, whose vmap is another."""
    keys = str(torch._C._dispatch_keys(x))
    return "Batched" in keys and "FuncTorch" not in keys


def available() -> bool:
    """Tell if kernels are wanted, and numba can be imported; if it cannot, one line says so.

    Raises:
        DvoError: see :func:`use_kernels`.
    """
    return _chosen() == CHOICES[0] and imported()


def _chosen() -> str:
    chosen = os.environ.get(VARIABLE) or CHOICES[0]
    if chosen not in CHOICES:
        raise DvoError(f"is {chosen!r}", field=VARIABLE, remedy=f"set it to {' or '.join(CHOICES)}, or unset it")
    return chosen


def imported() -> bool:
    """Tell if numba can be imported; if it cannot, one line says so."""
    if _FOUND:
        return True
    with _IMPORTING:  # a line of two threads would be two
        return _import()


@cache
def _import() -> bool:
    try:
        importlib.import_module("numba")
    except ImportError as error:  # also a numba that does not know this numpy
        reason = " ".join(str(error).split())[:200]
        print_line(f"dvo: note: numba cannot be imported ({reason}): computing without kernels, slower", error=True)
        return False
    _FOUND.append("numba")
    return True
