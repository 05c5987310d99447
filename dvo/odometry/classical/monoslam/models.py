"""The two models of the filter with their Jacobians: how the camera moves, and where it sees a point.

Camera state: position ``r`` and attitude ``q`` (camera to world, ``qx qy qz qw``), velocity ``v`` in the world, angular
rate ``w`` in the camera. Errors are 12-vectors ``[dr, da, dv, dw]`` with ``R = R_hat Exp(da)``: the quaternion has four
numbers and three freedoms, so its uncertainty lives in the tangent space (Sola 2017, "Quaternion kinematics for the
error-state Kalman filter").

Point state: ``[x, y, z, azimuth, elevation, rho]``, the camera centre at first sight, the direction of the ray in the
world and the inverse of the distance along it (Civera, Davison, Montiel 2008, "Inverse depth parametrization for
monocular SLAM"). Points at infinity are ordinary members, so nothing is delayed until there is parallax.
"""

from __future__ import annotations

import numpy as np

CAMERA, POINT = 12, 6  # sizes of the error of the camera and of one point


def skew(v: np.ndarray) -> np.ndarray:
    """``(..., 3)`` to ``(..., 3, 3)`` with ``skew(a) b = a x b``."""
    x, y, z = np.moveaxis(np.asarray(v, float), -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def quaternion_exp(a: np.ndarray) -> np.ndarray:
    """Rotation vector ``(3,)`` to a unit quaternion ``qx qy qz qw``."""
    half = 0.5 * float(np.linalg.norm(a))
    return np.append(0.5 * np.sinc(half / np.pi) * np.asarray(a, float), np.cos(half))


def quaternion_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of two quaternions, normalised."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    product = np.append(vector, a[3] * b[3] - a[:3] @ b[:3])
    return product / np.linalg.norm(product)


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """Unit quaternion to ``(3, 3)``."""
    S = skew(q[:3])
    return np.eye(3) + 2 * q[3] * S + 2 * S @ S


def right_jacobian(a: np.ndarray) -> np.ndarray:
    """``(3, 3)`` J with ``Exp(a + da) = Exp(a) Exp(J da)`` to first order."""
    angle = float(np.linalg.norm(a))
    S = skew(a)
    if angle < 1e-5:
        return np.eye(3) - 0.5 * S
    return np.eye(3) - (1 - np.cos(angle)) / angle**2 * S + (angle - np.sin(angle)) / angle**3 * S @ S


def move(
    r: np.ndarray, q: np.ndarray, v: np.ndarray, w: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Constant velocity and angular rate for ``dt`` seconds (Davison 2007, section 3.3).

    Args:
        r, q: position ``(3,)`` and orientation ``(4,)`` of the camera, camera to world.
        v, w: velocity per second in the world ``(3,)``, angular rate ``(3,)`` in the camera, rad/s.
        dt: seconds.

    Returns:
        The new position and attitude, and the Jacobians ``F (12, 12)`` for the error of the state and ``G (12, 6)``
        for unknown impulses ``[V, W]`` that change velocity and angular rate at the start of the step.
    """
    turn = w * dt
    moved, turned = r + v * dt, quaternion_multiply(q, quaternion_exp(turn))
    F, G = np.eye(CAMERA), np.zeros((CAMERA, 6))
    F[0:3, 6:9] = G[0:3, 0:3] = dt * np.eye(3)
    F[3:6, 3:6] = rotation_matrix(quaternion_exp(turn)).T
    F[3:6, 9:12] = G[3:6, 3:6] = dt * right_jacobian(turn)
    G[6:9, 0:3] = G[9:12, 3:6] = np.eye(3)
    return moved, turned, F, G


def directions(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays ``(N, 3)`` of points ``(N, 6)`` in the world, and their slopes ``(N, 3, 2)`` by the two angles."""
    s, c = np.sin(points[:, 3]), np.cos(points[:, 3])
    S, C = np.sin(points[:, 4]), np.cos(points[:, 4])
    ray = np.stack([C * s, -S, C * c], -1)
    slope = np.stack([np.stack([C * c, np.zeros_like(c), -C * s], -1), np.stack([-S * s, -C, -S * c], -1)], -1)
    return ray, slope


def observe(
    r: np.ndarray, q: np.ndarray, points: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project points into a camera.

    Args:
        r, q: position and attitude of the camera.
        points: ``(N, 6)``.
        intrinsics: ``fx fy cx cy``.

    Returns:
        ``(N, 2)`` pixels; ``(N,)`` bool, in front; ``(N, 2, 6)`` Jacobians for ``[dr, da]``; ``(N, 2, 6)`` Jacobians
        for the points. Pixels of points that are not in front have no meaning.
    """
    R = rotation_matrix(q)
    ray, slope = directions(points)
    rho = points[:, 5, None]
    base = points[:, :3] - r
    local = (rho * base + ray) @ R  # rho times the point in the camera
    front = local[:, 2] > 1e-3
    z = np.where(front, local[:, 2], 1.0)
    pixels = local[:, :2] / z[:, None] * intrinsics[:2] + intrinsics[2:]
    D = np.zeros((len(points), 2, 3))
    D[:, 0, 0], D[:, 1, 1] = intrinsics[0] / z, intrinsics[1] / z
    D[:, :, 2] = -local[:, :2] / z[:, None] ** 2 * intrinsics[:2]
    DR = D @ R.T
    by_camera = np.concatenate([-rho[..., None] * DR, D @ skew(local)], -1)
    by_point = np.concatenate([rho[..., None] * DR, DR @ slope, DR @ base[:, :, None]], -1)
    return pixels, front, by_camera, by_point


def new_points(
    r: np.ndarray, q: np.ndarray, uv: np.ndarray, rho: float, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the rays of pixels that are seen for the first time.

    Args:
        uv: ``(N, 2)`` pixels.
        rho: inverse distance that they are given.

    Returns:
        ``(N, 6)`` points; ``(N, 6, 6)`` Jacobians for the camera's ``[dr, da]``; ``(N, 6, 3)`` Jacobians for
        ``[du, dv, drho]``.
    """
    R = rotation_matrix(q)
    local = np.column_stack([(uv - intrinsics[2:]) / intrinsics[:2], np.ones(len(uv))])
    h = local @ R.T
    flat = np.hypot(h[:, 0], h[:, 2])
    points = np.column_stack(
        [np.tile(r, (len(uv), 1)), np.arctan2(h[:, 0], h[:, 2]), np.arctan2(-h[:, 1], flat), np.full(len(uv), rho)]
    )
    A = np.zeros((len(uv), 2, 3))  # of the two angles by h
    A[:, 0, 0], A[:, 0, 2] = h[:, 2] / flat**2, -h[:, 0] / flat**2
    square = (h**2).sum(1)
    A[:, 1, 0], A[:, 1, 2] = h[:, 1] * h[:, 0] / flat / square, h[:, 1] * h[:, 2] / flat / square
    A[:, 1, 1] = -flat / square
    by_camera, by_pixel = np.zeros((len(uv), POINT, 6)), np.zeros((len(uv), POINT, 3))
    by_camera[:, :3, :3] = np.eye(3)
    by_camera[:, 3:5, 3:] = -A @ R @ skew(local)
    by_pixel[:, 3:5, :2] = A @ (R[:, :2] / intrinsics[:2])
    by_pixel[:, 5, 2] = 1
    return points, by_camera, by_pixel
