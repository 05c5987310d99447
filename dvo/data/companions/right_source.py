"""Right images of a stereo pair for any source: those of the data set, of a folder or list, or a second video."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeGuard, TypeVar

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig, rectified
from dvo.data.calibration.stereo import right_camera
from dvo.data.companions.bag_topics import CompanionTopic, rig_of_bag, topic_of
from dvo.data.companions.companions import (
    CompanionFiles,
    CompanionKind,
    companions_of_images,
    files_of_frames,
    of_positions,
)
from dvo.data.images.images import read_image
from dvo.data.opening import locate
from dvo.data.readers.registry import find_reader
from dvo.data.readers.ros_images import decode_message
from dvo.data.readers.rosbag import BagRecording
from dvo.data.readers.sequence import RIGHT_OF
from dvo.data.recording import ImageRecording, Log, RawFrame, Recording, Request, Selection
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
        right: of a bag the topic; folder of images, a list of ``time file`` rows, or of a video another one with the
        same frames; looked up
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
    recording, stages = source.recording, source.reading.stages
    if isinstance(recording, BagRecording) and (right is None or not Path(right).exists()):
        topic = topic_of(recording, None if right is None else str(right), "right")
        stages = (*stages, CompanionTopic(recording, topic, "right", decode_message))
        own = rig_of_bag(recording, topic) if baseline is None and source.calibration is recording.calibration else None
        rig = _rig(source, baseline) if own is None else partial(_same, own)
        return source.changed(stages=stages, rig=rig)
    path = None if right is None else locate(right, source.path, "right")
    orientation = recording.orientation if isinstance(recording, ImageRecording) else 1
    bits = recording.bits if isinstance(recording, ImageRecording) else 16
    read = partial(read_image, reduction=None, orientation=orientation, bits=bits)
    if not isinstance(recording, ImageRecording) and is_video(path):
        stages = (*stages, CompanionVideo.of(recording, path))
    elif isinstance(recording, ImageRecording) and path is None and recording.sensors.right is None:
        stages = (*stages, CompanionFiles("right", of_positions(_beside(source, recording), recording), read))
    elif path is not None or not isinstance(recording, ImageRecording):
        stages = (*stages, CompanionFiles("right", files_of_frames(path, recording, _KIND), read))
    return source.changed(stages=stages, rig=_rig(source, baseline))


def is_video(path: Path | None) -> TypeGuard[Path]:
    """True for a file with the name of a video.

    Args:
        path: None for none.
    """
    return path is not None and path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


@dataclass(frozen=True)
class CompanionVideo:
    """Stage that adds the frames of another video with the same numbers as right images.

    Attributes:
        recording: of the right images.
    """

    recording: Recording

    @classmethod
    def of(cls, left: Recording, path: Path) -> CompanionVideo:
        """Open the video of the right images.

        Args:
            left: recording of the left images.
            path: of the video.

        Raises:
            DvoError: they have different numbers of frames.
        """
        right = find_reader(path, None).open(path, Request())
        counts = left.frame_count, right.frame_count
        if None not in counts and counts[0] != counts[1]:
            message = f"{counts[1]} frames, the left video has {counts[0]}"
            raise DvoError(message, file=path, field=_KIND.option, remedy="give videos with the same frames")
        return cls(right)

    def __call__(self, frames: Iterator[RawFrame], log: Log, selection: Selection) -> Iterator[RawFrame]:
        """See :class:`dvo.data.source.Stage`."""
        others = self.recording.frames(Log(), replace(selection, reduction=None))
        other: RawFrame | None = next(others, None)
        for raw in frames:
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
        if found is None and own is not None and not isinstance(source.recording, BagRecording):
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


def _same(found: T) -> T:
    return found
