"""Stream: images that come one after the other and only once, from a live camera, a socket or a generator."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterable, Iterator
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.data.files.stamps import checked_rate
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_image
from dvo.data.streams.live import NOTHING, LiveFrames
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import Undistorter

Item = np.ndarray | tuple[float, np.ndarray] | Frame
"""One element of a stream: an image, a time in seconds with an image, or a frame."""

_RUN = 3  # images in a row that are late, each later than the one before it: the clock was set back
_RECENT = 30  # intervals that the usual one is the median of


class FrameStream:
    """Frames that can be iterated once, otherwise used as a :class:`dvo.data.source.Source`. Made by :func:`stream`.

    Attributes:
        name: for the results folder.
        kind: ``"stream"``.
        frame_count: None, the number is not known.
        groundtruth: camera-to-world poses, or None.
        warnings: faults so far, a sentence each.
    """

    kind = "stream"
    frame_count: int | None = None

    def __init__(self, frames: Iterator[Frame], name: str, groundtruth: Trajectory | None = None) -> None:
        self.name, self.groundtruth = name, groundtruth
        self._frames: Iterator[Frame] | None = frames
        self._late = self._first_late = 0
        self._set_back: list[int] = []  # first images after the clock was set back

    @property
    def warnings(self) -> list[str]:
        """Faults so far, a sentence each."""
        found = []
        if self._late:
            first = f"the first is {self._first_late}"
            found.append(f"{self._late} images were not later than the one before and were dropped, {first}")
        if self._set_back:
            times = f"{len(self._set_back)} times, first " if len(self._set_back) > 1 else ""
            found.append(f"the clock was set back {times}before image {self._set_back[0]}")
        return found

    def __iter__(self) -> Iterator[Frame]:
        """Frames with strictly increasing timestamps; those that are not later than the one before are dropped.

        Three in a row that are late, each later than the one before it, show that the clock was set back: times go on
        from there, the usual interval after the last one, with an :attr:`dvo.data.frame.Frame.interruption`.

        Raises:
            DvoError: a second iteration, or an element that is no image or has no time.
        """
        if self._frames is None:
            remedy = "make a new one, or collect its frames in a list"
            raise DvoError("a stream can be read only once", file=self.name, remedy=remedy)
        frames, self._frames = self._frames, None
        return self._increasing(frames)

    def _increasing(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        previous, offset = -np.inf, 0.0
        intervals: deque[float] = deque(maxlen=_RECENT)
        late: list[Frame] = []
        for frame in frames:
            if frame.timestamp + offset > previous:
                self._drop(late)
                ready, late, reason = [frame], [], ""
            else:
                if late and not frame.timestamp > late[-1].timestamp:
                    self._drop(late)
                    late = []
                late.append(frame)
                if len(late) < _RUN:
                    continue
                back = previous - (late[0].timestamp + offset)
                usual = median(intervals) if intervals else late[1].timestamp - late[0].timestamp
                offset = previous + usual - late[0].timestamp
                self._set_back.append(late[0].index)
                ready, late, reason = late, [], f"clock set back by {back:.2f} s"
            for one in ready:
                seconds = one.timestamp + offset
                if not seconds > previous:  # rounded to the same number
                    self._drop([one])
                    continue
                if previous > -np.inf and not reason:
                    intervals.append(seconds - previous)
                previous = seconds
                yield _changed(one, seconds, reason) if offset else one
                reason = ""
        self._drop(late)

    def _drop(self, late: list[Frame]) -> None:
        if late and not self._late:
            self._first_late = late[0].index
        self._late += len(late)


def _changed(frame: Frame, seconds: float, reason: str) -> Frame:
    """The frame at another time, perhaps after an interruption."""
    changed = copy.copy(frame)  # dataclasses.replace would load depth, right image and inertial samples
    object.__setattr__(changed, "timestamp", seconds)
    object.__setattr__(changed, "interruption", reason or frame.interruption)
    return changed


@partial(checked_arguments, skip=("images", "timestamps", "fps"))
def stream(
    images: Iterable[Item],
    camera: Camera | None = None,
    *,
    timestamps: Iterable[float] | None = None,
    fps: float | None = None,
    name: str = "stream",
    groundtruth: Trajectory | None = None,
    undistort: bool = True,
) -> FrameStream:
    """Wrap images in memory, or arriving, for :func:`dvo.session.session.run` and whatever else takes a source.

    Args:
        images: any iterable of ``(H, W, 3)`` uint8 RGB images, or others that
            :func:`dvo.data.frame_checks.checked_frame` converts (grey, RGBA, uint16, float, torch tensors, PIL); of
            pairs ``(seconds, image)``; or of :class:`Frame`, which is passed on as it is. Read once, one element at a
            time.
        camera: camera of the images; needed unless the elements are frames.
        timestamps: seconds of the images, in the same order; may be endless. Those of images that a
            :class:`dvo.LiveFrames` has dropped are passed over.
        fps: images a second, if there are no times; dropped images count.
        name: for the results folder.
        groundtruth: camera-to-world poses on the clock of the images.
        undistort: resample to a pinhole camera; otherwise frames carry the distorted camera.

    Returns:
        Frames to iterate over once.

    Raises:
        DvoError: both or unusable ``timestamps`` and ``fps``. While iterating: an element that is no image of the
            camera's size or cannot be converted, or that has no time.

    Example:
        >>> images = (np.full((48, 64, 3), 10 * i, np.uint8) for i in range(3))
        >>> frames = dvo.stream(images, dvo.Camera(50.0, 50.0, 31.5, 23.5, 64, 48), fps=10)
        >>> [frame.timestamp for frame in frames]
        [0.0, 0.1, 0.2]
    """
    if timestamps is not None and fps is not None:
        raise DvoError("both timestamps and fps are given", field="timestamps", remedy="give one of them")
    fps = checked_rate(fps)
    undistorter = Undistorter(camera) if camera is not None and undistort and camera.needs_undistortion else None
    times = _iterator(timestamps, name, "timestamps") if timestamps is not None else None
    if not hasattr(images, "__iter__") and not hasattr(images, "__getitem__"):
        raise _not_iterable(images, name, "images")

    def frames() -> Iterator[Frame]:
        index = -1  # of the image, dropped ones counted
        previous: float | None = None
        for item in _iterator(images, name, "images"):
            reception = images.reception if isinstance(images, LiveFrames) else NOTHING
            index += 1 + reception.dropped
            if isinstance(item, Frame):
                yield item
                continue
            time, image = item if isinstance(item, tuple) and len(item) == 2 else (None, item)
            longest = reception.silence
            if times is not None:
                passed = [_seconds(next(times, None), index, name) for _ in range(reception.dropped + 1)]
                time = passed[-1]
                longest = max(np.diff(passed if previous is None else [previous, *passed]), default=0.0)
            elif time is None and fps is not None:
                time, longest = index / fps, 1 / fps
            previous = seconds = _seconds(time, index, name)
            silence = max(float(longest), 0.0) if reception.dropped else None
            if camera is None:
                raise DvoError("no camera", file=name, field="camera", remedy="give the camera of the images")
            pixels = _checked(image, camera, index, name)
            if undistorter is None:
                yield Frame(index, seconds, pixels, camera, silence=silence)
            else:
                yield Frame(index, seconds, undistorter(pixels), undistorter.camera, silence=silence)

    return FrameStream(frames(), name, groundtruth)


def _iterator(values: Any, name: str, field: str) -> Iterator[Any]:
    try:
        return iter(values)
    except TypeError:
        raise _not_iterable(values, name, field) from None


def _not_iterable(values: object, name: str, field: str) -> DvoError:
    return DvoError(f"not {field}: {type(values).__name__}", file=name, field=field, remedy="give a list")


def _seconds(time: Any, index: int, name: str) -> float:
    """A finite number of seconds."""
    try:
        seconds = float(time) if not isinstance(time, (str, bytes)) else np.nan
    except (TypeError, ValueError, OverflowError):
        seconds = np.nan
    if not np.isfinite(seconds):
        raise DvoError(
            f"no time for image {index}",
            file=name,
            field="timestamps",
            remedy="give timestamps=, fps=, or pairs (seconds, image)",
        )
    return seconds


def _checked(image: Any, camera: Camera, index: int, name: str) -> np.ndarray:
    """``(H, W, 3)`` uint8 RGB of the camera's size."""
    try:
        return checked_image(image, camera, f"frame {index}")
    except DvoError as error:
        raise DvoError(error.message, file=name, field=error.field, remedy=error.remedy) from error.__cause__
