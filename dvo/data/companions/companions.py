"""Files of another sensor for the images of any source: those of a folder, or of a list with times."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.listing import listed_files
from dvo.data.files.stamps import times_from_names
from dvo.data.images.images import list_images, natural_key
from dvo.data.recording import ImageRecording, Log, RawFrame, Recording, Selection
from dvo.data.sensors.sensors import Finder, Listed, NearestInTime, numbers_of


@dataclass(frozen=True)
class CompanionKind:
    """Kind of files that belong to images.

    Attributes:
        noun: for messages, in the plural, such as ``depth images``.
        option: of the command line that names them, for messages.
        form: of the files of a folder, for messages.
        arrays: suffixes of files that are no images.
    """

    noun: str
    option: str
    form: str
    arrays: tuple[str, ...] = ()


@dataclass(frozen=True)
class CompanionFiles:
    """Stage that adds the images of another sensor to frames; they are read when they are first wanted.

    Attributes:
        field: of the frame that they are for, ``depth`` or ``right``.
        file: of a frame, from its position in the recording; None for none.
        read: image of a file; None if it cannot be decoded.
    """

    field: Literal["depth", "right"]
    file: Callable[[int], Path | None]
    read: Callable[[Path], np.ndarray | None]

    def __call__(self, frames: Iterator[RawFrame], log: Log, selection: Selection) -> Iterator[RawFrame]:
        """See :class:`dvo.data.source.Stage`."""
        for raw in frames:
            load = partial(self._load, raw.index, log)
            yield replace(raw, depth=load) if self.field == "depth" else replace(raw, right=load)

    def _load(self, index: int, log: Log) -> np.ndarray | None:
        file = self.file(index)
        image = None if file is None else self.read(file)
        if file is not None and image is None:
            log.without.append(file.name)
        return image


def files_of_frames(path: Path | None, recording: Recording, kind: CompanionKind) -> Callable[[int], Path | None]:
    """Rule by which files belong to the frames of a recording.

    Args:
        path: existing folder, or for images a list of ``time file`` rows; None is refused.
        recording: images (:func:`companions_of_images`), or another one, whose frames have files of a folder in order.
        kind: of the files.

    Returns:
        Function from the position of a frame to its file.

    Raises:
        DvoError: no files, or files that belong to no frame.
    """
    if isinstance(recording, ImageRecording) and path is not None:
        return of_positions(companions_of_images(path, recording, kind), recording)
    files = companions_of_frames(path, recording.frame_count, kind)
    return lambda index: files[index] if index < len(files) else None


def of_positions(finder: Finder, recording: ImageRecording) -> Callable[[int], Path | None]:
    """Rule for the positions of images.

    Args:
        finder: rule for their files.
        recording: of the images.
    """
    return lambda index: finder(recording.images[index])


def companions_of_images(path: Path, recording: ImageRecording, kind: CompanionKind) -> Finder:
    """Rule by which the files of a folder or a list belong to images.

    A file belongs to the image with the nearest time stamp, up to half a frame interval, if it has one (in a list, or
    as its name) and the images have times that are on the same clock; otherwise to the image whose name holds the same
    numbers; otherwise, where there are as many files as images, to that of the same place in the order.

    Args:
        path: existing folder, or list of ``time file`` rows.
        recording: of the images.
        kind: of the files.

    Returns:
        Function from an image to its file.

    Raises:
        DvoError: no files, or files that belong to no image.
    """
    return _listed(path, recording, kind) if path.is_file() else _of_folder(path, recording, kind)


def companions_of_frames(path: Path | None, frames: int | None, kind: CompanionKind) -> list[Path]:
    """Files of a folder for the frames of a video, in order.

    Args:
        path: existing folder; None is refused.
        frames: number of them, None if it is not known.
        kind: of the files.

    Raises:
        DvoError: no folder, or another number of files.
    """
    if path is None or not path.is_dir():
        message = f"a video has no {kind.noun.split()[0]} of its own, nor the times of a list"
        remedy = f"give {kind.option} FOLDER, with a {kind.noun.removesuffix('s')} for each frame"
        raise DvoError(message, field=kind.option, remedy=remedy)
    files = _files(path, kind)
    if frames is not None and frames != len(files):
        raise _mismatch(path, len(files), f"{frames} frames", kind)
    return files


def _files(folder: Path, kind: CompanionKind, others: Collection[Path] = ()) -> list[Path]:
    """Files of a folder in natural order, without ``others``: a folder may hold two streams."""
    files = [file for file in list_images(folder) if file not in others] or sorted(
        (file for file in folder.iterdir() if file.suffix in kind.arrays), key=lambda file: natural_key(file.name)
    )
    if not files:
        remedy = f"give a folder of {kind.form}"
        raise DvoError(f"no {kind.noun} in it", file=folder, field=kind.option, remedy=remedy)
    return files


def _of_folder(folder: Path, recording: ImageRecording, kind: CompanionKind) -> Finder:
    images = recording.images
    files = _files(folder, kind, set(images))
    stamps = times_from_names(files)
    if stamps is not None:
        nearest = _nearest(files, stamps, recording)
        if any(nearest(image) for image in images):
            return nearest
    by_numbers = {numbers_of(file): file for file in files}
    named = {image: by_numbers[numbers_of(image)] for image in images if numbers_of(image) in by_numbers}
    if len(named) == len(files):
        return Listed(named)
    if len(files) == len(images):
        return Listed(dict(zip(images, files, strict=True)))
    raise _mismatch(folder, len(files), f"{len(images)} images", kind)


def _listed(listing: Path, recording: ImageRecording, kind: CompanionKind) -> Finder:
    """Nearest in time of the files of a list of ``time file`` rows."""
    files, stamps = listed_files(listing, kind.noun)
    nearest = _nearest(files, stamps, recording)
    if not files or not any(nearest(image) for image in recording.images):
        message = f"no {kind.noun.removesuffix('s')} is at the time of an image"
        remedy = f"give the times of the images on the clock of the {kind.noun} (--times)"
        raise DvoError(message, file=listing, field=kind.option, remedy=remedy)
    return nearest


def _nearest(files: list[Path], stamps: np.ndarray, recording: ImageRecording) -> NearestInTime:
    order = np.argsort(stamps, kind="stable")
    listed = [files[k] for k in order], stamps[order]
    times = recording.timestamps
    reach = float(np.median(np.diff(times))) / 2 if len(times) > 1 else 0.02
    return NearestInTime(dict(zip(recording.images, times.tolist(), strict=True)), lambda: listed, reach)


def _mismatch(folder: Path, count: int, images: str, kind: CompanionKind) -> DvoError:
    message = f"{count} {kind.noun} for {images}, and neither times nor numbers in their names tell which belongs to "
    remedy = f"give as many {kind.noun} as images, or a list of rows 'time file'"
    return DvoError(message + "which", file=folder, field=kind.option, remedy=remedy)
