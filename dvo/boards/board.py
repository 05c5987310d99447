"""Boards for calibration, and the detection of their corners in images by OpenCV.

Corners are in pixels of the image, pixel centres at integers. Points are on the plane Z = 0 of the board, in its unit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np

from dvo.core.errors import DvoError

_SEARCHED = 800  # pixels of the longer side of the image in which a checkerboard is searched
_MIN_CORNERS = 8  # corners of a ChArUco board in a view
_OTHERS = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL")  # contain the smaller ones


class Board(Protocol):
    """Plane board with known corners."""

    @property
    def points(self) -> np.ndarray:
        """``(M, 3)`` all corners."""
        ...

    def detect(self, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Find the board in an image.

        Args:
            grey: ``(H, W)`` uint8.

        Returns:
            ``(N, 2)`` float64 corners and the ``(N, 3)`` points that they show; None if there is no board.
        """
        ...

    def hint(self, images: Sequence[np.ndarray]) -> str:
        """Instruction for somebody whose board was not found.

        Args:
            images: some ``(H, W)`` uint8 images without a detection.
        """
        ...


def _grid(columns: int, rows: int, square: float) -> np.ndarray:
    """``(columns * rows, 3)`` points, row by row."""
    y, x = np.mgrid[:rows, :columns]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * float(square)


def _check_sizes(columns: int, rows: int, square: float, least: int, name: str) -> None:
    if not (least <= min(columns, rows) and max(columns, rows) <= 100):
        message = f"{columns}x{rows} is no board, {least}x{least} is the smallest"
        raise DvoError(message, field=name, remedy="give COLUMNSxROWS, such as 9x6")
    if not 0 < square < float("inf"):
        raise DvoError(f"{square:g} is no length", field="square", remedy="give the side of a square in metres")


@dataclass(frozen=True)
class Checkerboard:
    """Board of black and white squares.

    Attributes:
        columns, rows: number of inner corners: a board of 10x7 squares has 9x6.
        square: side of a square in the unit of the board, usually metres.

    Raises:
        DvoError: fewer than 3 corners in a row or column, or a side that is no length.
    """

    columns: int
    rows: int
    square: float = 1.0

    def __post_init__(self) -> None:
        _check_sizes(self.columns, self.rows, self.square, 3, "board")

    def __str__(self) -> str:
        """Name for messages."""
        return f"{self.columns}x{self.rows} checkerboard"

    @cached_property
    def points(self) -> np.ndarray:
        """``(M, 3)`` all corners."""
        return _grid(self.columns, self.rows, self.square)

    def detect(self, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Find the whole board; see :meth:`Board.detect`.

        Large images are searched at reduced size, and the corners refined in the image itself.

        Args:
            grey: ``(H, W)`` uint8.
        """
        scale = min(1.0, _SEARCHED / max(grey.shape))
        small = grey
        if scale < 1:
            small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        corners = _find(small, self.columns, self.rows)
        if corners is None:
            return None
        if scale < 1:
            ratio = np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
            corners = (corners + 0.5) * ratio - 0.5
        return _refine(grey, corners, self.points, self.square, 0.33), self.points

    def hint(self, images: Sequence[np.ndarray]) -> str:
        """Number of corners of a board that is there after all, or advice; see :meth:`Board.hint`.

        Args:
            images: some images without a detection.
        """
        sizes: Counter[tuple[int, int]] = Counter()
        for image in images:
            flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
            found, _, grid = cv2.findChessboardCornersSBWithMeta(image, (4, 4), flags=flags)
            if found:
                sizes[max(grid.shape[:2]), min(grid.shape[:2])] += 1
        if sizes:
            (columns, rows), _ = max(sizes.items(), key=lambda item: (item[1], item[0]))
            if {columns, rows} != {self.columns, self.rows}:
                return f"a board of {columns}x{rows} inner corners is there: give --board {columns}x{rows}"
        squares = f"{self.columns + 1}x{self.rows + 1} squares"
        return (
            f"count the inner corners, where four squares meet: {self.columns}x{self.rows} are those of {squares}; "
            "show the whole board with a white margin, in even light"
        )


def _find(grey: np.ndarray, columns: int, rows: int) -> np.ndarray | None:
    """``(N, 2)`` corners of a checkerboard, row by row; None if there is none."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=flags)
    return corners.reshape(-1, 2).astype(np.float64) if found else None


def _refine(grey: np.ndarray, corners: np.ndarray, points: np.ndarray, square: float, share: float) -> np.ndarray:
    """Corners to a fraction of a pixel, from the gradients in windows around them (``cv2.cornerSubPix``).

    On rendered boards this has a fifth of the error of the corners that the search gives, and half of those of ArUco's.

    Args:
        grey: image.
        corners, points: ``(N, 2)`` and ``(N, 3)``.
        square: side of a square.
        share: half of the side of the window over the shortest side of a square in the image: no other edge is in it.
    """
    matrix, _ = cv2.findHomography(points[:, :2], corners, 0)
    if matrix is None:
        return corners
    steps = np.stack([points[:, :2] + [square, 0], points[:, :2] + [0, square], points[:, :2]])
    right, down, here = cv2.perspectiveTransform(steps.reshape(-1, 1, 2), matrix).reshape(3, -1, 2)
    spacing = min(np.linalg.norm(right - here, axis=1).min(), np.linalg.norm(down - here, axis=1).min())
    half = int(np.clip(share * spacing, 2, 12))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = np.ascontiguousarray(corners.reshape(-1, 1, 2), np.float32)
    refined = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), criteria).reshape(-1, 2).astype(np.float64)
    moved = np.linalg.norm(refined - corners, axis=1) > half
    return np.where(moved[:, None], corners, refined)


@dataclass(frozen=True)
class CharucoBoard:
    """Checkerboard with ArUco markers in its white squares: a part of it is enough.

    Attributes:
        columns, rows: number of squares.
        square: side of a square in the unit of the board, usually metres.
        marker: side of a marker in the same unit; 0 for three quarters of a square.
        dictionary: of the markers, the name in OpenCV without ``DICT_``, such as ``4X4_50``.

    Raises:
        DvoError: fewer than 3 squares in a row or column, sides that do not fit, or no such dictionary.
    """

    columns: int
    rows: int
    square: float = 1.0
    marker: float = 0.0
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        _check_sizes(self.columns, self.rows, self.square, 3, "charuco")
        if not 0 <= self.marker < self.square:
            message = f"a marker of {self.marker:g} in a square of {self.square:g}"
            raise DvoError(message, field="marker", remedy="give the side of a marker, which is smaller, in metres")
        _dictionary(self.dictionary)
        if self.columns * self.rows // 2 > len(_dictionary(self.dictionary).bytesList):
            message = f"{self.dictionary} has too few markers for {self.columns}x{self.rows} squares"
            raise DvoError(message, field="dictionary", remedy="give the dictionary of the board, such as 5X5_100")

    def __str__(self) -> str:
        """Name for messages."""
        return f"{self.columns}x{self.rows} ChArUco board ({self.dictionary})"

    @cached_property
    def points(self) -> np.ndarray:
        """``(M, 3)`` all corners."""
        return np.asarray(self._detectors[0].getBoard().getChessboardCorners(), np.float64)

    @cached_property
    def _detectors(self) -> list[Any]:
        """Detectors of the two patterns in use: OpenCV 4.6 changed the colour of the first square of even boards."""
        found = []
        for legacy in (False, True):
            board = cv2.aruco.CharucoBoard(
                (self.columns, self.rows),
                float(self.square),
                float(self.marker or 0.75 * self.square),
                _dictionary(self.dictionary),
            )
            board.setLegacyPattern(legacy)
            found.append(cv2.aruco.CharucoDetector(board))
        return found if self.rows % 2 == 0 else found[:1]

    def detect(self, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Find the corners beside markers that are seen; see :meth:`Board.detect`.

        Args:
            grey: ``(H, W)`` uint8.
        """
        best: tuple[np.ndarray, np.ndarray] | None = None
        for detector in self._detectors:
            corners, numbers = detector.detectBoard(grey)[:2]
            if numbers is None or len(numbers) < _MIN_CORNERS or (best is not None and len(numbers) <= len(best[0])):
                continue
            points = self.points[np.asarray(numbers).ravel()]
            if np.linalg.matrix_rank(points[:, :2] - points[0, :2], tol=1e-6) == 2:
                best = np.asarray(corners, np.float64).reshape(-1, 2), points
        if best is None:
            return None
        margin = (1 - (self.marker / self.square or 0.75)) / 2  # between a corner and the nearest marker
        return _refine(grey, *best, self.square, margin), best[1]

    def hint(self, images: Sequence[np.ndarray]) -> str:
        """Dictionary of markers that are there, or advice; see :meth:`Board.hint`.

        Args:
            images: some images without a detection.
        """
        for name in (self.dictionary, *_OTHERS):
            detector = cv2.aruco.ArucoDetector(_dictionary(name))
            most = max((len(detector.detectMarkers(image)[0]) for image in images), default=0)
            if most < 4:
                continue
            if name == self.dictionary:
                return (
                    f"{most} markers of {name} were seen: check the number of squares, COLUMNSxROWS, and the sides of "
                    "square and marker"
                )
            return f"markers of another dictionary were seen: give --dictionary {name.replace('1000', '50')}, or larger"
        return "no markers were seen: check --dictionary, and show the board larger, sharper and in even light"


def _dictionary(name: str) -> Any:
    number = getattr(cv2.aruco, f"DICT_{name.upper().removeprefix('DICT_')}", None)
    if number is None:
        remedy = "give a name such as 4X4_50, 5X5_100, 6X6_250, 7X7_1000 or ARUCO_ORIGINAL"
        raise DvoError(f"no dictionary {name[:40]!r} in OpenCV", field="dictionary", remedy=remedy)
    return cv2.aruco.getPredefinedDictionary(number)
