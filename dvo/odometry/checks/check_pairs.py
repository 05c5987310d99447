"""Corners followed from one image to a later one: measurements that take no part in the trajectory, to check it by.

They come from another method than the network (Lucas-Kanade, forward and back), so that a network that is wrong with
confidence, or that follows something else than the scene, does not agree with them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from dvo.geometry import se3, so3

CORNERS = 120
"""Largest number of corners of a pair."""
MIN_CORNERS = 16
"""Corners below which a pair says nothing."""
MAX_PAIRS = 256
"""Pairs that are kept; those of a longer sequence are further apart."""
GAPS = (4, 32)
"""Frames from the first image to the second: at the beginning, and at most."""
DISPLACEMENTS = (2.0, 6.0, 20.0)
"""Median displacements of the corners of a pair, pixels: below the first they tell nothing and the second image is a
later one; the gap grows below the second, and shrinks above the third."""
WINDOW = (15, 15)
"""Pixels around a corner by which it is followed."""
RETURN = 0.4
"""Largest distance of a corner from where it was, followed forward and back, pixels."""

TURNED = 0.03
"""Distance of the corners from a turn of the camera, over their displacement, below which it explains their motion:
0.02 to 0.04 in recordings and renderings of cameras that turn, 0.05 and more in 22 recordings of cameras that move."""
_ROUNDS, _NOISE = 20, 0.05  # of the fit of a similarity, and of a corner, pixels
_TURN_ROUNDS = 8  # of the fit of a turn, whose start is near
_STRETCH = 0.4  # logarithm of the focal length of a turn over the one that was used, at most


@dataclass(frozen=True)
class CheckPair:
    """Corners of two images.

    Attributes:
        first, second: numbers of the frames in the log.
        points: ``(N, 4)`` float32 x, y in the first and in the second image, pixels.
        intrinsics: ``(4,)`` fx fy cx cy of the images.
    """

    first: int
    second: int
    points: np.ndarray
    intrinsics: np.ndarray


class CheckPairs:
    """Pairs of a sequence.

    Attributes:
        pairs: so far, in order of time.
        still: numbers of the first and the last of the frames through which the corners hardly moved.
    """

    def __init__(self) -> None:
        self.pairs: list[CheckPair] = []
        self.still: list[tuple[int, int]] = []
        self._gap, self._pause = GAPS[0], 0
        self._first: tuple[int, np.ndarray] | None = None
        self._next = 0

    def see(self, number: int, image: np.ndarray, intrinsics: np.ndarray, mask: np.ndarray | None) -> None:
        """Take the next frame with content.

        Args:
            number: of the frame in the log.
            image: ``(H, W, 3)`` uint8 RGB.
            intrinsics: ``(4,)`` fx fy cx cy.
            mask: ``(H, W)`` bool, False for ignored pixels; None: none.
        """
        if number < self._next:
            return
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        pause = 0
        if self._first is not None:
            first, before = self._first
            points = followed(before, grey, mask)
            moved = median_displacement(points)
            if len(points) >= MIN_CORNERS and moved < DISPLACEMENTS[0] and number < first + GAPS[1]:
                self._next = number + self._gap
                return
            if len(points) >= MIN_CORNERS:
                if moved >= DISPLACEMENTS[0]:
                    self.pairs.append(CheckPair(first, number, points, np.asarray(intrinsics, np.float64)))
                else:
                    self.still.append((first, number))
                pause = self._pause
            shorter, longer = len(points) < MIN_CORNERS or moved > DISPLACEMENTS[2], moved < DISPLACEMENTS[1]
            self._gap = max(self._gap // 2, 1) if shorter else min(2 * self._gap, GAPS[1]) if longer else self._gap
        if len(self.pairs) + len(self.still) > MAX_PAIRS:
            self.pairs, self.still, self._pause = self.pairs[::2], self.still[::2], 2 * self._pause + self._gap
        self._first, self._next = (None, number + pause) if pause else ((number, grey), number + self._gap)


def followed(first: np.ndarray, second: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Follow corners from an image to another one and back.

    Args:
        first, second: ``(H, W)`` uint8.
        mask: ``(H, W)`` bool, False for pixels without corners; None: none.

    Returns:
        ``(N, 4)`` float32 x, y in the first and in the second image.
    """
    # A window that reaches beyond the mask follows what is there: the edge of a bonnet stands still.
    valid = None if mask is None else cv2.erode(mask.astype(np.uint8), np.ones(WINDOW, np.uint8))
    corners = cv2.goodFeaturesToTrack(first, CORNERS, 0.01, 8, mask=valid)
    if corners is None:
        return np.zeros((0, 4), np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, np.zeros_like(corners), winSize=WINDOW)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, np.zeros_like(corners), winSize=WINDOW)
    near = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < RETURN
    kept = near & (found.ravel() > 0) & (returned.ravel() > 0)
    return np.concatenate([corners.reshape(-1, 2), there.reshape(-1, 2)], axis=1)[kept]


def median_displacement(points: np.ndarray) -> float:
    """Median displacement of corners, pixels.

    Args:
        points: ``(N, 4)`` x, y in the first and in the second image.

    Returns:
        0 without corners.
    """
    return float(np.median(np.linalg.norm(points[:, 2:] - points[:, :2], axis=1))) if len(points) else 0.0


def relief(pair: CheckPair, first_cw: np.ndarray, second_cw: np.ndarray) -> float:
    """How far the corners of a pair are from moving as a whole, over the parallax that the poses give them.

    A shift, a turn in the plane of the image and a zoom are fitted to the corners; what they leave is relief, or the
    perspective of a turn. A camera on a tripod that turns or zooms with a long lens leaves next to nothing, and so does
    one that moves before a flat picture: with an unknown focal length the two are the same.

    Args:
        pair: corners.
        first_cw, second_cw: ``(7,)`` poses ``T_cw`` of its frames.

    Returns:
        Median distance from the fit, over the median length of what the rotation does not explain; NaN where that is
        less than the first of :data:`DISPLACEMENTS`.
    """
    length = float(np.median(parallax(pair, first_cw, second_cw)))
    if not length >= DISPLACEMENTS[0]:
        return math.nan
    return float(np.median(_off_similarity(pair.points.astype(np.float64)))) / length


def parallax(pair: CheckPair, first_cw: np.ndarray, second_cw: np.ndarray) -> np.ndarray:
    """What the rotation of the poses does not explain of the motion of the corners of a pair.

    Args:
        pair: corners.
        first_cw, second_cw: ``(7,)`` poses ``T_cw`` of its frames.

    Returns:
        ``(N,)`` lengths, pixels.
    """
    fx, fy, cx, cy = pair.intrinsics
    points = pair.points.astype(np.float64)
    rays = torch.from_numpy(np.column_stack([(points[:, 0] - cx) / fx, (points[:, 1] - cy) / fy, np.ones(len(points))]))
    turn = se3.relative(*(torch.as_tensor(pose, dtype=torch.float64) for pose in (first_cw, second_cw)))[3:]
    turned = so3.rotate(turn.expand(len(rays), 4), rays).numpy()
    return np.linalg.norm(points[:, 2:] - turned[:, :2] / turned[:, 2:] * (fx, fy) - (cx, cy), axis=1)


def off_turn(pair: CheckPair) -> np.ndarray:
    """Distances of the corners of a pair from a turn of the camera, whose focal length may be another.

    Args:
        pair: corners.

    Returns:
        ``(N,)`` pixels, from the turn that most of them follow, with a focal length up to 1.5 times longer or shorter.
    """
    fx, fy, cx, cy = pair.intrinsics
    points = pair.points.astype(np.float64) - (cx, cy, cx, cy)
    first, second = points[:, :2] * (1, fx / fy), points[:, 2:] * (1, fx / fy)
    shift = np.median(second - first, axis=0) / fx
    turn, stretch, distances = cv2.Rodrigues(np.array([-shift[1], shift[0], 0.0]))[0], 0.0, np.zeros(len(points))
    for _ in range(_TURN_ROUNDS):
        focal = fx * math.exp(stretch)
        there = np.column_stack([first / focal, np.ones(len(first))]) @ turn.T
        z = np.maximum(there[:, 2], 0.1)
        u, v = there[:, 0] / z, there[:, 1] / z
        away = second - focal * np.column_stack([u, v])
        distances = np.linalg.norm(away, axis=1)
        weights = 1 / (distances**2 + max(float(np.median(distances)), _NOISE) ** 2)
        # Derivatives by a turn after this one and by the logarithm of the focal length.
        across = np.column_stack([-u * v, 1 + u * u, -v, u + (turn[0, 2] - u * turn[2, 2]) / z])
        down = np.column_stack([-1 - v * v, u * v, u, v + (turn[1, 2] - v * turn[2, 2]) / z])
        rows = focal * np.concatenate([across, down])
        weighted = rows * np.tile(weights, 2)[:, None]
        normal = weighted.T @ rows
        normal += np.diag(1e-6 * np.diag(normal) + 1e-12)
        step = np.linalg.solve(normal, weighted.T @ away.T.ravel())
        turn = cv2.Rodrigues(step[:3])[0] @ turn
        stretch = float(np.clip(stretch + step[3], -_STRETCH, _STRETCH))
    return distances


def turn_parallax(pairs: Sequence[tuple[CheckPair, np.ndarray, np.ndarray]]) -> float:
    """See :attr:`dvo.odometry.quality.Quality.turn_parallax`.

    Args:
        pairs: each with the ``(7,)`` poses ``T_cw`` of its frames, one at least.
    """
    moved = np.array([max(median_displacement(pair.points), 1e-6) for pair, *_ in pairs])
    away = np.array([np.median(off_turn(pair)) for pair, *_ in pairs])
    if not np.median(away / moved) < TURNED:
        return math.nan
    return float(np.median(np.array([np.median(parallax(*placed)) for placed in pairs]) / moved))


def _off_similarity(points: np.ndarray) -> np.ndarray:
    """Distances ``(N,)`` of corners ``(N, 4)`` from the similarity that most of them follow, pixels."""
    first, second = (points[:, k] + 1j * points[:, k + 1] for k in (0, 2))
    weights = np.ones(len(points))
    for _ in range(_ROUNDS):
        weights = weights / weights.sum()
        a, b = first - weights @ first, second - weights @ second
        factor = (weights * a.conj()) @ b / max(float(weights @ np.abs(a) ** 2), 1e-12)
        distances = np.abs(b - factor * a)
        weights = 1 / (distances**2 + max(float(np.median(distances)), _NOISE) ** 2)
    return distances


def epipolar_distances(pair: CheckPair, first_cw: np.ndarray, second_cw: np.ndarray) -> np.ndarray:
    """Sampson distances of the corners of a pair from the epipolar geometry of two poses.

    Without translation any epipolar geometry holds for what the rotation explains.

    Args:
        pair: corners.
        first_cw, second_cw: ``(7,)`` poses ``T_cw`` of its frames.

    Returns:
        ``(N,)`` pixels (Hartley and Zisserman, Multiple View Geometry, 11.4.3).
    """
    fx, fy, cx, cy = pair.intrinsics
    points = pair.points.astype(np.float64)
    a, b = (
        np.column_stack([(p[:, 0] - cx) / fx, (p[:, 1] - cy) / fy, np.ones(len(p))])
        for p in (points[:, :2], points[:, 2:])
    )
    poses = (torch.as_tensor(pose, dtype=torch.float64) for pose in (first_cw, second_cw))
    motion = se3.matrix(se3.relative(*poses)).numpy()
    x, y, z = motion[:3, 3] / max(float(np.linalg.norm(motion[:3, 3])), 1e-12)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3]
    lines, back = a @ essential.T, b @ essential
    gradient = (lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    return np.abs((b * lines).sum(1)) / np.sqrt(np.maximum(gradient, 1e-18)) * np.sqrt(fx * fy)
