"""Source: any video, folder of images or sequence of a data set as an iterable of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import in_utf8
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.focal_guess import FocalGuess
from dvo.data.frame import Frame, StereoView
from dvo.data.inertial import InertialSamples
from dvo.data.interval import expected_frames
from dvo.data.mask import Masks
from dvo.data.positions import Positions
from dvo.data.recording import EVERYTHING, ImageRecording, Log, RawFrame, Recording, Selection
from dvo.data.sensors.depth import registered_depth, resized_depth
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.geometry.field_of_view import notice_of_cut
from dvo.geometry.undistort import Undistorter


class Stage(Protocol):
    """Step between a recording and the frames of a source, such as the files of another sensor; a frozen object."""

    def __call__(self, frames: Iterator[RawFrame], log: Log, selection: Selection) -> Iterator[RawFrame]:
        """Change frames.

        Args:
            frames: of the recording, or of the stage before.
            log: receives what could not be read.
            selection: of the recording that is read.

        Yields:
            The same frames, with more in them.
        """
        ...


@dataclass(frozen=True)
class Reading:
    """How frames are made of a recording: what is read, the stages that follow, and cameras and masks.

    Attributes:
        recorded_camera: of the images as recorded.
        selection: of the recording.
        stages: that follow, in order.
        calibration: of the recorded images, as read; None for a stream.
        guess: of the focal length; None for a calibration.
        given: the calibration was, or the source brings it; False for one that was found in images, these or others
            (:attr:`dvo.data.calibration.calibration.Calibration.was_found`).
        masks: of the recorded images; None for none.
        depth_calibration: of depth images that are not registered to the images; None for others.
        groundtruth: camera-to-world poses; None for none.
        undistort: resample images, depth, masks and right images to pinhole cameras.
        doubts: guesses at opening, in sentences for the user.
        rig: reads the calibration of the right camera; None for that of the recording.
        inertial: reads the inertial samples that frames carry, times on the clock of the frames; None for none.
    """

    recorded_camera: Camera
    selection: Selection = EVERYTHING
    stages: tuple[Stage, ...] = ()
    calibration: Calibration | None = None
    guess: FocalGuess | None = None
    given: bool = True
    masks: Masks | None = None
    depth_calibration: Calibration | None = None
    groundtruth: Trajectory | None = None
    undistort: bool = True
    doubts: tuple[str, ...] = ()
    rig: Callable[[], StereoRig | None] | None = None
    inertial: Callable[[], InertialSamples] | None = None


class Source:
    """Frames of one recording, to be iterated any number of times. Made by :func:`dvo.data.open.open_source`.

    Depth, right images and inertial samples, where the recording has them, are read when a frame's field is first read.

    Args:
        recording: as its reader found it.
        reading: how frames are made of it.

    Attributes:
        recording, reading: the same.
        name: of the sequence.
        kind: name of the reader, see :data:`dvo.data.readers.registry.READERS`.
        path: file or folder that was opened.
        camera: the camera of every frame (without distortion if frames are undistorted, reduced if they are).
        recorded_camera: the camera as calibrated, distortion included.
        reduction: of the recorded images; None for none.
        calibration: of the recorded images, as read; None for a stream.
        masks: of the recorded images; None for none.
        guess: of the focal length, for a source without a calibration that was opened with one, as long as nothing
            better is known; None otherwise.
        calibrated: a calibration was given, or the source brings one; False with a guess, or one that was found in
            images (:meth:`recalibrated`, or the file that a run without a calibration has written).
        turned: degrees clockwise by which frames are turned to stand upright, as a video or EXIF data ask for.
        stride: every how many-th frame is read.
        frame_count: frames to expect, the stride taken into account; None if a video does not say. A video's header may
            promise more than can be read.
        groundtruth: camera-to-world poses of the camera that is read, or None. World frame and scale are the dataset's.

    Raises:
        DvoError: no frame in the interval.
    """

    def __init__(self, recording: Recording, reading: Reading) -> None:
        self.recording, self.reading = recording, reading
        self._log = Log()
        self.name = in_utf8(recording.name)
        self.kind, self.path, self.turned = recording.kind, recording.path, recording.turned
        self.recorded_camera, self.groundtruth = reading.recorded_camera, reading.groundtruth
        self.calibration, self.guess, self.masks = reading.calibration, reading.guess, reading.masks
        self.calibrated = reading.given and reading.guess is None
        self.stride, self.reduction = reading.selection.stride, reading.selection.reduction
        read = self.recorded_camera if self.reduction is None else self.reduction.camera(self.recorded_camera)
        self._undistorter = Undistorter(read) if reading.undistort and read.needs_undistortion else None
        self._right_undistorter: Undistorter | None = None  # the size of right images is not known before the first
        self.camera = self._undistorter.camera if self._undistorter else read
        self._cut = notice_of_cut(read, self.camera) if self._undistorter else []
        interval = reading.selection.interval
        count = expected_frames(interval, recording.frame_count, recording.timestamps, recording.path)
        self.frame_count: int | None = None if count is None else -(-count // self.stride)

    def changed(self, **changes: Any) -> Self:
        """The same recording, read in another way.

        Args:
            changes: of the attributes of :class:`Reading`.
        """
        return type(self)(self.recording, replace(self.reading, **changes))

    def recalibrated(self, calibration: Calibration, guess: FocalGuess | None = None) -> Self:
        """The same recording with a calibration that was found in its images; the verdict takes note.

        Args:
            calibration: of the images as recorded.
            guess: that its focal length still is, where the images do not tell it.

        Raises:
            DvoError: intrinsics that do not fit the images.
        """
        camera = calibration.camera(self.recorded_camera.width, self.recorded_camera.height)
        return self.changed(recorded_camera=camera, calibration=calibration, guess=guess, given=False)

    def at_recorded_size(self) -> Self:
        """The same recording, its images not reduced."""
        if self.reduction is None:
            return self
        masks = None if self.masks is None else self.masks.at_recorded_size()
        return self.changed(selection=replace(self.reading.selection, reduction=None), masks=masks)

    def __repr__(self) -> str:
        count = "?" if self.frame_count is None else self.frame_count
        size = f"{self.recorded_camera.width}x{self.recorded_camera.height}"
        return f"Source({self.name!r}, {self.kind}, {count} frames of {size})"

    def __len__(self) -> int:
        """``frame_count``.

        Raises:
            TypeError: the number is not known.
        """
        if self.frame_count is None:
            raise TypeError("the number of frames is not known before they are read")
        return self.frame_count

    @property
    def warnings(self) -> list[str]:
        """Guesses at opening and faults of the last pass so far, in sentences for the user."""
        return [*self.recording.warnings, *self.reading.doubts, *self._cut, *self._log.messages()]

    @property
    def skipped(self) -> int:
        """Number of images that could not be decoded, or were not there, on the last pass so far."""
        return len(self._log.unreadable) + len(self._log.missing)

    @property
    def timestamps(self) -> np.ndarray | None:
        """Seconds, one for every image of the recording whatever the stride; None for a video."""
        return self.recording.timestamps

    def frames_at(self, indices: Sequence[int]) -> list[tuple[Frame, Path]]:
        """Read single frames of a recording that is made of image files.

        Args:
            indices: positions in the recording, in any order.

        Returns:
            The frames, without inertial samples (there is no frame before), and the files of their images.

        Raises:
            DvoError: a video, or an image that cannot be read.
        """
        recording = self.recording
        if not isinstance(recording, ImageRecording):
            raise DvoError("a video is read in order only", file=self.path, remedy="extract its frames into a folder")
        frames: list[tuple[Frame, Path]] = []
        for index in indices:
            raw = recording.frame(index, self._log, self.reduction)
            if raw is None:
                raise DvoError("cannot be decoded", file=recording.images[index], remedy="remove or replace the image")
            frames.extend((self._frame(whole, None), recording.images[index]) for whole in self._staged(iter([raw])))
        return frames

    def __iter__(self) -> Iterator[Frame]:
        """Frames with strictly increasing timestamps.

        Raises:
            DvoError: an image of another size than the first, naming it.
        """
        self._log = log = Log()
        previous = float("inf")
        for raw in self._staged(self.recording.frames(log, self.reading.selection)):
            height, width = raw.image.shape[:2]
            if (width, height) != (self.camera.width, self.camera.height):
                raise DvoError(
                    f"this image is {width}x{height}, those before are "
                    f"{self.recorded_camera.width}x{self.recorded_camera.height}",
                    file=raw.origin,
                    remedy="give images of one size",
                )
            yield self._frame(raw, previous)
            previous = raw.timestamp

    def _staged(self, frames: Iterator[RawFrame]) -> Iterator[RawFrame]:
        """Frames after all stages."""
        for stage in self.reading.stages:
            frames = stage(frames, self._log, self.reading.selection)
        return frames

    def _frame(self, raw: RawFrame, previous: float | None) -> Frame:
        """Frame of a recorded image; ``previous``: time after which its inertial samples begin, None for none."""
        image = self._undistorter(raw.image) if self._undistorter else raw.image
        depth = partial(self._depth, raw.depth, raw.origin) if raw.depth else None
        right = partial(self._right, raw.right) if raw.right else None
        inertial = None
        if previous is not None and self.reading.inertial is not None:
            inertial = partial(self._inertial, previous, raw.timestamp)
        mask = self.masks(raw.index, self._undistorter) if self.masks else None
        return Frame(raw.index, raw.timestamp, image, self.camera, depth, right, inertial, mask, silence=raw.silence)

    def _depth(self, load: Callable[[], np.ndarray | None], origin: str) -> np.ndarray | None:
        depth = load()
        if depth is None:
            return None
        if self.reading.depth_calibration is not None:
            return registered_depth(depth, self.reading.depth_calibration, self.camera)
        depth = resized_depth(depth, (self.camera.width, self.camera.height), origin)
        return self._undistorter.depth(depth) if self._undistorter else depth

    @cached_property
    def _rig(self) -> StereoRig | None:
        read = self.reading.rig or self.recording.stereo
        return None if read is None else read()

    def _right(self, load: Callable[[], np.ndarray | None]) -> StereoView | None:
        rig = self._rig
        image = load() if rig is not None else None
        if rig is None or image is None:
            return None
        try:
            camera = rig.calibration.camera(image.shape[1], image.shape[0])
        except DvoError as error:
            raise DvoError(f"of the right images: {error.message}", file=error.file, field=error.field,
                           remedy=error.remedy) from None  # fmt: skip
        if self.reduction is not None and image.shape[1::-1] == self.reduction.recorded:
            image, camera = self.reduction(image), self.reduction.camera(camera)
        if self.reading.undistort and camera.needs_undistortion:
            if self._right_undistorter is None or self._right_undistorter.source != camera:
                self._right_undistorter = Undistorter(camera)
            image, camera = self._right_undistorter(image), self._right_undistorter.camera
        return StereoView(image, camera, rig.T_left_right)

    @cached_property
    def inertial(self) -> InertialSamples | None:
        """All inertial samples, times on the clock of the frames, read when they are first wanted; None for none.

        Raises:
            DvoError: damaged samples.
        """
        return self.reading.inertial() if self.reading.inertial else None

    @cached_property
    def positions(self) -> Positions | None:
        """Positions of a satellite receiver, read when they are first wanted; None for none. Poses do not use them.

        Raises:
            DvoError: damaged positions.
        """
        return self.recording.positions() if self.recording.positions else None

    def _inertial(self, previous: float, timestamp: float) -> InertialSamples | None:
        return None if self.inertial is None else self.inertial.between(previous, timestamp)
