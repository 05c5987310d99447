"""Decisions and means over the processes of a distributed run; with one process they change nothing."""

from __future__ import annotations

import torch
from torch import Tensor, distributed


def world_size() -> int:
    """Number of training processes."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def rank() -> int:
    """Number of this process, 0 without a distributed run."""
    return distributed.get_rank() if world_size() > 1 else 0


def mean_over_ranks(value: Tensor) -> Tensor:
    """Mean over the processes.

    Args:
        value: of this process, any shape.
    """
    if world_size() == 1:
        return value
    total = value.detach().clone()
    distributed.all_reduce(total)
    return total / world_size()


def all_agree(good: Tensor) -> bool:
    """Whether a boolean scalar is true in every process.

    Args:
        good: of this process.
    """
    if world_size() > 1:
        least = good.to(torch.int32)
        distributed.all_reduce(least, op=distributed.ReduceOp.MIN)
        return bool(least)
    return bool(good)
