"""Recordings as a reader of a data set returns them, before cameras and undistortion: images with times."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import visible
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.files.files import exists
from dvo.data.images.image_header import white_value
from dvo.data.images.images import converted, decode, few_bits, narrow_range, read_image, used_bits
from dvo.data.images.orientation import check_zoom, common_orientation, turn
from dvo.data.images.reduction import Reduction
from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.imu_calibration import ImuCalibration
from dvo.data.interval import Interval
from dvo.data.positions import Positions
from dvo.data.sensors.depth import read_depth
from dvo.data.sensors.sensors import Sensors
from dvo.data.trajectory import Trajectory

_NO_IMAGES = "give a video, a folder of images or a sequence"
_VIDEO_NAMES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mts", ".3gp", ".wmv")
_LOOKED_AT = 7  # images of 16 bits whose largest values are compared


@dataclass(frozen=True)
class Request:
    """Options of :func:`dvo.data.open.open_source` that concern a reader.

    Attributes:
        times: file with the time of every image.
        fps: frames a second.
        calibration: calibration that the user named; wins over the data set's own.
        topic: of the images, in a bag of ROS.
        imu_topic: of the inertial samples, in a bag of ROS.
        imu_calibration: of the inertial sensor, that the user named; wins over the data set's own.
        groundtruth: file that the user named; where nothing else tells the times of images, its rows do.
    """

    times: Path | None = None
    fps: float | None = None
    calibration: Calibration | None = None
    topic: str | None = None
    imu_topic: str | None = None
    imu_calibration: ImuCalibration | None = None
    groundtruth: Path | None = None


@dataclass(frozen=True)
class Selection:
    """What is read of a recording.

    Attributes:
        interval: frames before it are not decoded, if the recording allows it, and those after it not read.
        stride: every how many-th frame of the interval is wanted.
        reduction: of the images, right after they are decoded; None for none.
    """

    interval: Interval = Interval()
    stride: int = 1
    reduction: Reduction | None = None


EVERYTHING = Selection()


@dataclass(frozen=True)
class RawFrame:
    """An image as recorded.

    Attributes:
        index: position in the recording from 0, unreadable images counted.
        timestamp: seconds.
        image: ``(H, W, 3)`` uint8 RGB; reduced, if the selection says so.
        origin: file name or frame number, for messages.
        depth: loads the depth image of this frame: ``(H, W)`` float32 metres with nan for unknown, or None.
        right: loads the right image of this frame: ``(H, W, 3)`` uint8 RGB, or None.
        silence: of a stream, see :attr:`dvo.data.frame.Frame.silence`.
    """

    index: int
    timestamp: float
    image: np.ndarray
    origin: str
    depth: Callable[[], np.ndarray | None] | None = None
    right: Callable[[], np.ndarray | None] | None = None
    silence: float | None = None


@dataclass
class Log:
    """Faults of one pass over a recording that did not end it.

    Attributes:
        unreadable: names of the images that could not be decoded.
        notes: other sentences.
        without: names of depth and right images that could not be decoded; their frames are kept.
        missing: names of listed images, or of links, without a file.
    """

    unreadable: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    without: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def messages(self) -> list[str]:
        """Sentences for people."""
        found = list(self.notes)
        if self.unreadable:
            count = len(self.unreadable)
            what = "1 image could not be read and was" if count == 1 else f"{count} images could not be read and were"
            found.insert(0, f"{what} skipped: {_few(self.unreadable)}")
        if self.missing:
            count = len(self.missing)
            what = "1 image is" if count == 1 else f"{count} images are"
            found.append(f"{what} not there (a broken link, or a name in a list): {_few(self.missing)}")
        if self.without:
            count = len(self.without)
            found.append(f"{count} depth or right image{'s' * (count > 1)} could not be read: {_few(self.without)}")
        return found


def _few(names: list[str]) -> str:
    return ", ".join(map(visible, names[:3])) + (", ..." if len(names) > 3 else "")


@runtime_checkable
class Recording(Protocol):
    """Images with times, as a reader found them. A class that derives from it has only to set what it knows.

    Attributes:
        name: of the sequence.
        kind: name of the reader.
        path: file or folder that the user named.
        frame_count: number of frames; None if it is not known before they are read.
        timestamps: ``(frame_count,)`` seconds; None if they are not known before they are read.
        images: files of the images, one a frame; None for a recording of another kind.
        turned: degrees clockwise by which frames are turned to stand upright.
        calibration: of the images as recorded; None if the data set has none.
        groundtruth: camera-to-world poses; None if the data set has none.
        warnings: guesses and oddities that the user should know, a sentence each.
        stereo: reads the calibration of the right camera; None where frames have no right images.
        inertial: reads all inertial samples of the recording, times on the clock of the frames; None for none.
        positions: reads the positions of a satellite receiver, of the same clock; None for none.
    """

    name: str
    kind: str
    path: Path
    frame_count: int | None
    calibration: Calibration | None
    groundtruth: Trajectory | None
    warnings: list[str]

    @property
    def timestamps(self) -> np.ndarray | None:
        return None

    @property
    def images(self) -> list[Path] | None:
        return None

    @property
    def turned(self) -> int:
        return 0

    @property
    def stereo(self) -> Callable[[], StereoRig | None] | None:
        return None

    @property
    def inertial(self) -> Callable[[], InertialSamples] | None:
        return None

    @property
    def positions(self) -> Callable[[], Positions | None] | None:
        return None

    def frames(self, log: Log, selection: Selection = EVERYTHING) -> Iterator[RawFrame]:
        """Frames in order.

        Args:
            log: receives what could not be read.
            selection: of them.

        Yields:
            The selected frames that can be read, times strictly increasing.

        Raises:
            DvoError: no frame is in the interval.
        """
        ...


@dataclass(frozen=True)
class Reader:
    """Layout of one kind of data set.

    Attributes:
        name: its kind, as in ``Source.kind``.
        matches: whether a path has this layout; looks at names only.
        open: reads everything but the images.

    Example:
        A module of an outside package, announced by an entry point of the group ``dvo.readers`` or by
        ``READERS.register("mine", "my_package.mine:READER")``::

            def matches(path: Path) -> bool:
                return (path / "mine.json").is_file()

            def open_mine(path: Path, request: Request) -> Recording:
                images = sorted((path / "frames").glob("*.png"))
                return ImageRecording("mine", path, images, np.arange(len(images)) / 20)

            READER = Reader("mine", matches, open_mine)
    """

    name: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, Request], Recording]


def _videos_in(path: Path) -> str:
    """Names of videos in a folder, as the end of a sentence."""
    videos = (
        sorted(file.name for file in path.iterdir() if file.suffix.lower() in _VIDEO_NAMES) if path.is_dir() else []
    )
    return f", but videos: {_few(videos)}" if videos else ""


class ImageRecording:
    """A list of image files. Rows whose time is not later than the one before are dropped, with a warning.

    Args:
        kind: name of the reader.
        path: what the user named.
        images: ``N`` files in the order of recording.
        timestamps: ``(N,)`` seconds.
        calibration, groundtruth: those of the data set, if it has any.
        warnings: guesses and oddities that the user should know, a sentence each.
        name: of the sequence; the folder's by default.
        sensors: files of other sensors.

    Attributes:
        orientation: of EXIF, by which all images are turned; 1 (as stored) if they do not agree, or if the data set has
            depth or right images.

    Raises:
        DvoError: no images, or times that are not finite.
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
        sensors: Sensors | None = None,
    ) -> None:
        if not images:
            raise DvoError(f"no images in it{_videos_in(path)}", file=path, remedy=_NO_IMAGES)
        self.kind, self.path, self.name = kind, path, name or path.resolve().name
        if not np.isfinite(timestamps).all():
            raise DvoError("times that are not finite", file=path, field="times", remedy="give times with --times")
        # poses of images that share a time share it too
        self.calibration, self.groundtruth = calibration, groundtruth.increasing() if groundtruth else None
        self.warnings = list(warnings or [])
        self.sensors = sensors or Sensors()
        later = np.ones(len(images), dtype=bool)
        later[1:] = timestamps[1:] > np.maximum.accumulate(timestamps)[:-1]
        if not later.all():
            first = images[int(np.argmin(later))].name
            self.warnings.append(
                f"{int((~later).sum())} images are not later than the one before and were dropped, "
                f"the first is {first} (give right times with --times)"
            )
        self.images: list[Path] = [image for image, keep in zip(images, later, strict=True) if keep]
        self.timestamps: np.ndarray = np.asarray(timestamps, dtype=np.float64)[later]
        self.frame_count: int | None = len(self.images)
        self._is_transparent = False
        check_zoom(self.images, self.warnings)
        has_others = self.sensors.depth is not None or self.sensors.right is not None
        self.orientation = 1 if has_others else common_orientation(self.images, self.warnings)

    @property
    def stereo(self) -> Callable[[], StereoRig | None] | None:
        """Reads the calibration of the right camera, if there are right images."""
        return self.sensors.stereo

    @property
    def inertial(self) -> Callable[[], InertialSamples] | None:
        """Reads all inertial samples, if there are any."""
        return self.sensors.inertial

    @property
    def positions(self) -> Callable[[], Positions | None] | None:
        """Reads the positions of a satellite receiver, if there are any."""
        return self.sensors.positions

    @property
    def turned(self) -> int:
        """Degrees clockwise by which images are turned to stand upright, as their EXIF data ask for."""
        return turn(self.orientation)

    @cached_property
    def bits(self) -> int:
        """Bits that images of 16 bits use, by some of them."""
        some = sorted({round(k * (len(self.images) - 1) / (_LOOKED_AT - 1)) for k in range(_LOOKED_AT)})
        decoded = (decode(self.images[index]) for index in some)
        first = next((image for image in decoded if image is not None), None)
        if first is None or first.dtype != np.uint16 or white_value(self.images[0]) is not None:
            return 16
        read = [decode(self.images[index]) for index in some]
        bits = used_bits(read)
        if bits < 16:
            self.warnings.append(few_bits(bits))
        self.warnings += filter(None, [narrow_range(read, bits)])
        return bits

    def _look_through(self, decoded: np.ndarray) -> None:
        """Warn once of transparent pixels."""
        if not self._is_transparent and (decoded[..., 3] == 0).any():
            self._is_transparent = True
            self.warnings.append(
                "the images have transparent pixels, which are read as they are coloured: to leave them out, give the "
                f"images as masks too (--mask {visible(str(self.images[0].parent))})"
            )

    def frames(self, log: Log, selection: Selection = EVERYTHING) -> Iterator[RawFrame]:
        """See :class:`Recording`."""
        numbered, interval = enumerate(self.timestamps.tolist()), selection.interval
        for index, _ in interval.select(numbered, lambda item: item[1], selection.stride, self.path):
            frame = self.frame(index, log, selection.reduction)
            if frame is None:
                file = self.images[index]
                (log.unreadable if exists(file) else log.missing).append(file.name)
            else:
                yield frame

    def frame(self, index: int, log: Log, reduction: Reduction | None = None) -> RawFrame | None:
        """One frame, in any order.

        Args:
            index: position in ``images``.
            log: receives depth and right images that cannot be read.
            reduction: of the image; None for none.

        Returns:
            The frame, or None if its image is corrupt.
        """
        file = self.images[index]
        decoded = decode(file, reduction, self.orientation)
        if decoded is None:
            return None
        if decoded.ndim == 3 and decoded.shape[2] == 4:
            self._look_through(decoded)
        image = converted(decoded, file, self.bits if decoded.dtype == np.uint16 else 16)
        depth = partial(self._depth, file, log) if self.sensors.depth else None
        right = partial(self._right, file, log) if self.sensors.right else None
        return RawFrame(index, float(self.timestamps[index]), image, str(file), depth, right)

    def _depth(self, image: Path, log: Log) -> np.ndarray | None:
        file = self.sensors.depth(image) if self.sensors.depth else None
        depth = read_depth(file, self.sensors.depth_scale) if file else None
        if file and depth is None:
            log.without.append(file.name)
        return depth

    def _right(self, image: Path, log: Log) -> np.ndarray | None:
        file = self.sensors.right(image) if self.sensors.right else None
        right = read_image(file, None, self.orientation, self.bits) if file else None
        if file and right is None:
            log.without.append(file.name)
        return right


def rows_of_images(images: list[Path], rows: int) -> np.ndarray | None:
    """Rows of a table (one row per frame of the full sequence) that belong to the images.

    Row i is image i if there are as many; of a sequence copied in part, the number in the file's name is the row.

    Args:
        images: files in order.
        rows: number of rows of the table.

    Returns:
        ``(len(images),)`` int, or None if neither holds.
    """
    if rows == len(images):
        return np.arange(rows)
    matches = [re.match(r"[0-9]+", image.stem) for image in images]
    numbers = [int(match.group()) if match else -1 for match in matches]  # of up to 255 digits
    return np.array(numbers) if numbers and all(0 <= number < rows for number in numbers) else None
