"""Geometry is computed in full precision, whatever the networks around it run in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """Switch autocast and TF32 matrix products off: ten bits of mantissa are a pixel in a thousand."""
    before = torch.get_float32_matmul_precision() if device.type == "cuda" else "highest"
    if before != "highest":
        torch.set_float32_matmul_precision("highest")
    try:
        if torch.is_autocast_enabled(device.type):
            with torch.autocast(device.type, enabled=False):
                yield
        else:
            yield
    finally:
        if before != "highest":
            torch.set_float32_matmul_precision(before)
