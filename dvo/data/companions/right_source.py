"""Right images of a stereo pair for any source: those of the data set, of a folder or list, or a second video."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig, rectified
from dvo.data.calibration.stereo import right_camera
from dvo.data.companions.companions import CompanionKind, CompanionRecording, companions_of_frames, companions_of_images
from dvo.data.images.images import read_image
from dvo.data.interval import Interval
from dvo.data.opening import locate
from dvo.data.readers.registry import find_reader
from dvo.data.readers.sequence import RIGHT_OF
from dvo.data.recording import ImageRecording, Log, RawFrame, Request
from dvo.data.sensors.sensors import Finder
from dvo.data.source import Source

T = TypeVar("T")

_KIND = CompanionKind("right images", "--right", "images")
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg"})
"""Endings of the names of videos."""


def with_right(source: Source, right: Path | str | None = None, baseline: float | None = None) -> Source:
    """Give the frames of a source the right images of a stereo pair.

    The right camera is that of the calibration file (:func:`dvo.data.calibration.stereo.right_camera`) or of the data
    set. Where neither states one, and with ``baseline``, the pair is taken for a rectified one: both cameras have the
    calibration of the source and parallel axes. Right images belong to the images as depth images do
    (:func:`dvo.data.companions.companions.companions_of_images`).

    Args:
        source: opened with :func:`dvo.open`, with a calibration; not changed.
        right: folder of images, a list of ``time file`` rows, or of a video another one with the same frames; looked up
            beside the source too. None for those of the data set, or a folder with the usual name beside its images
            (``image_1`` of ``image_0``).
        baseline: metres from the left to the right camera; None for that of the calibration.

    Returns:
        A source with the same frames, whose ``right`` is read when it is first wanted.

    Raises:
        DvoError: nothing there, a source without right images of its own, right images that belong to no image, no
            baseline, or a source without a calibration.

    Example:
        >>> source = with_right(dvo.open("clip/left", calib="calib.txt"), "clip/right", baseline=0.12)
        >>> result = dvo.run(dvo.load("small", scale={"stereo": True}), source).result
    """
    if baseline is not None and not 0 < baseline < float("inf"):
        raise DvoError(f"is {baseline:g}", field="--baseline", remedy="give the distance of the cameras, metres")
    if source.guess is not None:
        message = "a stereo pair needs the focal length, which was guessed"
        raise DvoError(message, file=source.path, field=_KIND.option, remedy="give a calibration with --calib")
    path = None if right is None else locate(right, source.path, "right")
    recording, found = source.recording, copy.copy(source)
    found.__dict__.pop("_rig", None)  # of the source, if it has been read
    if isinstance(recording, ImageRecording):
        own = recording.sensors
        finder = own.right if path is None else companions_of_images(path, recording, _KIND)
        finder = finder or _beside(source, recording)
        sensors = replace(own, right=finder, stereo=_rig(source, baseline))
        found.recording = copy.copy(recording)
        found.recording.sensors = sensors
        return found
    rig = _rig(source, baseline)
    if path is not None and path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
        found.recording = PairedRecording(recording, find_reader(path, None).open(path, Request()), rig)
    else:
        files = companions_of_frames(path, recording.frame_count, _KIND)
        found.recording = CompanionRecording(recording, _with_file, files, rig)
    return found


class PairedRecording:
    """Video whose right images are the frames of another one with the same numbers.

    Args:
        recording: of the left images.
        right: of the right images.
        stereo: see :class:`dvo.data.recording.Recording`.

    Raises:
        DvoError: they have different numbers of frames.
    """

    def __init__(self, recording: Any, right: Any, stereo: Callable[[], StereoRig]) -> None:
        counts = recording.frame_count, right.frame_count
        if None not in counts and counts[0] != counts[1]:
            message = f"{counts[1]} frames, the left video has {counts[0]}"
            raise DvoError(message, file=right.path, field=_KIND.option, remedy="give videos with the same frames")
        self._recording, self._right, self.stereo = recording, right, stereo

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of a copy that is not filled yet
            raise AttributeError(name)
        return getattr(self._recording, name)

    def frames(self, log: Log, stride: int = 1) -> Iterator[RawFrame]:
        """See :class:`dvo.data.recording.Recording`."""
        self._right.interval = getattr(self._recording, "interval", Interval())
        others = self._right.frames(Log(), stride)
        other: RawFrame | None = next(others, None)
        for raw in self._recording.frames(log, stride):
            while other is not None and other.index < raw.index:
                other = next(others, None)
            if other is not None and other.index == raw.index:
                raw = replace(raw, right=partial(_same, other.image))
            yield raw


def _beside(source: Source, recording: ImageRecording) -> Finder:
    """Rule for the folder with the usual name beside that of the images."""
    folder = recording.images[0].parent
    name = RIGHT_OF.get(folder.name)
    if name is None or not (folder.parent / name).is_dir():
        remedy = "give --right PATH: a folder of right images"
        raise DvoError("the source has no right images of its own", file=source.path, field=_KIND.option, remedy=remedy)
    return companions_of_images(folder.parent / name, recording, _KIND)


def _rig(source: Source, baseline: float | None) -> Callable[[], StereoRig]:
    """Loader of the right camera: by the baseline, the calibration of the user, the data set, its calibration file."""
    given, own = source.calibration, source.recording.calibration
    if baseline is None:
        name = source.recording.images[0].parent.name if isinstance(source.recording, ImageRecording) else ""
        found = None if given is None or given is own else right_camera(given, name)
        if found is None and source.recording.stereo is not None:
            found = source.recording.stereo()
        if found is None and own is not None:
            found = right_camera(own, name)
        if found is not None:
            return partial(_same, found)
        baseline = next((known.baseline for known in (given, own) if known is not None and known.baseline), None)
    if baseline is None:
        remedy = (
            "give the distance of the two cameras in metres, such as --baseline 0.12, or a --calib FILE that states it "
            "(KITTI's calib.txt, EuRoC's cam0/sensor.yaml, a camchain of Kalibr, or a YAML with baseline)"
        )
        file = (given.file if given is not None else None) or source.path
        raise DvoError("is not known from a calibration", file=file, field="--baseline", remedy=remedy)
    camera = source.recorded_camera
    fx, fy, cx, cy = camera.intrinsics.tolist()
    calibration = Calibration(fx, fy, cx, cy, camera.model, camera.coefficients, camera.width, camera.height)
    return rectified(calibration, baseline)


def _with_file(raw: RawFrame, file: Path, log: Log) -> RawFrame:
    """Frame of a video with the right image of a file."""
    return replace(raw, right=partial(_read, file, log))


def _read(file: Path, log: Log) -> np.ndarray | None:
    image = read_image(file)
    if image is None:
        log.without.append(file.name)
    return image


def _same(found: T) -> T:
    return found
