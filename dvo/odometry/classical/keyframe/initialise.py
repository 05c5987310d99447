"""Start of a map from two views: homography or essential matrix, whichever explains the pairs (ORB-SLAM, section IV).

A plane, or too little parallax, leaves the essential matrix undetermined; a homography cannot explain a scene with
depth. Both are fitted, both are scored by their symmetric transfer error, and the share of the homography in the sum
decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from dvo.odometry.classical import two_view
from dvo.odometry.classical.keyframe.pose import reprojects

HOMOGRAPHY_LIMIT, EPIPOLAR_LIMIT = 5.99, 3.84
"""95 % of chi-squared with two and one degrees of freedom: squared errors, in units of the threshold's, above which
a pair scores nothing."""


@dataclass(frozen=True)
class Start:
    """Two views and what they saw.

    Attributes:
        T_21: ``(4, 4)`` first camera to second, translation of unit length.
        points: ``(N, 3)`` in the first camera, nan where not seen well.
        planar: whether the homography was chosen.
        parallax: median distance, pixels, between where the inliers are and where rotation alone would put them.
    """

    T_21: np.ndarray
    points: np.ndarray
    planar: bool
    parallax: float


def start_from_two_views(
    first: np.ndarray,
    second: np.ndarray,
    intrinsics: np.ndarray,
    *,
    threshold: float,
    reprojection: float,
    planar: float,
    seed: int,
) -> Start | None:
    """Motion and points, or None where neither model gives a clear answer.

    Args:
        first, second: ``(N, 2)`` pixels.
        threshold: inlier distance of the models, pixels (the standard deviation of the scores).
        reprojection: largest reprojection error of a point, pixels.
        planar: share of the homography's score from which it is chosen.
        seed: of the sampling.
    """
    pair = two_view.relative_pose(first, second, intrinsics, threshold, seed)
    if pair is None:
        return None
    H = fit_homography(first, second, threshold, seed)
    share = homography_share(H, fundamental(pair.T_21, intrinsics), first, second, threshold)
    if share <= planar or H is None:
        points = points_of_pair(first, second, pair.T_21, intrinsics, reprojection)
        points[~pair.inliers] = np.nan
        return Start(pair.T_21, points, False, pair.parallax)
    return _from_homography(H, first, second, intrinsics, threshold, reprojection)


def fit_homography(first: np.ndarray, second: np.ndarray, threshold: float, seed: int) -> np.ndarray | None:
    """``(3, 3)`` first to second in RANSAC, or None."""
    params = cv2.UsacParams()
    params.confidence, params.maxIterations, params.threshold = 0.9999, 2000, 2 * threshold
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MAGSAC
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_SIGMA, 10, 50
    params.randomGeneratorState = seed
    H, _ = cv2.findHomography(np.asarray(first, np.float64), np.asarray(second, np.float64), params)
    return H if H is not None and np.isfinite(H).all() and abs(np.linalg.det(H)) > 1e-12 else None


def fundamental(T_21: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """``(3, 3)`` with ``x2^T F x1 = 0`` in pixels."""
    inverse = np.linalg.inv(two_view.camera_matrix(intrinsics))
    return inverse.T @ np.cross(np.eye(3), T_21[:3, 3]) @ T_21[:3, :3] @ inverse


def homography_share(
    H: np.ndarray | None, F: np.ndarray, first: np.ndarray, second: np.ndarray, threshold: float
) -> float:
    """``S_H / (S_H + S_F)`` of ORB-SLAM, eq. 2; 0 without a homography."""
    if H is None:
        return 0.0
    one, two = np.column_stack([first, np.ones(len(first))]), np.column_stack([second, np.ones(len(second))])

    def transfer(M: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        moved = a @ M.T
        return ((moved[:, :2] / moved[:, 2:] - b[:, :2]) ** 2).sum(axis=1)

    def to_line(M: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        line = a @ M.T
        return (line * b).sum(axis=1) ** 2 / np.maximum((line[:, :2] ** 2).sum(axis=1), 1e-18)

    def total(errors: list[np.ndarray], limit: float) -> float:
        scaled = [np.nan_to_num(e / threshold**2, nan=np.inf) for e in errors]
        return float(sum(np.where(e < limit, HOMOGRAPHY_LIMIT - e, 0).sum() for e in scaled))

    by_plane = total([transfer(H, one, two), transfer(np.linalg.inv(H), two, one)], HOMOGRAPHY_LIMIT)
    by_lines = total([to_line(F, one, two), to_line(F.T, two, one)], EPIPOLAR_LIMIT)
    return by_plane / max(by_plane + by_lines, 1e-12)


def points_of_pair(
    first: np.ndarray, second: np.ndarray, T_21: np.ndarray, intrinsics: np.ndarray, reprojection: float
) -> np.ndarray:
    """Points ``(N, 3)`` in the first camera nearest to both rays; nan where behind, or where they reproject badly."""
    camera_two = -T_21[:3, :3].T @ T_21[:3, 3]
    ones = np.ones(len(first))
    terms = two_view.ray_terms(two_view.rays(first, intrinsics), np.zeros(3), ones)
    terms = terms + two_view.ray_terms(two_view.rays(second, intrinsics) @ T_21[:3, :3], camera_two, ones)
    points = two_view.solve_points(terms)
    good = reprojects(points, first, intrinsics, np.eye(4), reprojection)
    points[~(good & reprojects(points, second, intrinsics, T_21, reprojection))] = np.nan
    return points


def _from_homography(
    H: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    intrinsics: np.ndarray,
    threshold: float,
    reprojection: float,
) -> Start | None:
    """The decomposition with most points in front; None if a second one has nearly as many (or there is no motion)."""
    _, rotations, shifts, _ = cv2.decomposeHomographyMat(H, two_view.camera_matrix(intrinsics))
    starts = []
    for R, t in zip(rotations, shifts, strict=True):
        if np.linalg.norm(t) < 1e-6:
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t.ravel() / np.linalg.norm(t)
        points = points_of_pair(first, second, T, intrinsics, reprojection)
        turned = two_view.rays(first, intrinsics) @ R.T
        turned = turned[:, :2] / turned[:, 2:] * intrinsics[:2] + intrinsics[2:]
        parallax = float(np.median(np.linalg.norm(second - turned, axis=1)))
        starts.append(Start(T, points, True, parallax))
    starts.sort(key=lambda start: -int((~np.isnan(start.points[:, 0])).sum()))
    counts = [int((~np.isnan(start.points[:, 0])).sum()) for start in starts]
    if not starts or counts[0] == 0 or (len(starts) > 1 and counts[1] > 0.75 * counts[0]):
        return None
    return starts[0]
