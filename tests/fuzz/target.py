"""Targets: readers with a small valid input, and checks of what they accept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from tests.fuzz.mutations import mutate_folder

Mutate = Callable[[Path, np.random.Generator], str]
Read = Callable[[Path, np.random.Generator | None], object]


class WrongResult(Exception):
    """Input that was accepted, with a result that cannot be right."""


class CleanExit(Exception):
    """Input that a command line refused with one message and exit code 2."""


@dataclass(frozen=True)
class Target:
    """A reader under test.

    Attributes:
        name: in the table, and in ``--case NAME:SEED``.
        build: writes a valid input into an empty folder.
        read: reads the input and checks what was read; raises ``DvoError`` or :class:`CleanExit` to refuse it. Chooses
            options by its second argument, which is None for the valid input.
        mutate: changes the input, and returns a description of the change.
        modules: modules to import once, before cases are run.
    """

    name: str
    build: Callable[[Path], None]
    read: Read
    mutate: Mutate = mutate_folder
    modules: tuple[str, ...] = ()


def chance(random: np.random.Generator | None, probability: float) -> bool:
    """Draw whether an option is used; never for the valid input.

    Args:
        random: source of the choice; None for the valid input.
        probability: from 0 to 1.
    """
    return random is not None and random.random() < probability


def require(condition: object, message: str) -> None:
    """Raise :class:`WrongResult` unless a condition holds.

    Args:
        condition: whose truth is required.
        message: of the exception.
    """
    if not condition:
        raise WrongResult(message)


def check_trajectory(trajectory: Trajectory) -> None:
    """Check poses that a reader accepted: finite, unit quaternions, finite increasing times, finite length.

    Args:
        trajectory: as read.

    Raises:
        WrongResult: one of these does not hold.
    """
    poses, times = trajectory.poses_wc, trajectory.timestamps
    require(len(poses) > 0, "trajectory without poses")
    require(np.isfinite(poses).all(), "poses that are not finite")
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    require(np.abs(norms - 1).max() < 1e-6, "quaternions that have not length 1")
    require(np.isfinite(trajectory.path_length), "path of infinite length")
    check_times(times)


def check_times(times: np.ndarray) -> None:
    """Check times that a reader accepted: finite and increasing.

    Args:
        times: ``(N,)`` seconds.

    Raises:
        WrongResult: one of these does not hold.
    """
    require(np.isfinite(times).all(), "times that are not finite")
    require((np.diff(times) > 0).all(), "times that do not increase")


def check_frames(frames: Iterable[Frame], count: int = 4) -> None:
    """Read the first frames of a source with all their sensors, and check them.

    Args:
        frames: source or stream.
        count: number of frames.

    Raises:
        WrongResult: times that do not increase, or an array of another type or shape than documented.
    """
    times = []
    for frame in islice(_iterate(frames), count):
        times.append(frame.timestamp)
        size = (frame.camera.height, frame.camera.width)
        require(frame.image.shape == (*size, 3) and frame.image.dtype == np.uint8, f"image {frame.image.shape}")
        require(np.isfinite(frame.camera.intrinsics).all(), "intrinsics that are not finite")
        depth, right, inertial = frame.depth, frame.right, frame.inertial
        if depth is not None:
            require(depth.shape == size and depth.dtype == np.float32, f"depth {depth.shape} {depth.dtype}")
            require(not (depth <= 0).any() and not np.isinf(depth).any(), "depth that is no distance")
        if right is not None:
            require(np.isfinite(right.T_left_right).all(), "right camera that is not finite")
            require(right.image.shape == (right.camera.height, right.camera.width, 3), f"right {right.image.shape}")
        if inertial is not None:
            check_times(inertial.timestamps)
            require(np.isfinite(inertial.gyro).all() and np.isfinite(inertial.accel).all(), "samples not finite")
            require(inertial.T_camera_imu is None or np.isfinite(inertial.T_camera_imu).all(), "T_camera_imu")
    check_times(np.array(times))


def _iterate(frames: Iterable[Frame]) -> Iterator[Frame]:
    try:
        yield from frames
    except StopIteration as error:  # a generator turns it into RuntimeError, with less to read
        raise WrongResult("StopIteration from a reader") from error
