"""A long time in one process: memory, descriptors and threads after tracking, maps, exports and errors."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import os
import threading
import time
from itertools import count
from pathlib import Path

import numpy as np
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.export.formats import export_run
from dvo.synth.sequence import make_sequence

SETTINGS = {"patches": 12, "lifetime": 5, "removal": 6, "initial_updates": 6, "final_updates": 2, "pixels": 160 * 120}
WARM = 3
"""Rounds before the first reading: caches fill and modules load."""
GROWTH = 0.01
"""Share of the memory by which the last rounds may lie above the first ones."""


def trial(place: Path, minutes: float) -> tuple[str, bool]:
    """Track, save, load, export and fail, again and again.

    Args:
        place: an empty folder.
        minutes: to go on; at least ten rounds are made.

    Returns:
        Table, and whether anything grew or a trajectory changed.
    """
    torch.set_num_threads(1)
    sequence = make_sequence(4, frames=24, family="room", kind="sideways", height=120, width=160)
    frames = list(sequence)
    end, hashes, memory = time.monotonic() + 60 * minutes, set(), []
    descriptors = threads = 0
    for number in count():
        if number >= WARM + 10 and time.monotonic() > end:
            break
        hashes.add(_round(place, frames))
        gc.collect()
        if number == WARM:
            descriptors, threads = _descriptors(), threading.active_count()
        if number >= WARM:
            memory.append(_memory())
    third = max(1, len(memory) // 3)
    first, last = float(np.median(memory[:third])), float(np.median(memory[-third:]))
    growth = last / first - 1
    rows = [
        f"rounds of {len(frames)} frames: {len(memory) + WARM}",
        f"different trajectories: {len(hashes)}",
        f"memory, MB: {first:.0f} in the first third, {last:.0f} in the last ({100 * growth:+.2f} %)",
        f"descriptors: {descriptors}, {_descriptors()}",
        f"threads: {threads}, {threading.active_count()}",
        f"files left: {len(list(place.iterdir()))}",
    ]
    grew = growth > GROWTH or _descriptors() > descriptors or threading.active_count() > threads
    return "\n".join(rows), grew or len(hashes) > 1 or any(place.iterdir())


def _round(place: Path, frames: list[Frame]) -> str:
    """One of everything; the hash of the trajectory."""
    odometry = dvo.load("small", device="cpu", **SETTINGS)
    result = dvo.run(odometry, iter(frames)).result
    file, out = place / "a.dvo", place / "export"
    odometry.save(file)
    said = export_run(odometry, result, ["colmap", "tum", "kitti"], out)
    assert len(said) == 3
    again = dvo.load_map(file, device="cpu")
    for frame in frames[:6]:
        again.track(frame)
    again.finish()
    dvo.run(dvo.load("klt-pnp"), iter(frames))
    with contextlib.suppress(DvoError):
        dvo.open(place / "none.mp4")
    with contextlib.suppress(DvoError):
        odometry.track(frames[0])
    for path in sorted(place.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    return hashlib.sha256(result.trajectory.poses_wc.tobytes()).hexdigest()


def _memory() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))
