"""What all kernels of Triton need. Imports triton, so that it is imported where :mod:`dvo.core.kernels` says so."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor


def on_device(x: Tensor) -> AbstractContextManager[Any]:
    """Context in which kernels run on the device of a tensor; on the CPU, Triton's interpreter runs them.

    Args:
        x: an argument of the kernel.
    """
    return nullcontext() if x.device.type == "cpu" else getattr(torch, x.device.type).device(x.device)


@triton.jit
def _sum_and_rest(values):
    return values[0] + tl.sin(values[1].to(tl.float64)), values[1]


@triton.jit
def _try(x, out):
    """Twice ``x`` by means that not every version of Triton has: tuples, sums over one of three dimensions, float64."""
    lane = tl.arange(0, 4)
    one, zero = _sum_and_rest((tl.load(x), tl.load(x) * 0))
    total = tl.sum(tl.where(lane[None, :, None] == lane[:, None, None] + 1, one + lane[None, None, :] * zero, 0.0), 1)
    tl.store(out, tl.sum(tl.sum(tl.trans(total), 0), 0) / 6)


def check(device: torch.device) -> None:
    """Compile a kernel, run it and look at the result: a compiler of C may be missing, or a driver too old.

    Args:
        device: to run on.

    Raises:
        Exception: of any kind, whatever Triton and the driver raise.
    """
    x = torch.ones(1, device=device)
    out = torch.zeros_like(x)
    with on_device(x):
        _try[(1,)](x, out)
    if out.item() != 2:
        raise RuntimeError("a kernel computes nothing")
