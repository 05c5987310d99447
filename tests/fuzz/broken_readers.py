"""Readers that are broken on purpose, to show that the fuzzer reports them."""

from __future__ import annotations

import mmap
import os
import sys
import time
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from tests.fuzz.target import Target, check_trajectory


def build(folder: Path) -> None:
    (folder / "input.txt").write_text("1 2 3\n", encoding="utf-8")


def good(folder: Path, random: np.random.Generator | None) -> None:
    if random is not None:
        raise DvoError("malformed", file=folder)


def accepting(folder: Path, random: np.random.Generator | None) -> None:
    return None


def refusing(folder: Path, random: np.random.Generator | None) -> None:
    raise DvoError("malformed", file=folder)


def key_error(folder: Path, random: np.random.Generator | None) -> None:
    if random is not None:
        {}["missing"]


def hang(folder: Path, random: np.random.Generator | None) -> None:
    if random is not None:
        time.sleep(600)


def loop(folder: Path, random: np.random.Generator | None) -> None:
    while random is not None:
        pass


def memory(folder: Path, random: np.random.Generator | None) -> None:
    if random is not None:
        held = mmap.mmap(-1, 320 * 10**6)  # new pages: an allocator may have freed memory left
        held.write(bytes(1) * len(held))
        time.sleep(0.2)


def crash(folder: Path, random: np.random.Generator | None) -> None:
    if random is not None:
        os.abort()


def leave(folder: Path, random: np.random.Generator | None) -> None:
    if random is not None:
        sys.exit(0)


def die(folder: Path, random: np.random.Generator | None) -> None:
    if random is not None:
        os._exit(3)


def wrong_truth(folder: Path, random: np.random.Generator | None) -> None:
    poses = np.array([[0, 0, 0, 0, 0, 0, 1.0], [1, 0, 0, 0, 0, 0, 1]])
    if random is not None:
        poses[1, 6] = 2
    check_trajectory(Trajectory(np.array([0.0, 1.0]), poses))


READERS = {
    function.__name__: Target(function.__name__, build, function)
    for function in (
        good, accepting, refusing, key_error, hang, loop, memory, crash, leave, die, wrong_truth
    )
}  # fmt: skip
