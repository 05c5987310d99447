"""Cameras and network streams, read by OpenCV."""

from __future__ import annotations

import math
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

from dvo.core.errors import DvoError
from dvo.core.text import first_line, redacted
from dvo.data.files.stamps import NOMINAL_FPS, RATES
from dvo.data.images.fields import INTERLACED_STREAM, FieldTest
from dvo.data.images.images import to_rgb8
from dvo.data.recording import RawFrame

if TYPE_CHECKING:
    import cv2

STANDARD_INPUT = "-"
WEBCAM = re.compile(r"webcam:(\d{1,3})")
NETWORK = re.compile(r"(rtsp|rtsps|http|https)://", re.IGNORECASE)
_ADDRESS = re.compile(r"\s*[a-z][a-z0-9+.-]+:/|\s*webcam:?\s*\d*\s*$", re.IGNORECASE)

_SECONDS = 10  # to open a stream, and to wait for its next image
_JUMP = 5.0  # seconds that the clock of a stream may run away from that of this machine


def is_stream(source: object) -> bool:
    """True for ``webcam:N``, ``rtsp://``, ``rtsps://``, ``http://``, ``https://`` and ``-``.

    Args:
        source: as given by the user.
    """
    text = source if isinstance(source, str) else ""
    return text == STANDARD_INPUT or bool(WEBCAM.fullmatch(text) or NETWORK.match(text))


def not_found_remedy(source: object) -> str:
    """What to give in place of a source that does not exist: another address if it looks like one.

    Args:
        source: as given by the user.
    """
    if isinstance(source, str) and _ADDRESS.match(source):
        return "addresses begin with rtsp://, rtsps://, http:// or https://, a camera is webcam:0"
    return "give a video, a folder of images or a sequence"


def shown(address: str) -> str:
    """Address without user name, password and tokens, for messages and files.

    Args:
        address: of a stream, or any other source.
    """
    return redacted(address, whole=True)


class StreamClock:
    """Times of a live stream on the monotonic clock of this machine.

    The times that a stream states (RTSP: those of its packets) tell better when an image was taken than its arrival.
    They begin anywhere, so the first one is put at the moment of its arrival; and again one that is not later than the
    one before, or that is more than five seconds away from its arrival: the camera has set its clock, or has restarted.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._stated = self._previous = -math.inf

    def __call__(self, arrival: float, stated: float | None = None) -> float:
        """Time of an image.

        Args:
            arrival: seconds, of the monotonic clock.
            stated: seconds, by the stream; None or 0 for none.

        Returns:
            Seconds, later than all before.
        """
        seconds = arrival
        if stated and math.isfinite(stated):
            if self._offset is None or stated <= self._stated or abs(stated + self._offset - arrival) > _JUMP:
                self._offset = max(arrival, self._previous + 1e-6) - stated
            self._stated, seconds = stated, stated + self._offset
        self._previous = max(seconds, self._previous + 1e-6)  # clocks of some systems have steps of 16 ms
        return self._previous


class Capture:
    """An open camera or network stream.

    Args:
        address: ``webcam:N``, or an address of the web.
        fps: images a second, for the times; None for those of the stream, or of arrival.

    Attributes:
        name: address without user name, password and tokens.
        is_recording: a video file that is served, not a live stream.
        warnings: sentences for the user; they grow while images are read.
        times: ``arrival``; ``stream``, those of an RTSP stream on the clock of this machine; ``file``, those of a video
            file that is served; or ``fps``.

    Raises:
        DvoError: it cannot be opened.
    """

    def __init__(self, address: str, fps: float | None = None) -> None:
        import cv2

        self.name, self._fps = shown(address), fps
        self.warnings: list[str] = []
        self._capture = _open(address, self.name)
        webcam = WEBCAM.fullmatch(address) is not None
        if webcam:
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old images are of no use; not every driver heeds it
        # A camera has no number of frames; containers without one state huge or negative numbers.
        self.is_recording = not webcam and bool(0 < self._capture.get(cv2.CAP_PROP_FRAME_COUNT) < 1e9)
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        self._nominal = rate if math.isfinite(rate) and RATES[0] <= rate <= RATES[1] else NOMINAL_FPS
        is_rtsp = address.lower().startswith("rtsp")
        self.times = "fps" if fps else "file" if self.is_recording else "stream" if is_rtsp else "arrival"

    def images(self, stopped: Callable[[], bool]) -> Iterator[RawFrame]:
        """Read images until the stream ends, and close it.

        Args:
            stopped: whether to end before; asked after each image.

        Yields:
            Images; those that do not decode are left out.
        """
        import cv2

        clock, index, previous, offset = StreamClock(), 0, -math.inf, 0.0
        fields: FieldTest | None = FieldTest()
        try:
            while not stopped() and self._capture.grab():
                arrival = time.monotonic()
                stated = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                decoded, image = self._capture.retrieve()
                if decoded and image is not None:
                    if fields is not None:
                        fields.look(image)
                        if fields.is_done:
                            self.warnings += [INTERLACED_STREAM] * fields.is_interlaced
                            fields = None
                    if self.times in ("arrival", "stream"):
                        seconds = clock(arrival, stated if self.times == "stream" else None)
                    elif self.times == "file" and stated + offset > previous:
                        seconds = stated + offset
                    elif self.times == "file" and stated + offset < previous - _JUMP:  # another clock begins
                        seconds = previous + 1 / self._nominal
                        offset = seconds - stated
                    else:
                        seconds = index / (self._fps or self._nominal)
                    if seconds > previous:
                        previous = seconds
                        yield RawFrame(index, seconds, to_rgb8(image), f"{self.name} frame {index}")
                index += 1
        finally:
            self._capture.release()


def _open(address: str, name: str) -> cv2.VideoCapture:
    """Open it in a thread: OpenCV waits many seconds for a camera that is off, and a signal would wait with it."""
    opened: Future[cv2.VideoCapture] = Future()

    def work() -> None:
        try:
            opened.set_result(_open_here(address, name))
        except BaseException as error:
            opened.set_exception(error)

    threading.Thread(target=work, name=f"dvo opens {name}", daemon=True).start()
    return opened.result()


def _open_here(address: str, name: str) -> cv2.VideoCapture:
    import cv2

    webcam = WEBCAM.fullmatch(address)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # one clear error, not a page of them
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    limits: list[Any] = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 1000 * _SECONDS, cv2.CAP_PROP_READ_TIMEOUT_MSEC]
    try:
        if webcam:
            capture = cv2.VideoCapture(int(webcam[1]))
        else:
            capture = cv2.VideoCapture(address, cv2.CAP_FFMPEG, [*limits, 1000 * _SECONDS])
    except cv2.error as error:  # its text, and that of a traceback, may hold the address
        reason = first_line(error).replace(address, name)
        raise DvoError(f"cannot be opened ({reason})", file=name, remedy="check the address") from None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        capture.release()
        if webcam:
            remedy = "check that it is connected, that no other program uses it, and that you may read it"
            raise DvoError(f"no camera of number {webcam[1]} can be opened", file=name, remedy=remedy)
        remedy = "check the address, and that other programs can play it"
        raise DvoError("no video stream can be opened there", file=name, remedy=remedy)
    return capture
