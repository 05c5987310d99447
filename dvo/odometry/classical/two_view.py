"""Geometry of two views and of points seen from many: essential matrix, parallax, triangulation, pose from points."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class RelativePose:
    """Motion between two views from the essential matrix.

    Attributes:
        T_21: ``(4, 4)`` first camera to second, translation of unit length.
        inliers: ``(N,)`` bool, consistent with the motion and in front of both cameras.
        parallax: median distance in pixels between where the inliers are and where rotation alone would put them.
    """

    T_21: np.ndarray
    inliers: np.ndarray
    parallax: float


def rays(uv: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels ``(N, 2)`` to viewing rays ``(N, 3)`` with z = 1."""
    xy = (np.asarray(uv, np.float64) - intrinsics[2:]) / intrinsics[:2]
    return np.column_stack([xy, np.ones(len(xy))])


def project(points: np.ndarray, T_cw: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points ``(N, 3)`` to pixels ``(N, 2)`` and depths ``(N,)``; pixels of points behind the camera are nan.

    Args:
        points: world frame.
        T_cw: ``(4, 4)`` world to camera.
        intrinsics: ``(4,)`` fx fy cx cy, pixels.
    """
    local = points @ T_cw[:3, :3].T + T_cw[:3, 3]
    depth = local[:, 2]
    safe = np.where(depth > 1e-9, depth, np.nan)
    return local[:, :2] / safe[:, None] * intrinsics[:2] + intrinsics[2:], depth


def camera_matrix(intrinsics: np.ndarray) -> np.ndarray:
    """``fx fy cx cy`` to K ``(3, 3)``."""
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def rotation_between(first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """The rotation ``(3, 3)`` that best takes pixels of one view to another's if the camera only turned.

    Kabsch on unit rays, reweighted six times with Cauchy's weight at the median residual, so that near points that
    move by parallax count little.

    Args:
        first, second: ``(N, 2)`` pixels of the same points in two views.
        intrinsics: ``(4,)`` fx fy cx cy, pixels.
    """
    a, b = rays(first, intrinsics), rays(second, intrinsics)
    a, b = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in (a, b))
    weights = np.ones(len(a))
    rotation = np.eye(3)
    for _ in range(6):
        u, _, vt = np.linalg.svd((b * weights[:, None]).T @ a)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        residual = np.linalg.norm(b - a @ rotation.T, axis=1)
        weights = 1 / (1 + (residual / max(float(np.median(residual)), 1e-6)) ** 2)
    return rotation


def relative_pose(
    first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray, threshold: float, seed: int
) -> RelativePose | None:
    """Five-point essential matrix in a locally optimised RANSAC (USAC), then the motion that puts most points in front.

    Args:
        first, second: ``(N, 2)`` pixels.
        threshold: inlier distance to the epipolar line, pixels.
        seed: of the sampling.

    Returns:
        None with fewer than 8 pairs or inliers.
    """
    if len(first) < 8:
        return None
    params = cv2.UsacParams()
    params.confidence, params.maxIterations, params.threshold = 0.9999, 2000, threshold
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MAGSAC
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_SIGMA, 10, 50
    params.randomGeneratorState = seed
    K = camera_matrix(intrinsics)
    one, two = (np.ascontiguousarray(uv, np.float64) for uv in (first, second))
    E, mask = cv2.findEssentialMat(one, two, K, K, None, None, params)
    if E is None or E.shape != (3, 3) or int(mask.sum()) < 8:
        return None
    count, R, t, mask = cv2.recoverPose(E, one, two, K, mask=mask.copy())
    inliers = mask.ravel() > 0
    if count < 8 or not np.isfinite(R).all():
        return None
    T = refine_relative_pose(R, t.ravel(), one[inliers], two[inliers], intrinsics, threshold)
    turned = rays(one, intrinsics) @ T[:3, :3].T
    turned = turned[:, :2] / turned[:, 2:] * intrinsics[:2] + intrinsics[2:]
    return RelativePose(T, inliers, float(np.median(np.linalg.norm(two - turned, axis=1)[inliers])))


def refine_relative_pose(
    R: np.ndarray, t: np.ndarray, first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray, threshold: float
) -> np.ndarray:
    """Gauss-Newton on the Sampson error (Hartley & Zisserman, eq. 11.9), Huber at half the threshold; ``T_21 (4, 4)``.

    RANSAC ends at a fit to few pairs or an algebraic error, which over a short baseline is a tenth of a degree off.

    Args:
        R, t: ``(3, 3)`` and ``(3,)`` of ``T_21``, the translation of unit length.
        first, second: ``(N, 2)`` pixels of the same points in two views.
        intrinsics: ``(4,)`` fx fy cx cy, pixels.
        threshold: inlier threshold, pixels.
    """
    a, b = rays(first, intrinsics), rays(second, intrinsics)
    focal = float(intrinsics[:2].mean())

    def moved(step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return cv2.Rodrigues(step[:3])[0] @ R, cv2.Rodrigues(np.linalg.svd(t[None])[2][1:].T @ step[3:])[0] @ t

    def error(step: np.ndarray) -> np.ndarray:
        turn, shift = moved(step)
        E = np.cross(np.eye(3), shift) @ turn
        forth, back = a @ E.T, b @ E
        slope = np.sqrt((forth[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
        return focal * (b * forth).sum(axis=1) / np.maximum(slope, 1e-12)

    for _ in range(5):
        residual = error(np.zeros(5))
        weights = np.minimum(1, 0.5 * threshold / np.maximum(np.abs(residual), 1e-12))
        J = np.stack([(error(1e-6 * axis) - error(-1e-6 * axis)) / 2e-6 for axis in np.eye(5)], axis=1)
        H = J.T @ (weights[:, None] * J)
        step = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(5), J.T @ (weights * residual))
        after = error(step)
        if not np.isfinite(after).all() or (weights * after**2).sum() > (weights * residual**2).sum():
            break
        R, t = moved(step)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t / np.linalg.norm(t)
    return T


def ray_terms(directions: np.ndarray, centres: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Normal equations ``[A | b]`` ``(N, 3, 4)`` of "the point lies on this ray": ``w (I - d d^T) [I | c]``.

    Args:
        directions: ``(N, 3)`` world directions of any length.
        centres: ``(3,)`` or ``(N, 3)`` camera centres.
        weights: ``(N,)``; 1 / depth^2 makes the distance to the ray an angle.
    """
    d = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    A = weights[:, None, None] * (np.eye(3) - d[:, :, None] * d[:, None, :])
    return np.concatenate([A, A @ np.broadcast_to(centres, d.shape)[:, :, None]], axis=2)


def solve_points(normal: np.ndarray) -> np.ndarray:
    """Points ``(N, 3)`` closest to their rays, nan where the rays are parallel.

    Args:
        normal: ``(N, 3, 4)`` sums of :func:`ray_terms`.
    """
    points = np.full((len(normal), 3), np.nan)
    spread = np.linalg.eigvalsh(normal[:, :, :3]) if len(normal) else np.zeros((0, 3))
    good = spread[:, 0] > 1e-10 * np.maximum(spread[:, 2], 1e-300)
    points[good] = np.linalg.solve(normal[good, :, :3], normal[good, :, 3:])[:, :, 0]
    return points


def step_length(local: np.ndarray, seen: np.ndarray, T_21: np.ndarray) -> np.ndarray:
    """Lengths ``(M,)`` of a translation of known direction, one from every point that has a say.

    Args:
        local: ``(N, 3)`` points in the first camera.
        seen: ``(N, 3)`` rays to them in the second camera.
        T_21: first camera to second, translation of unit length.

    ``x x (R X + s t) = 0`` is solved for s; a ray along the translation has no information and is left out.
    """
    turned = np.cross(seen, local @ T_21[:3, :3].T)
    along = np.cross(seen, T_21[:3, 3])
    square = (along**2).sum(axis=1)
    lengths = -(along * turned).sum(axis=1) / np.maximum(square, 1e-12)
    return lengths[square > 1e-4]


def pose_from_points(
    points: np.ndarray, uv: np.ndarray, intrinsics: np.ndarray, threshold: float, seed: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """PnP in RANSAC, then Levenberg-Marquardt on the inliers, twice.

    Args:
        points: ``(N, 3)`` world.
        uv: ``(N, 2)`` pixels.
        threshold: inlier distance, pixels.
        seed: of the sampling.

    Returns:
        ``T_cw (4, 4)`` and inliers ``(N,)`` bool, or None.
    """
    if len(points) < 6:
        return None
    K = camera_matrix(intrinsics)
    cv2.setRNGSeed(seed)
    pixels = np.ascontiguousarray(uv, np.float64)
    ok, rvec, tvec, index = cv2.solvePnPRansac(
        points,
        pixels,
        K,
        None,
        iterationsCount=300,
        reprojectionError=threshold,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or index is None or len(index) < 6:
        return None
    inliers = np.zeros(len(points), bool)
    inliers[index.ravel()] = True
    T = np.eye(4)
    for _ in range(2):
        rvec, tvec = cv2.solvePnPRefineLM(points[inliers], pixels[inliers], K, None, rvec, tvec)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rvec)[0], tvec.ravel()
        error = np.linalg.norm(project(points, T, intrinsics)[0] - pixels, axis=1)
        inliers = np.nan_to_num(error, nan=np.inf) < threshold
        if inliers.sum() < 6 or not np.isfinite(T).all():
            return None
    return T, inliers
