"""Depth images for any source: those of a folder, or of a list with times."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.calibration import Calibration, read_calibration
from dvo.data.depth import read_depth
from dvo.data.files import listed_files
from dvo.data.images import list_images
from dvo.data.opening import locate
from dvo.data.recording import ImageRecording, Log, RawFrame
from dvo.data.sensors import Finder, NearestInTime, SameNumbers
from dvo.data.source import Source
from dvo.data.stamps import times_from_names
from dvo.data.tum import DEPTH_SCALE
from dvo.errors import DvoError

MILLIMETRES = 1000.0
"""Units of a metre in 16-bit depth images of a folder, unless it is a list in the layout of TUM RGB-D."""
_ARRAYS = (".npy", ".npz")
_FIELD = "--depth"


def with_depth(
    source: Source,
    depth: Path | str | None = None,
    scale: float | None = None,
    calib: Path | str | Calibration | None = None,
) -> Source:
    """Give the frames of a source depth.

    A depth image belongs to the image with the nearest time stamp, up to half a frame interval, if it has one (in a
    list, or as its name) and the images have times that are on the same clock; otherwise to the image whose name holds
    the same numbers; otherwise, where there are as many depth images as images, to that of the same place in the order.
    Depth is registered to the images, or of another size and the same aspect; or ``calib`` says of which camera it is.

    Args:
        source: opened with :func:`dvo.open`; not changed.
        depth: folder of 16-bit PNG files (or other files of :func:`dvo.data.depth.read_depth`), or a list of ``time
            file`` rows such as ``depth.txt`` of TUM RGB-D; None for the depth that the data set has itself. Relative
            paths are looked up from the working directory, then from the source's folder.
        scale: units of a metre in integers; None for that of the data set, of a list 5000, of a folder 1000.
        calib: camera of the depth images, without distortion, whose centre and axes are taken for those of the camera;
            None for registered ones.

    Returns:
        A source with the same frames, whose ``depth`` is read when it is first wanted.

    Raises:
        DvoError: nothing there, a source without depth of its own, or depth images that belong to no image.

    Example:
        >>> source = with_depth(dvo.open("video.mp4", calib="calib.txt"), "depth", scale=1000)
        >>> result = dvo.run(dvo.load("small", scale={"depth": True}), source).result
    """
    if scale is not None and not 0 < scale < float("inf"):
        raise DvoError(f"is {scale}", field="--depth-scale", remedy="give the units of a metre, such as 1000")
    found, recording = copy.copy(source), source.recording
    if calib is not None:
        if not isinstance(calib, Calibration):
            calib = read_calibration(locate(calib, source.path, "depth-calib"))
        found.depth_calibration = calib
    if not isinstance(recording, ImageRecording):
        found.recording = _with_files(source, depth, scale or MILLIMETRES)
        return found
    own = recording.sensors
    if depth is None and own.depth is None:
        remedy = "give --depth PATH: a folder of 16-bit PNG files, or a list such as depth.txt"
        raise DvoError("the source has no depth of its own", file=source.path, field=_FIELD, remedy=remedy)
    sensors = replace(own, depth_scale=scale or own.depth_scale)
    if depth is not None:
        path = locate(depth, source.path, "depth")
        finder = _listed_finder(path, recording) if path.is_file() else _finder(path, recording)
        sensors = replace(own, depth=finder, depth_scale=scale or (DEPTH_SCALE if path.is_file() else MILLIMETRES))
    changed = copy.copy(recording)
    changed.sensors = sensors
    found.recording = changed
    return found


class DepthRecording:
    """Video with depth images in the order of its frames; everything else is that of another recording.

    Args:
        recording: of the images.
        files: depth image of each frame.
        scale: units of a metre.
    """

    def __init__(self, recording: Any, files: list[Path], scale: float) -> None:
        self._recording, self._files, self._scale = recording, files, scale

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of a copy that is not filled yet
            raise AttributeError(name)
        return getattr(self._recording, name)

    def frames(self, log: Log, stride: int = 1) -> Iterator[RawFrame]:
        """See :class:`dvo.data.recording.Recording`."""
        for raw in self._recording.frames(log, stride):
            there = raw.index < len(self._files)
            yield replace(raw, depth=partial(self._depth, self._files[raw.index], log)) if there else raw

    def _depth(self, file: Path, log: Log) -> np.ndarray | None:
        depth = read_depth(file, self._scale)
        if depth is None:
            log.without.append(file.name)
        return depth


@dataclass(frozen=True)
class _InOrder:
    """File of the same place in the order."""

    files: dict[Path, Path]

    def __call__(self, image: Path) -> Path | None:
        return self.files.get(image)


def _files(folder: Path) -> list[Path]:
    files = list_images(folder) or sorted(file for file in folder.iterdir() if file.suffix in _ARRAYS)
    if not files:
        raise DvoError("no depth images in it", file=folder, field=_FIELD, remedy="give a folder of 16-bit PNG files")
    return files


def _with_files(source: Source, depth: Path | str | None, scale: float) -> DepthRecording:
    """Recording of a video with the files of a folder, as many as it has frames."""
    folder = None if depth is None else locate(depth, source.path, "depth")
    if folder is None or not folder.is_dir():
        remedy = "give --depth FOLDER, with a depth image for each frame"
        raise DvoError("a video has no depth of its own, nor the times of a list", field=_FIELD, remedy=remedy)
    files, count = _files(folder), source.recording.frame_count
    if count is not None and count != len(files):
        raise _mismatch(folder, len(files), f"{count} frames")
    return DepthRecording(source.recording, files, scale)


def _finder(folder: Path, recording: ImageRecording) -> Finder:
    """Rule by which the files of a folder belong to images."""
    files, images = _files(folder), recording.images
    stamps = times_from_names(files)
    if stamps is not None:
        nearest = _nearest(files, stamps, recording)
        if any(nearest(image) for image in images):
            return nearest
    names = SameNumbers(folder)
    if files[0].suffix not in _ARRAYS and sum(names(image) is not None for image in images) == len(files):
        return names
    if len(files) == len(images):
        return _InOrder(dict(zip(images, files, strict=True)))
    raise _mismatch(folder, len(files), f"{len(images)} images")


def _listed_finder(listing: Path, recording: ImageRecording) -> Finder:
    """Nearest in time of the files of a list of ``time file`` rows."""
    files, stamps = listed_files(listing, "depth images")
    nearest = _nearest(files, stamps, recording)
    if not files or not any(nearest(image) for image in recording.images):
        remedy = "give the times of the images on the clock of the depth images (--times)"
        raise DvoError("no depth image is at the time of an image", file=listing, field=_FIELD, remedy=remedy)
    return nearest


def _nearest(files: list[Path], stamps: np.ndarray, recording: ImageRecording) -> NearestInTime:
    order = np.argsort(stamps, kind="stable")
    listed = [files[k] for k in order], stamps[order]
    times = recording.timestamps
    reach = float(np.median(np.diff(times))) / 2 if len(times) > 1 else 0.02
    return NearestInTime(dict(zip(recording.images, times.tolist(), strict=True)), lambda: listed, reach)


def _mismatch(folder: Path, count: int, images: str) -> DvoError:
    message = f"{count} depth images for {images}, and neither times nor numbers in their names tell which belongs to "
    remedy = "give as many depth images as images, or a list 'time file' such as depth.txt"
    return DvoError(message + "which", file=folder, field=_FIELD, remedy=remedy)
