"""Corner tracks: Shi-Tomasi corners followed by pyramidal Lucas-Kanade with a forward-backward check (OpenCV)."""

from __future__ import annotations

import cv2
import numpy as np


class Tracks:
    """The live tracks, as parallel arrays of length N.

    Attributes:
        ids: ``(N,)`` int64, never reused.
        uv: ``(N, 2)`` float32 pixels in the latest image.
        last_uv: ``(N, 2)`` float32 pixels in the image before it.
        anchor: ``(N,)`` int64 frame (position in the sequence) in which the corner was detected.
        anchor_uv: ``(N, 2)`` float32 pixels in that frame.
        points: ``(N, 3)`` float64 in the world, nan while not triangulated.
        normal: ``(N, 3, 4)`` float64 normal equations ``[A | b]`` of the point, one term for every observation.
        colors: ``(N, 3)`` uint8 RGB of the corner where it was detected.
    """

    _FIELDS = ("ids", "uv", "last_uv", "anchor", "anchor_uv", "points", "normal", "colors")

    def __init__(self) -> None:
        self.ids = np.zeros(0, np.int64)
        self.uv = np.zeros((0, 2), np.float32)
        self.last_uv = np.zeros((0, 2), np.float32)
        self.anchor = np.zeros(0, np.int64)
        self.anchor_uv = np.zeros((0, 2), np.float32)
        self.points = np.zeros((0, 3))
        self.normal = np.zeros((0, 3, 4))
        self.colors = np.zeros((0, 3), np.uint8)
        self._next_id = 0

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def has_point(self) -> np.ndarray:
        """``(N,)`` bool."""
        return ~np.isnan(self.points[:, 0])

    def keep(self, mask: np.ndarray) -> None:
        """Forget the tracks where ``mask`` is False."""
        for name in self._FIELDS:
            setattr(self, name, getattr(self, name)[mask])

    def add(self, uv: np.ndarray, frame: int, image: np.ndarray) -> None:
        """Start tracks at pixels ``(M, 2)`` of a frame, whose image ``(H, W, 3)`` gives the colours."""
        count = len(uv)
        new = {
            "ids": np.arange(self._next_id, self._next_id + count),
            "uv": uv,
            "last_uv": uv,
            "anchor": np.full(count, frame),
            "anchor_uv": uv,
            "points": np.full((count, 3), np.nan),
            "normal": np.zeros((count, 3, 4)),
            "colors": image[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)],
        }
        for name in self._FIELDS:
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, new[name].astype(old.dtype)]))
        self._next_id += count


def follow(
    before: np.ndarray,
    after: np.ndarray,
    uv: np.ndarray,
    *,
    window: int,
    levels: int,
    tolerance: float,
    guess: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Follow pixels from one grey image to the next.

    Args:
        before, after: ``(H, W)`` uint8.
        uv: ``(N, 2)`` float32 pixels in ``before``.
        window: side of the patch, pixels.
        levels: pyramid levels above the image.
        tolerance: largest distance between a pixel and where it comes back to, pixels.
        guess: ``(N, 2)`` where the search in ``after`` begins, if not at ``uv``.

    Returns:
        ``(N, 2)`` pixels in ``after`` and ``(N,)`` bool, True where the track holds.
    """
    if len(uv) == 0:
        return uv, np.zeros(0, bool)

    def flow(first: np.ndarray, second: np.ndarray, at: np.ndarray, begin: np.ndarray | None) -> tuple[np.ndarray, ...]:
        end = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
        flags = 0 if begin is None else cv2.OPTFLOW_USE_INITIAL_FLOW
        start = np.empty_like(at) if begin is None else np.array(begin, np.float32)
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            first, second, at, start, winSize=(window, window), maxLevel=levels, criteria=end, flags=flags
        )
        return np.asarray(there).reshape(-1, 2), np.asarray(found).ravel() == 1

    there, found = flow(before, after, uv, guess)
    back, returned = flow(after, before, there, None if guess is None else uv)
    height, width = after.shape
    inside = ((there >= 0) & (there <= np.array([width - 1, height - 1]))).all(axis=1)
    closed = np.linalg.norm(back - uv, axis=1) < tolerance
    return there, found & returned & inside & closed


def detect(grey: np.ndarray, existing: np.ndarray, wanted: int, *, quality: float, spacing: float) -> np.ndarray:
    """New corners away from existing tracks.

    Args:
        grey: ``(H, W)`` uint8.
        existing: ``(N, 2)`` pixels to stay away from.
        wanted: largest number of corners.
        quality: smallest corner strength relative to the strongest of the image.
        spacing: smallest distance between corners, pixels.

    Returns:
        ``(M, 2)`` float32 pixels.
    """
    if wanted <= 0:
        return np.zeros((0, 2), np.float32)
    mask = np.full(grey.shape, 255, np.uint8)
    for x, y in np.rint(existing).astype(int):
        cv2.circle(mask, (int(x), int(y)), int(spacing), 0, -1)
    corners = cv2.goodFeaturesToTrack(grey, wanted, quality, spacing, mask=mask, blockSize=5)
    return np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2).astype(np.float32)
