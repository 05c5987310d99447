"""Video of the tracked patches: where patches of earlier frames were measured in each frame, and the status."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.output import begin_part, check_place, drop_part, end_part, spelled_in_text
from dvo.data.frame import Frame
from dvo.odometry.protocol import Estimate, Odometry, Status
from dvo.session.observer import graph_of, window_view
from dvo.session.session import Run
from dvo.viz.marks import pixels, shade

MIN_RATE, MAX_RATE = 1.0, 120.0  # pictures per second of the video
MAX_PAUSE = 2.0  # seconds for which a picture stays at most; what is longer in the source is shortened
_LOOKED_AT = 10  # intervals between tracked frames that tell the rate
_PAUSE = 1.7  # usual steps
_LATE = 0.5  # seconds by which the video may fall behind the source before a picture is left out
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_STATUS_COLOURS = {
    Status.TRACKING: (47, 143, 131),
    Status.INITIALISING: (227, 167, 47),
    Status.LOST: (200, 54, 74),
    Status.INERTIAL: (108, 92, 190),
}


class OverlayVideo:
    """Observer that writes a video at the speed of the source (:class:`dvo.session.observer.Observer`).

    Its rate is the inverse of the median interval of the first tracked frames. Where frames come later, the picture
    before them stays, for two seconds at most.

    Args:
        file: video to write; its extension selects the container.

    Raises:
        DvoError: the file cannot be written.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self._odometry: Odometry | None = None
        self._part: Path | None = None
        self._waiting: deque[tuple[float, np.ndarray]] = deque()  # times and pictures before the rate is known
        self._rate = 0.0
        self._shown: np.ndarray | None = None  # the last picture, written when its successor comes
        self._place, self._time, self._elapsed = 0, 0.0, 0.0  # its place in the video; time of the source, and so far
        check_place(file, "--overlay")  # OpenCV does not tell why it cannot write

    def begin(self, odometry: Odometry) -> None:
        """Take the odometry whose window is read.

        Args:
            odometry: newly built.
        """
        self._odometry = odometry

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """Write a frame.

        Args:
            frame: the frame.
            estimate: of the frame; None if it was skipped, which writes nothing.

        Raises:
            DvoError: there is no codec for the video.
        """
        if estimate is None:
            return
        self._waiting.append((estimate.timestamp, self._picture(frame, estimate)))
        if self._writer is None and len(self._waiting) > _LOOKED_AT:
            self._open()
        if self._writer is not None:
            self._show()

    def finish(self, run: Run) -> None:
        """End the video.

        Args:
            run: record of the session.

        Raises:
            DvoError: there is no codec for the video.
        """
        self.close()

    def close(self) -> None:
        """Close the video, which takes the place of an earlier one; without a frame there is none.

        Raises:
            DvoError: there is no codec for the video.
        """
        if self._waiting and self._part is None:
            self._open()
        part, self._part = self._part, None
        if self._writer is None or part is None:
            return
        opened = self._writer.isOpened()
        if opened:
            self._show()
            if self._shown is not None:
                self._write(self._shown, 1)
        self._writer.release()
        if not opened:
            drop_part(part)
            return
        try:
            end_part(part, self.file)
        except OSError:
            drop_part(part)
            raise

    def _open(self) -> None:
        """Begin the file, at the rate of the pictures that wait."""
        rate = _rate(np.diff([time for time, _ in self._waiting])) if len(self._waiting) > 1 else MIN_RATE
        self._rate = round(min(max(rate, MIN_RATE), MAX_RATE), 2)  # MPEG-4 knows whole ticks up to 65535 a second
        picture = self._waiting[0][1]
        self._size = picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2  # codecs want even sizes
        codec = cv2.VideoWriter.fourcc(*("MJPG" if self.file.suffix.lower() == ".avi" else "mp4v"))
        self._part = begin_part(self.file)
        with spelled_in_text(self._part) as name:
            self._writer = cv2.VideoWriter(name, codec, self._rate, self._size)
        if not self._writer.isOpened():
            self._waiting.clear()
            raise self._error("no codec for this kind of video")

    def _show(self) -> None:
        """Write what waits, each picture until the time of the next one."""
        while self._waiting:
            time, picture = self._waiting.popleft()
            if self._shown is None:
                self._time, self._shown = time, picture
                continue
            self._elapsed += min(time - self._time, MAX_PAUSE)
            self._time = time
            place = round(self._elapsed * self._rate)
            if self._place - place > _LATE * self._rate:
                continue
            count = max(1, place - self._place)
            self._write(self._shown, count)
            self._place += count
            self._shown = picture

    def _write(self, picture: np.ndarray, times: int) -> None:
        assert self._writer is not None
        image = np.ascontiguousarray(picture[: self._size[1], : self._size[0], ::-1])
        for _ in range(times):
            self._writer.write(image)

    def _picture(self, frame: Frame, estimate: Estimate) -> np.ndarray:
        """RGB image of the frame with the marks of its patches."""
        picture = np.ascontiguousarray(frame.image).copy()
        graph = None if self._odometry is None else graph_of(self._odometry)
        view = None if graph is None else window_view(graph)
        radius = max(1, round(picture.shape[0] / 140))
        if view is not None and view.timestamp == frame.timestamp:
            for x, y in pixels(view.patches, frame.camera):
                _circle(picture, x, y, radius + 1, (255, 255, 255), 1)
            for (x, y), colour in zip(pixels(view.matches, frame.camera), shade(view.confidence), strict=True):
                _circle(picture, x, y, radius, tuple(colour.tolist()), -1)
        text = f"{estimate.status}: {estimate.reason}" if estimate.reason else str(estimate.status)
        height = max(4, picture.shape[0] // 80)
        picture[:height] = _STATUS_COLOURS[estimate.status]
        _label(picture, text, height)
        return picture

    def _error(self, message: str) -> DvoError:
        remedy = "give a file named .mp4 or .avi in a folder that can be written"
        return DvoError(message, file=self.file, field="--overlay", remedy=remedy)


def _circle(picture: np.ndarray, x: float, y: float, radius: int, colour: tuple[int, ...], width: int) -> None:
    if 0 <= x < picture.shape[1] and 0 <= y < picture.shape[0]:
        cv2.circle(picture, (round(x), round(y)), radius, colour, width, cv2.LINE_AA)


def _label(picture: np.ndarray, text: str, top: int) -> None:
    """Write a line in white on a dark plate at the left edge, below ``top`` rows, as wide as the picture at most."""
    scale = max(picture.shape[0] / 900, 0.4)
    (width, height), below = cv2.getTextSize(text, _FONT, scale, 1)
    room = picture.shape[1] - 2 * height
    if width > room:
        scale *= room / width
        (width, height), below = cv2.getTextSize(text, _FONT, scale, 1)
    margin = round(height * 0.6)
    bottom = top + height + below + 2 * margin
    plate = picture[top:bottom, : width + 2 * margin]
    plate[:] = plate // 5
    # One stroke in one width: OpenCV 5 has glyphs of another shape for each width, so that no outline fits.
    place = (margin, top + margin + height)
    cv2.putText(picture, text, place, _FONT, scale, (255, 255, 255), 1, cv2.LINE_AA)


def _rate(steps: np.ndarray) -> float:
    """Pictures a second, without pauses; of uneven steps rather too many, as a picture that is late stays late."""
    usual = steps[steps < _PAUSE * np.median(steps)]
    usual = usual if len(usual) else steps
    return 1 / max(float(usual.mean() - 2 * usual.std() / len(steps)), 1 / MAX_RATE)
