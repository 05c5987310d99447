"""Means and decisions over the processes of a distributed run; identities with one process."""

from __future__ import annotations

import torch
from torch import Tensor, distributed


def world_size() -> int:
    """Number of training processes.

    Returns:
        1 without a distributed run.
    """
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def rank() -> int:
    """Index of this process.

    Returns:
        0 without a distributed run.
    """
    return distributed.get_rank() if world_size() > 1 else 0


def mean_over_ranks(value: Tensor) -> Tensor:
    """Mean over the processes.

    Args:
        value: of this process, any shape.

    Returns:
        The mean, equal in all processes; detached with more than one.
    """
    if world_size() == 1:
        return value
    total = value.detach().clone()
    distributed.all_reduce(total)
    return total / world_size()


def all_agree(good: Tensor) -> bool:
    """Logical and over the processes.

    Args:
        good: boolean scalar of this process.

    Returns:
        True if ``good`` is true in every process.
    """
    if world_size() > 1:
        least = good.to(torch.int32)
        distributed.all_reduce(least, op=distributed.ReduceOp.MIN)
        return bool(least)
    return bool(good)
