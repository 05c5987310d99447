"""What a dataset's reader hands back, before cameras and undistortion: images with times."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from dvo.data.calibration import Calibration
from dvo.data.images import read_image
from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError


@dataclass(frozen=True)
class Request:
    """What the user asked for, as far as a reader is concerned.

    Attributes:
        times: file with the time of every image.
        fps: frames a second.
    """

    times: Path | None = None
    fps: float | None = None


@dataclass(frozen=True)
class RawFrame:
    """An image as recorded.

    Attributes:
        index: position in the recording from 0, unreadable images counted.
        timestamp: seconds.
        image: ``(H, W, 3)`` uint8 RGB.
        origin: file name or frame number, for messages.
    """

    index: int
    timestamp: float
    image: np.ndarray
    origin: str


@dataclass
class Log:
    """What went wrong on one pass over a recording without ending it.

    Attributes:
        unreadable: names of the images that could not be decoded.
        notes: other sentences.
    """

    unreadable: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def messages(self) -> list[str]:
        """Sentences for people."""
        found = list(self.notes)
        if self.unreadable:
            named = ", ".join(self.unreadable[:3]) + (", ..." if len(self.unreadable) > 3 else "")
            count = len(self.unreadable)
            found.insert(0, f"{count} image{'s' * (count > 1)} could not be read and were skipped: {named}")
        return found


class Recording(Protocol):
    """Images with times, as a reader found them."""

    name: str
    kind: str
    path: Path
    frame_count: int | None
    calibration: Calibration | None
    groundtruth: Trajectory | None
    warnings: list[str]

    def frames(self, log: Log, stride: int = 1) -> Iterator[RawFrame]:
        """Every ``stride``-th frame, times strictly increasing; unreadable ones go into the log."""
        ...


@dataclass(frozen=True)
class Reader:
    """One dataset layout.

    Attributes:
        name: its kind, as in ``Source.kind``.
        matches: whether a path has this layout; looks at names only.
        open: reads everything but the images.
    """

    name: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, Request], Recording]


class ImageRecording:
    """A list of image files. Rows whose time is not later than the one before are dropped, with a warning.

    Args:
        kind: name of the reader.
        path: what the user named.
        images: ``N`` files in the order of recording.
        timestamps: ``(N,)`` seconds.
        calibration, groundtruth: what the dataset knows.
        warnings: what the user should know.
        name: of the sequence; the folder's by default.

    Raises:
        DvoError: no images.
    """

    def __init__(
        self,
        kind: str,
        path: Path,
        images: list[Path],
        timestamps: np.ndarray,
        *,
        calibration: Calibration | None = None,
        groundtruth: Trajectory | None = None,
        warnings: list[str] | None = None,
        name: str | None = None,
    ) -> None:
        if not images:
            raise DvoError("no images in it", file=path, remedy="give a video, a folder of images or a sequence")
        self.kind, self.path, self.name = kind, path, name or path.resolve().name
        self.calibration, self.groundtruth = calibration, groundtruth
        self.warnings = list(warnings or [])
        later = np.ones(len(images), dtype=bool)
        later[1:] = timestamps[1:] > np.maximum.accumulate(timestamps)[:-1]
        if not later.all():
            first = images[int(np.argmin(later))].name
            self.warnings.append(
                f"{int((~later).sum())} images are not later than the one before and were dropped, "
                f"the first is {first} (give right times with --times)"
            )
        self.images = [image for image, keep in zip(images, later, strict=True) if keep]
        self.timestamps = np.asarray(timestamps, dtype=np.float64)[later]
        self.frame_count: int | None = len(self.images)

    def frames(self, log: Log, stride: int = 1) -> Iterator[RawFrame]:
        """See :class:`Recording`."""
        for index in range(0, len(self.images), stride):
            image = read_image(self.images[index])
            if image is None:
                log.unreadable.append(self.images[index].name)
            else:
                yield RawFrame(index, float(self.timestamps[index]), image, str(self.images[index]))


def rows_of_images(images: list[Path], rows: int) -> np.ndarray | None:
    """Which of ``rows`` table rows (one per frame of the full sequence) belongs to which image.

    Row i is image i if there are as many; of a sequence copied in part, the number in the file's name is the row.

    Returns:
        ``(len(images),)`` int, or None if neither holds.
    """
    if rows == len(images):
        return np.arange(rows)
    numbers = [re.match(r"\d+", image.stem) for image in images]
    found = np.array([int(number.group()) if number else -1 for number in numbers], dtype=np.int64)
    return found if len(found) and (found >= 0).all() and (found < rows).all() else None
