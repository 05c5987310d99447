"""Video of the tracked patches: where patches of earlier frames were measured in each frame, and the status."""

from __future__ import annotations

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

RATE = 30.0  # frames per second of the video, whatever the times of the frames
_STATUS_COLOURS = {
    Status.TRACKING: (47, 143, 131),
    Status.INITIALISING: (227, 167, 47),
    Status.LOST: (200, 54, 74),
    Status.INERTIAL: (108, 92, 190),
}


class OverlayVideo:
    """Observer that writes a video (:class:`dvo.session.observer.Observer`).

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
        picture = self._picture(frame, estimate)
        if self._writer is None:
            self._size = picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2  # codecs want even sizes
            codec = cv2.VideoWriter.fourcc(*("MJPG" if self.file.suffix.lower() == ".avi" else "mp4v"))
            self._part = begin_part(self.file)
            with spelled_in_text(self._part) as name:
                self._writer = cv2.VideoWriter(name, codec, RATE, self._size)
            if not self._writer.isOpened():
                raise self._error("no codec for this kind of video")
        self._writer.write(np.ascontiguousarray(picture[: self._size[1], : self._size[0], ::-1]))

    def finish(self, run: Run) -> None:
        """End the video.

        Args:
            run: record of the session.
        """
        self.close()

    def close(self) -> None:
        """Close the video, which takes the place of an earlier one; without a frame there is none."""
        part, self._part = self._part, None
        if self._writer is None or part is None:
            return
        opened = self._writer.isOpened()
        self._writer.release()
        if not opened:
            drop_part(part)
            return
        try:
            end_part(part, self.file)
        except OSError:
            drop_part(part)
            raise

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
        scale = picture.shape[0] / 700
        place = (height, round(2 * height + 22 * scale))
        for colour, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, width, cv2.LINE_AA)
        return picture

    def _error(self, message: str) -> DvoError:
        remedy = "give a file named .mp4 or .avi in a folder that can be written"
        return DvoError(message, file=self.file, field="--overlay", remedy=remedy)


def _circle(picture: np.ndarray, x: float, y: float, radius: int, colour: tuple[int, ...], width: int) -> None:
    if 0 <= x < picture.shape[1] and 0 <= y < picture.shape[0]:
        cv2.circle(picture, (round(x), round(y)), radius, colour, width, cv2.LINE_AA)
