"""Source: any video, folder of images or sequence of a data set as an iterable of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.focal_guess import FocalGuess
from dvo.data.frame import Frame, InertialSamples, StereoView
from dvo.data.images.reduction import Reduction
from dvo.data.interval import expected_frames
from dvo.data.mask import Masks
from dvo.data.recording import ImageRecording, Log, RawFrame, Recording
from dvo.data.sensors.depth import registered_depth, resized_depth
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.geometry.field_of_view import notice_of_cut
from dvo.geometry.undistort import Undistorter, needs_undistortion


class Source:
    """Frames of one recording, to be iterated any number of times. Made by :func:`dvo.data.open.open_source`.

    Depth, right images and inertial samples, where the recording has them, are read when a frame's field is first read.

    Attributes:
        recording: as its reader found it, before cameras and undistortion.
        name: of the sequence.
        kind: name of the reader, see :data:`dvo.data.readers.registry.READERS`.
        path: file or folder that was opened.
        camera: the camera of every frame (without distortion if frames are undistorted, reduced if they are).
        recorded_camera: the camera as calibrated, distortion included.
        reduction: of the recorded images; None for none.
        calibration: of the recorded images, as read; None for a stream.
        masks: of the recorded images; None for none.
        guess: of the focal length, for a source without a calibration that was opened with one; None otherwise.
        depth_calibration: of depth images that are not registered to the images; None for others.
        turned: degrees clockwise by which frames are turned to stand upright, as a video or EXIF data ask for.
        stride: every how many-th frame is read.
        frame_count: frames to expect, the stride taken into account; None if a video does not say. A video's header may
            promise more than can be read.
        groundtruth: camera-to-world poses of the camera that is read, or None. World frame and scale are the dataset's.
    """

    def __init__(
        self,
        recording: Recording,
        recorded_camera: Camera,
        groundtruth: Trajectory | None,
        stride: int,
        undistort: bool,
        doubts: list[str],
    ) -> None:
        self.recording = recording
        self._log = Log()
        self.name, self.kind, self.path = recording.name, recording.kind, recording.path
        self.recorded_camera, self.groundtruth, self.stride = recorded_camera, groundtruth, stride
        self._undistort = undistort
        self.reduction: Reduction | None = getattr(recording, "reduction", None)
        read = recorded_camera if self.reduction is None else self.reduction.camera(recorded_camera)
        self._undistorter = Undistorter(read) if undistort and needs_undistortion(read) else None
        self._right_undistorter: Undistorter | None = None  # the size of right images is not known before the first
        self.camera = self._undistorter.camera if self._undistorter else read
        self._cut = notice_of_cut(read, self.camera) if self._undistorter else []
        count = expected_frames(recording)
        self.frame_count: int | None = None if count is None else -(-count // stride)
        self._doubts = doubts
        self.calibration: Calibration | None = None
        self.guess: FocalGuess | None = None
        self.masks: Masks | None = None
        self.depth_calibration: Calibration | None = None
        self.turned: int = getattr(recording, "turned", 0)

    def recalibrated(self, calibration: Calibration) -> Source:
        """The same recording with another calibration.

        Args:
            calibration: of the images as recorded.

        Raises:
            DvoError: intrinsics that do not fit the images.
        """
        camera = calibration.camera(self.recorded_camera.width, self.recorded_camera.height)
        found = Source(self.recording, camera, self.groundtruth, self.stride, self._undistort, self._doubts)
        found.calibration, found.masks = calibration, self.masks
        found.depth_calibration = self.depth_calibration
        return found

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
        return [*self.recording.warnings, *self._doubts, *self._cut, *self._log.messages()]

    @property
    def skipped(self) -> int:
        """Number of images that could not be decoded on the last pass so far."""
        return len(self._log.unreadable)

    @property
    def timestamps(self) -> np.ndarray | None:
        """Seconds, one for every image of the recording whatever the stride; None for a video."""
        recording = self.recording
        return recording.timestamps if isinstance(recording, ImageRecording) else None

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
        frames = []
        for index in indices:
            raw = recording.frame(index, self._log)
            if raw is None:
                raise DvoError("cannot be decoded", file=recording.images[index], remedy="remove or replace the image")
            frames.append((self._frame(raw, None), recording.images[index]))
        return frames

    def __iter__(self) -> Iterator[Frame]:
        """Frames with strictly increasing timestamps.

        Raises:
            DvoError: an image of another size than the first, naming it.
        """
        self._log = log = Log()
        previous = float("inf")
        for raw in self.recording.frames(log, self.stride):
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

    def _frame(self, raw: RawFrame, previous: float | None) -> Frame:
        """Frame of a recorded image; ``previous``: time after which its inertial samples begin, None for none."""
        image = self._undistorter(raw.image) if self._undistorter else raw.image
        depth = partial(self._depth, raw.depth, raw.origin) if raw.depth else None
        right = partial(self._right, raw.right) if raw.right else None
        inertial = None
        if previous is not None and self.recording.inertial is not None:
            inertial = partial(self._inertial, previous, raw.timestamp)
        mask = self.masks(raw.index, self._undistorter) if self.masks else None
        return Frame(raw.index, raw.timestamp, image, self.camera, depth, right, inertial, mask)

    def _depth(self, load: Callable[[], np.ndarray | None], origin: str) -> np.ndarray | None:
        depth = load()
        if depth is None:
            return None
        if self.depth_calibration is not None:
            return registered_depth(depth, self.depth_calibration, self.camera)
        depth = resized_depth(depth, (self.camera.width, self.camera.height), origin)
        return self._undistorter.depth(depth) if self._undistorter else depth

    @cached_property
    def _rig(self) -> StereoRig | None:
        return self.recording.stereo() if self.recording.stereo else None

    def _right(self, load: Callable[[], np.ndarray | None]) -> StereoView | None:
        rig = self._rig
        image = load() if rig is not None else None
        if rig is None or image is None:
            return None
        camera = rig.calibration.camera(image.shape[1], image.shape[0])
        if self.reduction is not None and image.shape[1::-1] == self.reduction.recorded:
            image, camera = self.reduction(image), self.reduction.camera(camera)
        if self._undistort and needs_undistortion(camera):
            if self._right_undistorter is None or self._right_undistorter.source != camera:
                self._right_undistorter = Undistorter(camera)
            image, camera = self._right_undistorter(image), self._right_undistorter.camera
        return StereoView(image, camera, rig.T_left_right)

    @cached_property
    def _samples(self) -> InertialSamples | None:
        return self.recording.inertial() if self.recording.inertial else None

    def _inertial(self, previous: float, timestamp: float) -> InertialSamples | None:
        return None if self._samples is None else self._samples.between(previous, timestamp)
