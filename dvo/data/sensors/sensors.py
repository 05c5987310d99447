"""Files that other sensors left beside the images of a recording, found for an image when they are first needed.

The functions from an image file to the file that belongs to it are small frozen dataclasses, so that a source can be
sent to the worker processes of a data loader.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from dvo.data.calibration.calibration import StereoRig
from dvo.data.files.files import is_file
from dvo.data.images.images import list_images
from dvo.data.inertial import InertialSamples
from dvo.data.positions import Positions

MILLIMETRES = 1000.0
"""Units of a metre in 16-bit depth images of a folder, unless it is a list in the layout of TUM RGB-D."""

Finder = Callable[[Path], Path | None]
"""Image file of the (left) camera to the file that belongs to it, None if there is none."""


@dataclass(frozen=True)
class Sensors:
    """Other sensors of a recording; all are optional. Nothing is read before it is needed.

    Attributes:
        depth: depth image of an image.
        depth_scale: units of a metre in depth images of integers.
        right: right image of an image; needs ``stereo``.
        stereo: reads the calibration of the right camera; None from it if there is none.
        inertial: reads all samples of the recording.
        positions: reads the positions of a satellite receiver.
    """

    depth: Finder | None = None
    depth_scale: float | None = None
    right: Finder | None = None
    stereo: Callable[[], StereoRig | None] | None = None
    inertial: Callable[[], InertialSamples] | None = None
    positions: Callable[[], Positions | None] | None = None


@dataclass(frozen=True)
class Listed:
    """File that belongs to an image by a table.

    Attributes:
        files: file of each image that has one.
    """

    files: dict[Path, Path]

    def __call__(self, image: Path) -> Path | None:
        return self.files.get(image)


@dataclass(frozen=True)
class SameName:
    """File of the same name in another folder.

    Attributes:
        folder: of the files.
        old, new: part of the name that differs, in the image's name and in the file's.
    """

    folder: Path
    old: str = ""
    new: str = ""

    def __call__(self, image: Path) -> Path | None:
        name = image.name.replace(self.old, self.new) if self.old else image.name
        file = self.folder / name
        return file if is_file(file) else None


@dataclass(frozen=True)
class SameNumbers:
    """Image of another folder whose name holds the same numbers, as ``7.depth.png`` does those of ``7.color.jpg``.

    Attributes:
        folder: of the files.
    """

    folder: Path

    @cached_property
    def _files(self) -> dict[tuple[str, ...], Path]:
        return {numbers_of(file): file for file in list_images(self.folder)}

    def __call__(self, image: Path) -> Path | None:
        return self._files.get(numbers_of(image))


def numbers_of(file: Path) -> tuple[str, ...]:
    """Numbers in the name of a file, by which files of two sensors belong to each other.

    Args:
        file: any.

    Returns:
        As they are written; the stem, if there are none.
    """
    return tuple(re.findall(r"[0-9]+", file.stem)) or (file.stem,)


@dataclass(frozen=True)
class NearestInTime:
    """File with the nearest time stamp.

    Attributes:
        times: seconds of the images.
        read: files and their ``(M,)`` increasing times in seconds; called once, when the first is needed.
        max_dt: largest difference of time, seconds.
    """

    times: dict[Path, float]
    read: Callable[[], tuple[list[Path], np.ndarray]]
    max_dt: float = 0.02

    @cached_property
    def _listing(self) -> tuple[list[Path], np.ndarray]:
        return self.read()

    def __call__(self, image: Path) -> Path | None:
        files, stamps = self._listing
        time = self.times.get(image)
        if time is None or not files:
            return None
        nearest = int(np.abs(stamps - time).argmin())
        return files[nearest] if abs(stamps[nearest] - time) <= self.max_dt else None
