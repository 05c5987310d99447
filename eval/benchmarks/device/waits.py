"""Places at which an accelerator is waited for while a frame is tracked."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable
from unittest import mock

import torch

from dvo.core.errors import DvoError
from dvo.core.kernels import VARIABLE
from dvo.data.frame import Frame
from dvo.models.weights import load_weights
from dvo.odometry.load import build_odometry
from eval.benchmarks.device.stand_in import DEVICE, LIBRARY, stand_in

SHOWN = 8
"""Places named in a row."""


def waits_of_stand_in(frames: list[Frame]) -> tuple[float, str]:
    """Mean number of waits of a frame of a window in use, by a stand-in for an accelerator, on any machine.

    Args:
        frames: of a video; the first two thirds fill the window.

    Returns:
        The number, and the places with the most.
    """
    first = 2 * len(frames) // 3
    with mock.patch.dict(os.environ, {VARIABLE: "torch"}), stand_in() as waits:
        odometry = build_odometry(load_weights("small"), device=DEVICE, loops=False, restart=False)
        for number, frame in enumerate(frames):
            if number == first:
                waits.places.clear()
            odometry.track(frame)
        found = Counter({f"{file}:{line}": 0 for _, file, line in waits.places})
        for (_, file, line), count in waits.places.items():
            found[f"{file}:{line}"] += count
    return _per_frame(found, len(frames) - first)


def waits_of_device(walk: Callable[[], list[Frame]], device: torch.device) -> tuple[float, str]:
    """The same as the device itself tells, which has to be one of CUDA.

    Args:
        walk: renders the frames of a video, of which the first two thirds fill the window.
        device: an accelerator.

    Returns:
        The number, and the places with the most.

    Raises:
        DvoError: a device that does not tell.
    """
    module = getattr(torch, device.type)
    if not hasattr(module, "set_sync_debug_mode"):
        raise DvoError(f"{device.type} does not tell of waits", field="--device", remedy="see the stand-in")
    frames = walk()
    first = 2 * len(frames) // 3
    odometry = build_odometry(load_weights("small", device), device=device, loops=False, restart=False)
    for frame in frames[:first]:
        odometry.track(frame)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        module.set_sync_debug_mode("warn")
        try:
            for frame in frames[first:]:
                odometry.track(frame)
        finally:
            module.set_sync_debug_mode("default")
    told = [one for one in seen if "synchroniz" in str(one.message)]
    found = Counter(f"{one.filename.removeprefix(str(LIBRARY)).lstrip('/')}:{one.lineno}" for one in told)
    return _per_frame(found, len(frames) - first)


def _per_frame(found: Counter[str], frames: int) -> tuple[float, str]:
    places = "; ".join(f"{place} {count / frames:.1f}" for place, count in found.most_common(SHOWN))
    return found.total() / frames, places
