"""Views of a board: detection in the frames of a video, and the choice of views that differ."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from dvo.boards.board import Board
from dvo.data.frame import Frame

_REDUCED = 320  # pixels of the longer side of the image by which frames are compared
_KEPT, _KEPT_SIZE = 6, 640  # images without a detection that are kept for a hint, and their longer side


@dataclass(frozen=True)
class View:
    """Corners of the board in a frame.

    Attributes:
        index: of the frame.
        corners: ``(N, 2)`` pixels.
        points: ``(N, 3)`` of the board, Z = 0.
        sharpness: of the image of the board, relative; larger is sharper.
    """

    index: int
    corners: np.ndarray
    points: np.ndarray
    sharpness: float


@dataclass
class Search:
    """Result of :func:`find_views`.

    Attributes:
        views: in order of time.
        frames: number of frames that were read.
        examined: number of frames that were searched.
        width, height: of the images, pixels; 0 if there was none.
        example: ``(H, W, 3)`` uint8 image with the largest view of the board.
        example_index: index of its frame, -1 for none.
        unseen: some reduced images without a detection.
    """

    views: list[View] = field(default_factory=list)
    frames: int = 0
    examined: int = 0
    width: int = 0
    height: int = 0
    example: np.ndarray | None = None
    example_index: int = -1
    unseen: list[np.ndarray] = field(default_factory=list)


def find_views(
    frames: Iterable[Frame], board: Board, every: int = 1, on_frame: Callable[[int, int], None] | None = None
) -> Search:
    """Detect the board in frames.

    Args:
        frames: with lens distortion, as recorded.
        board: to look for.
        every: of so many consecutive frames, the sharpest is searched.
        on_frame: called after each search with the number of frames read and of views found.

    Returns:
        The views. Their images are not kept, but for one.
    """
    search, largest = Search(), 0.0
    unseen: list[tuple[float, int, np.ndarray]] = []
    for frame, score in _sharpest(frames, every, search):
        image = np.asarray(frame.image)
        search.height, search.width = image.shape[:2]
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        search.examined += 1
        found = board.detect(grey)
        if found is None:
            heapq.heappush(unseen, (score, frame.index, _reduced(grey, _KEPT_SIZE)))
            if len(unseen) > _KEPT:
                heapq.heappop(unseen)
        else:
            corners, points = found
            search.views.append(View(frame.index, corners, points, _board_sharpness(grey, corners)))
            area = float(np.prod(np.ptp(corners, axis=0)))
            if area > largest:
                largest, search.example, search.example_index = area, image.copy(), frame.index
        if on_frame is not None:
            on_frame(search.frames, len(search.views))
    search.unseen = [image for _, _, image in sorted(unseen, key=lambda entry: -entry[0])]
    return search


def _sharpest(frames: Iterable[Frame], every: int, search: Search) -> Iterator[tuple[Frame, float]]:
    """The sharpest frame of each ``every``, with its score."""
    best: tuple[float, Frame] | None = None
    for frame in frames:
        search.frames += 1
        grey = _reduced(cv2.cvtColor(np.asarray(frame.image), cv2.COLOR_RGB2GRAY), _REDUCED)
        score = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        if best is None or score > best[0]:
            best = score, frame
        if search.frames % every == 0:
            yield best[1], best[0]
            best = None
    if best is not None:
        yield best[1], best[0]


def _reduced(grey: np.ndarray, side: int) -> np.ndarray:
    scale = min(1.0, side / max(grey.shape))
    return grey if scale == 1 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _board_sharpness(grey: np.ndarray, corners: np.ndarray) -> float:
    """Power of the Laplacian over the contrast, times the spacing of the corners: larger squares have fewer edges."""
    low = np.maximum(corners.min(0).astype(int), 0)
    high = np.maximum(corners.max(0).astype(int) + 1, low + 8)
    part = grey[low[1] : high[1], low[0] : high[0]]
    if part.size == 0:
        return 0.0
    spacing = float(np.sqrt(np.prod(np.ptp(corners, axis=0)) / len(corners)))
    return float(cv2.Laplacian(part, cv2.CV_32F).var() / (part.var() + 1.0)) * spacing


def descriptors(views: Sequence[View], width: int, height: int) -> np.ndarray:
    """Numbers that tell where a view shows the board, and from what direction.

    Args:
        views: at least one.
        width, height: of the images, pixels.

    Returns:
        ``(N, 12)``: the four corners of a square on the board in the image, over half of its diagonal, and the
        logarithms of the ratios of its sides and of its diagonals, by which a tilt shows.
    """
    points = np.concatenate([view.points[:, :2] for view in views])
    low, high = points.min(0), points.max(0)
    square = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    scale, centre = np.hypot(width, height) / 2, np.array([width - 1, height - 1]) / 2
    rows = []
    for view in views:
        matrix, _ = cv2.findHomography(view.points[:, :2], view.corners, 0)
        if matrix is None:
            rows.append(np.zeros(12))
            continue
        image = cv2.perspectiveTransform(square[:, None], matrix)[:, 0]
        image = np.clip((image - centre) / scale, -2, 2)
        top, right, bottom, left = np.linalg.norm(image - np.roll(image, -1, axis=0), axis=1) + 1e-3
        first, second = np.linalg.norm(image[:2] - image[2:], axis=1) + 1e-3
        ratios = [top / bottom, left / right, first / second, np.sqrt(top * bottom / (left * right))]
        rows.append(np.concatenate([image.ravel(), np.log(ratios)]))
    return np.array(rows)


def choose_views(views: Sequence[View], count: int, width: int, height: int) -> list[View]:
    """Choose views that differ in position, size and tilt, sharp ones before blurred ones.

    The first is the sharpest; each further one is that with the largest distance from those chosen, in the space of
    :func:`descriptors`, times the sharpness over the median (0.25 to 1).

    Args:
        views: to choose from.
        count: number to choose, at most.
        width, height: of the images, pixels.

    Returns:
        In order of time.
    """
    if len(views) <= count:
        return list(views)
    places = descriptors(views, width, height)
    sharpness = np.array([view.sharpness for view in views])
    weight = np.clip(sharpness / max(float(np.median(sharpness)), 1e-9), 0.25, 1)
    chosen = [int(np.argmax(sharpness))]
    distance = np.full(len(views), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
        distance[chosen[-1]] = 0
        chosen.append(int(np.argmax(distance * weight)))
    return [views[i] for i in sorted(chosen)]
