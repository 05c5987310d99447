"""Small images of some frames of a run, evenly spread over it, for its page."""

from __future__ import annotations

import cv2
import numpy as np

from dvo.data.frame import Frame
from dvo.odometry.protocol import Estimate

MAX_IMAGES, MAX_BYTES = 64, 240_000
_SIDE, _QUALITY = 200, 60  # pixels of the longer side; of JPEG


class Thumbnails:
    """Record of images, made while a run goes on: where there are too many, every second one is dropped."""

    def __init__(self) -> None:
        self._found: list[tuple[float, bytes]] = []
        self._every, self._count = 1, 0

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """Take note of a frame; callback of :func:`dvo.session.session.run`.

        Args:
            frame: the frame.
            estimate: of the frame; not looked at.
        """
        if self._count % self._every == 0:
            self._found.append((frame.timestamp, _small(frame.image)))
        self._count += 1
        while len(self._found) > MAX_IMAGES or sum(len(jpeg) for _, jpeg in self._found) > MAX_BYTES:
            self._found = self._found[::2]
            self._every *= 2

    @property
    def images(self) -> list[tuple[float, bytes]]:
        """Time (seconds) and JPEG file of each, in order of time."""
        return list(self._found)


def _small(image: np.ndarray) -> bytes:
    scale = min(1.0, _SIDE / max(image.shape[:2]))
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    bgr = np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)[..., ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
