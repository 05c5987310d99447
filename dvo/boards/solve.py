"""Camera parameters from views of a plane board (Zhang, PAMI 2000), by OpenCV, with their covariance.

The parameters are ``fx fy cx cy`` and the coefficients of the lens model of :mod:`dvo.geometry.undistort`. OpenCV
minimises the squared distance of corners to reprojected points over parameters and poses of the board; the covariance
is that of the same least squares problem, the poses eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from dvo.boards.views import View

_START = (None, 0.3, 0.6, 1.0)  # focal lengths of the first guess over the width; None: OpenCV's own guess
_GOOD = 2.0  # pixels of the reprojection error at which no other guess is tried
NAMES = {
    False: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    True: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""Names of the parameters; the key tells whether the lens is a fisheye."""


@dataclass(frozen=True)
class Solution:
    """Camera and poses of the board.

    Attributes:
        values: ``fx fy cx cy`` and the coefficients.
        fisheye: lens model.
        poses: ``(V, 6)`` rotation vector and translation, board to camera, of each view.
        residuals: of each view ``(N, 2)`` reprojected point minus corner, pixels.
        covariance: ``(P, P)`` of ``values``; infinite where the views do not determine them.
    """

    values: np.ndarray
    fisheye: bool
    poses: np.ndarray
    residuals: tuple[np.ndarray, ...]
    covariance: np.ndarray

    @property
    def rms(self) -> float:
        """Root mean square of the distances of corners to reprojected points, pixels."""
        return _rms(np.concatenate(self.residuals))

    @property
    def view_rms(self) -> np.ndarray:
        """The same for each view."""
        return np.array([_rms(residual) for residual in self.residuals])

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of ``values``."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def tilts(self) -> np.ndarray:
        """Angle between the normal of the board and the optical axis in each view, degrees."""
        normals = np.array([cv2.Rodrigues(pose[:3])[0][2, 2] for pose in self.poses])
        return np.degrees(np.arccos(np.clip(np.abs(normals), 0, 1)))


def _rms(residuals: np.ndarray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def project(values: np.ndarray, fisheye: bool, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points of the board.

    Args:
        values: parameters of the camera, see :class:`Solution`.
        fisheye: lens model.
        pose: ``(6,)`` rotation vector and translation, board to camera.
        points: ``(N, 3)``.

    Returns:
        ``(N, 2)`` pixels, and the ``(N, 2, P + 6)`` Jacobian with respect to ``values`` and ``pose``.
    """
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
    lens, count = values[4:], len(values)
    if fisheye:
        pixels, jacobian = cv2.fisheye.projectPoints(points[None], pose[:3], pose[3:], matrix, lens)
        columns = [*range(8), *range(8, 14)]
    else:
        pixels, jacobian = cv2.projectPoints(points, pose[:3], pose[3:], matrix, lens)
        columns = [*range(6, 6 + count), *range(6)]
    return pixels.reshape(-1, 2), jacobian[:, columns].reshape(len(points), 2, count + 6)


def solve(
    views: Sequence[View], width: int, height: int, *, fisheye: bool = False, k3: bool = False
) -> Solution | None:
    """Solve for the camera.

    Args:
        views: of the board, at least three.
        width, height: of the images, pixels.
        fisheye: lens model ``fisheye``, else ``radtan``.
        k3: whether ``k3`` of ``radtan`` is free; otherwise there is none.

    Returns:
        The best solution from several starts; None if there is none.
    """
    best = None
    for start in _START:
        try:
            found = _from_opencv(views, width, height, fisheye, k3, start)
        except cv2.error:  # a singular system
            continue
        if found is not None and (best is None or found.rms < best.rms):
            best = found
        if best is not None and best.rms < _GOOD:
            break
    return best


def _from_opencv(
    views: Sequence[View], width: int, height: int, fisheye: bool, k3: bool, start: float | None
) -> Solution | None:
    size, flags = (width, height), 0
    matrix: Any = np.eye(3)
    if start is not None:
        focal = start * width
        matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    if fisheye:
        names = ["RECOMPUTE_EXTRINSIC", "FIX_SKEW"] + ([] if start is None else ["USE_INTRINSIC_GUESS"])
        where = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 5 has one set of flags
        flags = sum(getattr(where, f"CALIB_{name}") for name in names)
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-9)
        points = [view.points[None].astype(np.float64) for view in views]
        corners = [view.corners[None].astype(np.float64) for view in views]
        _, matrix, lens, turns, shifts = cv2.fisheye.calibrate(
            points, corners, size, matrix, np.zeros((4, 1)), flags=flags, criteria=criteria
        )
        lens = lens.ravel()[:4]
    else:
        flags = (0 if k3 else cv2.CALIB_FIX_K3) | (0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS)
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        _, matrix, lens, turns, shifts = cv2.calibrateCamera(
            [view.points.astype(np.float32) for view in views],
            [view.corners.astype(np.float32) for view in views],
            size, matrix, np.zeros((5, 1)), flags=flags, criteria=criteria,
        )  # fmt: skip
        lens = lens.ravel()[: 5 if k3 else 4]
    values = np.concatenate([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], lens])
    poses = np.array([np.concatenate([np.ravel(r), np.ravel(t)]) for r, t in zip(turns, shifts, strict=True)])
    if not (np.isfinite(values).all() and np.isfinite(poses).all() and (values[:2] > 0).all()):
        return None
    residuals, covariance = _covariance(values, fisheye, poses, views)
    if not all(np.isfinite(residual).all() for residual in residuals):
        return None
    return Solution(values, fisheye, poses, residuals, covariance)


def _covariance(
    values: np.ndarray, fisheye: bool, poses: np.ndarray, views: Sequence[View]
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Residuals, and the covariance of the camera's parameters with the poses eliminated (Schur complement).

    The variance of a coordinate of a corner is that of the residuals.
    """
    count = len(values)
    information, residuals = np.zeros((count, count)), []
    for view, pose in zip(views, poses, strict=True):
        pixels, jacobian = project(values, fisheye, pose, view.points)
        residuals.append(pixels - view.corners)
        rows = jacobian.reshape(-1, count + 6)
        of_camera, of_pose = rows[:, :count], rows[:, count:]
        basis, singular, _ = np.linalg.svd(of_pose, full_matrices=False)
        basis = basis[:, singular > 1e-12 * singular[0]]
        rest = of_camera - basis @ (basis.T @ of_camera)
        information += rest.T @ rest
    everything = np.concatenate(residuals)
    freedom = max(everything.size - count - 6 * len(views), 1)
    variance = max(float((everything**2).sum()) / freedom, 1e-6)  # thousandths of a pixel at least: exact corners too
    scale = np.sqrt(np.maximum(np.diagonal(information), 1e-30))
    eigenvalues, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if not eigenvalues[0] > 1e-13:
        return tuple(residuals), np.full((count, count), np.inf)
    inverse = (vectors / eigenvalues) @ vectors.T
    return tuple(residuals), variance * inverse / np.outer(scale, scale)
