"""Streams as sources: a camera, an address of the web, or images through a pipe."""

from __future__ import annotations

import io
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.focal_guess import FocalGuess, guess_from_angle
from dvo.data.calibration.read import read_calibration
from dvo.data.files.stamps import checked_rate
from dvo.data.images.fields import INTERLACED_STREAM, FieldTest
from dvo.data.images.images import decode_bytes, to_rgb8
from dvo.data.inertial import InertialSamples
from dvo.data.interval import Bound, Interval
from dvo.data.mask import open_masks
from dvo.data.opening import check_invert, check_stride
from dvo.data.positions import Positions
from dvo.data.recording import EVERYTHING, Log, RawFrame, Selection
from dvo.data.source import Reading, Source
from dvo.data.streams.capture import STANDARD_INPUT, Capture, StreamClock, is_stream, shown
from dvo.data.streams.image_pipe import pipe_reader, split_images
from dvo.data.streams.live import LONGEST, NOTHING, LiveFrames, StreamCounts
from dvo.data.trajectory import Trajectory


class Timed(Protocol):
    """Element of a stream of images."""

    @property
    def index(self) -> int:
        """Number of the image, dropped ones counted."""
        ...

    @property
    def timestamp(self) -> float:
        """Seconds."""
        ...


T = TypeVar("T", bound=Timed)

QUEUE = 1
"""Frames that wait by default: the newest."""
_FIRST = 15.0  # seconds to wait for the first image of a camera or an address
_DAMAGED = 30  # images that may be damaged before the first good one: a stream that is joined in its midst


class LiveRecording(Generic[T]):
    """A stream in the place of a :class:`dvo.data.recording.Recording`; its frames can be read once.

    Args:
        live: elements of the stream, which end with the iteration.
        decode: turns an element into a frame; None if it cannot be decoded.
        times: origin of the times: ``arrival``, ``stream``, ``file`` or ``fps``.
    """

    kind = "stream"
    frame_count: int | None = None
    timestamps: np.ndarray | None = None
    images: list[Path] | None = None
    turned = 0
    calibration: Calibration | None = None
    groundtruth: Trajectory | None = None
    stereo: Callable[[], StereoRig | None] | None = None
    inertial: Callable[[], InertialSamples] | None = None
    positions: Callable[[], Positions | None] | None = None

    def __init__(self, live: LiveFrames[T], decode: Callable[[T], RawFrame | None], times: str) -> None:
        self.live, self.decode, self.times = live, decode, times
        self.warnings: list[str] = []
        self.path = Path(live.name)
        self.name = re.sub(r"[^A-Za-z0-9._-]+", "-", re.sub(r"^\w+://", "", live.name)).strip("-.") or "stream"

    def first(self, timeout: float | None) -> RawFrame:
        """Wait for an image that decodes, which stays in the stream; those before it are skipped, with a warning.

        Args:
            timeout: seconds; None for any time.

        Raises:
            DvoError: none in time, or too many that do not decode.
        """
        end = None if timeout is None else time.monotonic() + timeout
        for damaged in range(_DAMAGED):
            try:
                item = self.live.peek(None if end is None else max(end - time.monotonic(), 0.0))
            except DvoError as error:
                raise (self._damaged(damaged, error) if damaged else error) from None
            found = self.decode(item)
            if found is not None:
                if damaged:
                    what = "image was" if damaged == 1 else f"{damaged} images were"
                    self.warnings.append(f"the first {what} skipped: not to be decoded")
                return found
            self.live.skip(item)
        raise self._damaged(_DAMAGED)

    def _damaged(self, count: int, then: DvoError | None = None) -> DvoError:
        what = "image does not decode" if count == 1 else f"{count} images do not decode"
        after = "" if then is None else f", and then: {then.message}"
        return DvoError(f"the first {what}{after}", file=self.live.name, remedy="check the stream")

    def frames(self, log: Log, selection: Selection = EVERYTHING) -> Iterator[RawFrame]:
        """See :class:`dvo.data.recording.Recording`; the stride counts frames that were not dropped."""
        interval, reduction = selection.interval, selection.reduction
        since = NOTHING  # what was received since the last frame, those that the stride leaves out among them

        def numbered() -> Iterator[tuple[int, T]]:
            nonlocal since
            for number, item in enumerate(self.live):
                since = since.then(self.live.reception.silence)
                yield number, item

        for _, item in interval.select(numbered(), lambda item: item[1].timestamp, selection.stride, self.live.name):
            raw = self.decode(item)
            if raw is None:
                log.unreadable.append(f"image {item.index}")
            else:
                image = raw.image if reduction is None else reduction(raw.image)
                yield replace(raw, image=image, silence=since.silence)
                since = NOTHING
        dropped = self.live.counts.dropped
        self.live.stop()  # at the end of an interval the stream goes on
        self.live.counts.dropped = dropped  # what waits lies behind the interval


class LiveSource(Source):
    """A stream as a source. Made by :func:`open_stream`.

    It can be iterated once. Reading begins when it is opened and ends with the iteration, or by :meth:`stop`.

    Attributes:
        counts: frames received and dropped since the iteration began; updated while it runs.
        times: origin of the times: ``arrival`` (monotonic clock), ``stream`` (stated by the stream, on the same clock),
            ``file`` (of a served video file) or ``fps``.
    """

    recording: LiveRecording[Any]

    @property
    def warnings(self) -> list[str]:
        """Faults so far and the number of dropped frames, in sentences for the user."""
        return [*super().warnings, *self.recording.live.warnings]

    @property
    def counts(self) -> StreamCounts:
        """Frames received and dropped."""
        return self.recording.live.counts

    @property
    def times(self) -> str:
        """Origin of the times."""
        return self.recording.times

    def stop(self) -> None:
        """End the iteration as soon as possible. May be called from any thread, and in a signal handler."""
        self.recording.live.stop()

    def close(self) -> None:
        """Stop, and wait for the end of the thread that reads."""
        self.recording.live.close()

    def __enter__(self) -> LiveSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@partial(checked_arguments, skip=("fps", "stride"))
def open_stream(
    source: Any,
    *,
    calib: Path | str | Calibration | None = None,
    fps: float | None = None,
    queue: int | None = None,
    stride: int = 1,
    undistort: bool = True,
    end: Bound | None = None,
    mask: Path | str | None = None,
    mask_invert: bool = False,
) -> LiveSource:
    """Open a camera, an address, or a pipe of images as a source that is read while it arrives.

    A live stream is never held back: a thread reads it, at most ``queue`` frames wait, and the oldest of them is
    dropped for a new one. A recording that comes as a stream (a video file behind an address, or a pipe with ``fps``)
    is held back instead, and every frame is processed.

    Args:
        source: ``webcam:0``; an address that begins with ``rtsp://`` or ``http://`` (or ``rtsps``, ``https``); ``-``,
            JPEG or PNG images one after the other in the standard input; or a binary file with such images, for
            instance ``stdout`` of a process.
        calib: calibration; without one, the usual angle of view is assumed, with a warning.
        fps: images a second, for the times. Otherwise times are those of a served video file, those of an RTSP stream,
            or those of arrival (``time.monotonic()``).
        queue: frames that may wait, older ones are dropped; 0: none is dropped. None: 1 for a live stream, 0 for a
            recording.
        stride: every how many-th of the frames that were not dropped.
        undistort: resample images to a pinhole camera.
        end: seconds since the first frame that is processed, or the number of frames, such as ``"120f"``, after which
            the stream is closed.
        mask, mask_invert: one mask for all images, see :func:`dvo.data.open.open_source`.

    Returns:
        Frames to iterate over once.

    Raises:
        DvoError: it cannot be opened, or no image arrives within 15 s (a pipe: before its end).

    Example:
        ::

            with dvo.open_stream("webcam:0", calib="calib.txt") as source:
                for frame in source:
                    print(odometry.track(frame).pose_wc)
    """
    if source is None:
        raise DvoError("must be a camera, an address or a pipe, got None", field="source", remedy="give webcam:0 or -")
    fps = checked_rate(fps)
    check_stride(stride)
    check_invert(mask, mask_invert)
    if queue is not None and not 0 <= queue <= LONGEST:
        message = f"must be 0 or more, and {LONGEST} at most, got {queue}"
        raise DvoError(message, field="queue", remedy="give a whole number of frames")
    if calib is not None and not isinstance(calib, Calibration):
        calib = read_calibration(calib)
    interval = Interval.of(None, end)
    stopped = threading.Event()
    recording: LiveRecording[Any]
    timeout: float | None
    if isinstance(source, str) and source != STANDARD_INPUT:
        recording, timeout = _of_capture(source, fps, queue, stopped)
    else:
        recording, timeout = _of_pipe(source, fps, queue, stopped), None
    try:
        first = recording.first(timeout)
        height, width = first.image.shape[:2]
        assumed = guess_from_angle(width, height)
        doubts = calib.doubts(width, height) if calib else [_assumption(assumed)]
        camera = (calib or assumed.calibration).camera(width, height)
        masks = None if mask is None else open_masks(Path(mask), recording, (width, height), mask_invert)
        selection = Selection(interval, stride)
        reading = Reading(
            camera, selection, guess=None if calib else assumed, given=calib is not None and not calib.was_found,
            undistort=undistort, masks=masks, doubts=tuple(doubts),
        )  # fmt: skip
        return LiveSource(recording, reading)
    except BaseException:
        recording.live.close()
        raise


def _assumption(guess: FocalGuess) -> str:
    return (
        f"no calibration: assuming the usual angle of view, a focal length of {guess.focal:.0f} px; it can be found in "
        "a recorded clip (dvo run CLIP), which then writes a calib.txt for --calib"
    )


def _live(
    images: Iterator[T], name: str, is_recording: bool, queue: int | None, stopped: threading.Event
) -> LiveFrames[T]:
    if queue is None:
        queue = 0 if is_recording else QUEUE
    return LiveFrames(images, queue or QUEUE, drop=queue > 0, name=name, interrupt=stopped.set)


def _of_capture(
    address: str, fps: float | None, queue: int | None, stopped: threading.Event
) -> tuple[LiveRecording[RawFrame], float]:
    if not is_stream(address):
        remedy = "give webcam:N, rtsp://..., http://... or -"
        raise DvoError("neither a camera nor an address", file=shown(address), remedy=remedy)
    capture = Capture(address, fps)
    live = _live(capture.images(stopped.is_set), capture.name, capture.is_recording, queue, stopped)
    recording = LiveRecording(live, lambda raw: raw, capture.times)
    recording.warnings = capture.warnings
    return recording, _FIRST


@dataclass(frozen=True)
class _Encoded:
    """Image of a pipe that is decoded only if it is not dropped."""

    index: int
    timestamp: float
    data: bytes


def _of_pipe(file: Any, fps: float | None, queue: int | None, stopped: threading.Event) -> LiveRecording[_Encoded]:
    given = getattr(file, "name", None)  # a number, if it was opened by a descriptor
    name = "standard input" if file == STANDARD_INPUT else given if isinstance(given, str) and given else "pipe"
    if file == STANDARD_INPUT:
        file = getattr(sys.stdin, "buffer", None)  # a service may have no standard input
    if isinstance(file, io.TextIOWrapper):
        file = file.buffer
    if file is None or getattr(file, "closed", False):
        raise DvoError("is closed", file=name, remedy="pipe images into it: ffmpeg ... -f image2pipe - | dvo run -")
    if not hasattr(file, "read"):
        remedy = "give webcam:N, rtsp://..., http://..., - or a binary file"
        raise DvoError(f"a stream cannot be {type(file).__name__}", field="source", remedy=remedy)
    if hasattr(file, "isatty") and file.isatty():
        raise DvoError("is a terminal", file=name, remedy="pipe images into it: ffmpeg ... -f image2pipe - | dvo run -")

    def images() -> Iterator[_Encoded]:
        clock = StreamClock()
        for index, data in enumerate(split_images(pipe_reader(file, stopped.is_set, name), name)):
            yield _Encoded(index, clock(time.monotonic()) if fps is None else index / fps, data)

    times = "arrival" if fps is None else "fps"
    decoder = _Decoder(name)
    recording = LiveRecording(_live(images(), name, fps is not None, queue, stopped), decoder, times)
    decoder.warnings = recording.warnings
    return recording


class _Decoder:
    """Decodes the images of a pipe, and looks at the first of them for interlacing."""

    def __init__(self, name: str) -> None:
        self.name, self.warnings = name, list[str]()
        self._fields: FieldTest | None = FieldTest()
        self._last = -1  # the image that was looked at last

    def __call__(self, item: _Encoded) -> RawFrame | None:
        image = decode_bytes(item.data, self.name)
        if image is None:
            return None
        pixels = to_rgb8(image)
        if self._fields is not None and item.index > self._last:
            if item.index > self._last + 1:
                self._fields.skip()
            self._last = item.index
            self._fields.look(pixels)
            if self._fields.is_done:
                self.warnings += [INTERLACED_STREAM] * self._fields.is_interlaced
                self._fields = None
        return RawFrame(item.index, item.timestamp, pixels, f"{self.name} image {item.index}")
