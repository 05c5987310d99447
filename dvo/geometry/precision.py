"""Full precision for geometry, whatever precision the networks around it run in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """Context without autocast and without TF32 matrix products.

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
