"""Pose of one view from known points, starting at a prediction (motion-only bundle adjustment)."""

from __future__ import annotations

import cv2
import numpy as np

from dvo.odometry.classical import two_view


def centre(T_cw: np.ndarray) -> np.ndarray:
    """Camera centre ``(3,)`` in the world."""
    return -T_cw[:3, :3].T @ T_cw[:3, 3]


def refine_pose(
    points: np.ndarray, uv: np.ndarray, intrinsics: np.ndarray, T_cw: np.ndarray, threshold: float, iterations: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton on the reprojection error with Cauchy's weight, whose width shrinks to half the threshold.

    Args:
        points: ``(N, 3)`` world.
        uv: ``(N, 2)`` pixels.
        T_cw: ``(4, 4)`` prediction.
        threshold: inlier distance, pixels.

    Returns:
        ``T_cw (4, 4)`` and inliers ``(N,)`` bool. With fewer than 3 points the prediction comes back.
    """
    T = T_cw.copy()
    for _ in range(iterations):
        local = points @ T[:3, :3].T + T[:3, 3]
        front = local[:, 2] > 1e-6
        if front.sum() < 3:
            break
        x, y, z = local[front].T
        residual = np.column_stack([x / z, y / z]) * intrinsics[:2] + intrinsics[2:] - uv[front]
        distance = np.linalg.norm(residual, axis=1)
        width = np.clip(1.5 * np.median(distance), 0.5 * threshold, 10 * threshold)
        weights = 1 / (1 + (distance / width) ** 2)
        J = pixel_jacobian(x, y, z, intrinsics)
        Jw = (J * weights[:, None, None]).reshape(-1, 6)
        H = Jw.T @ J.reshape(-1, 6)
        step = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), Jw.T @ residual.ravel())
        turn = cv2.Rodrigues(step[3:])[0]
        T[:3, :3], T[:3, 3] = turn @ T[:3, :3], turn @ T[:3, 3] + step[:3]
        if np.abs(step).max() < 1e-8:
            break
    # Products of many rotations drift from orthogonal.
    u, _, vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ vt
    return T, reprojects(points, uv, intrinsics, T, threshold)


def reprojects(
    points: np.ndarray, uv: np.ndarray, intrinsics: np.ndarray, T_cw: np.ndarray, threshold: float
) -> np.ndarray:
    """``(N,)`` bool: in front of the camera and within ``threshold`` of the pixel; False for nan."""
    pixels, depth = two_view.project(points, T_cw, intrinsics)
    error = np.nan_to_num(np.linalg.norm(pixels - uv, axis=1), nan=np.inf)
    return (depth > 0) & (error < threshold)


def pixel_jacobian(x: np.ndarray, y: np.ndarray, z: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Derivatives of pixels by a motion of the points ``Exp([tau, phi])`` from the left.

    Args:
        x, y, z: ``(N,)`` of the points in the camera.
        intrinsics: ``(4,)`` fx fy cx cy, pixels.

    Returns:
        d pixel / d (tau, phi) ``(N, 2, 6)``.
    """
    fx, fy = intrinsics[:2]
    zero = np.zeros_like(x)
    along_u = np.column_stack([fx / z, zero, -fx * x / z**2, -fx * x * y / z**2, fx * (1 + x**2 / z**2), -fx * y / z])
    along_v = np.column_stack([zero, fy / z, -fy * y / z**2, -fy * (1 + y**2 / z**2), fy * x * y / z**2, fy * x / z])
    return np.stack([along_u, along_v], axis=1)
