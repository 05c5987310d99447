"""The extended Kalman filter over a camera and inverse-depth points. No images: pixels go in, a state comes out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.odometry.classical.monoslam.models import (
    CAMERA,
    POINT,
    move,
    new_points,
    observe,
    quaternion_exp,
    quaternion_multiply,
)


@dataclass(frozen=True)
class Prediction:
    """Predicted measurements, all arrays over the N points of the filter.

    Attributes:
        pixels: ``(N, 2)``.
        front: ``(N,)`` bool.
        slopes: ``(N, 2, 12)`` Jacobians, of the camera's ``[dr, da]`` and of the point itself.
        spread: ``(N, 2, 2)`` covariance of the pixel, noise included.
    """

    pixels: np.ndarray
    front: np.ndarray
    slopes: np.ndarray
    spread: np.ndarray


class Filter:
    """State and covariance.

    Attributes:
        r, q, v, w: camera, see :mod:`dvo.odometry.classical.monoslam.models`.
        points: ``(N, 6)``.
        P: ``(12 + 6 N, 12 + 6 N)`` covariance of the errors.
        intrinsics: ``fx fy cx cy``.
        noise: standard deviation of a measured pixel.
    """

    def __init__(self, intrinsics: np.ndarray, noise: float, speed: float, rate: float) -> None:
        """The world is where the camera is; it stands still up to ``speed`` and ``rate`` (standard deviations)."""
        self.r, self.q = np.zeros(3), np.array([0, 0, 0, 1.0])
        self.v, self.w = np.zeros(3), np.zeros(3)
        self.points = np.zeros((0, POINT))
        self.P = np.diag(np.repeat([0.0, 0.0, speed**2, rate**2], 3))
        self.intrinsics, self.noise = np.asarray(intrinsics, float), noise

    def __len__(self) -> int:
        return len(self.points)

    @property
    def rho_sigma(self) -> np.ndarray:
        """``(N,)`` standard deviation of the inverse distances."""
        return np.sqrt(np.maximum(np.diag(self.P)[CAMERA + POINT - 1 :: POINT], 0))

    def predict(self, dt: float, acceleration: float, angular: float) -> None:
        """Move on by ``dt`` seconds with unknown accelerations (standard deviations; map units / s^2, rad / s^2)."""
        self.r, self.q, F, G = move(self.r, self.q, self.v, self.w, dt)
        impulses = np.repeat([(acceleration * dt) ** 2, (angular * dt) ** 2], 3)
        c = slice(0, CAMERA)
        self.P[c, CAMERA:] = F @ self.P[c, CAMERA:]
        self.P[CAMERA:, c] = self.P[c, CAMERA:].T
        self.P[c, c] = F @ self.P[c, c] @ F.T + G * impulses @ G.T

    def expect(self) -> Prediction:
        """Predict the pixel of every point and its covariance."""
        pixels, front, by_camera, by_point = observe(self.r, self.q, self.points, self.intrinsics)
        slopes = np.concatenate([by_camera, by_point], -1)
        index = self._index(np.arange(len(self)))
        P = self.P[index[:, :, None], index[:, None, :]]
        spread = slopes @ P @ slopes.transpose(0, 2, 1) + self.noise**2 * np.eye(2)
        return Prediction(pixels, front, slopes, spread)

    def innovation(self, rows: np.ndarray, expected: Prediction) -> tuple[np.ndarray, np.ndarray]:
        """``H P (2 M, n)`` and ``S = H P H^T + noise (2 M, 2 M)`` of measurements of some points.

        H is never built in full: a pixel depends on twelve numbers of the state.
        """
        index, slopes = self._index(rows), expected.slopes[rows]
        HP = (slopes[:, :, :6].reshape(-1, 6) @ self.P[:6]).reshape(len(rows), 2, len(self.P))
        HP += slopes[:, :, 6:] @ self.P[index[:, 6:]]
        HP = HP.reshape(-1, len(self.P))
        S = (HP[:, index].transpose(1, 0, 2) @ slopes.transpose(0, 2, 1)).transpose(1, 0, 2)  # (2 M, M, 2)
        S = S.reshape(len(HP), len(HP))
        return HP, 0.5 * (S + S.T) + self.noise**2 * np.eye(len(HP))

    def update(self, rows: np.ndarray, seen: np.ndarray, expected: Prediction) -> None:
        """Take in measurements.

        Args:
            rows: ``(M,)`` which points.
            seen: ``(M, 2)`` pixels.
            expected: what :meth:`expect` gave for the present state.
        """
        if len(rows) == 0:
            return
        HP, S = self.innovation(rows, expected)
        # With S = L L^T and B = L^-1 HP, the gain times HP is B^T B.
        residual = (seen - expected.pixels[rows]).ravel()
        both = np.linalg.solve(np.linalg.cholesky(S), np.column_stack([HP, residual]))
        B = both[:, :-1]
        self.P -= B.T @ B
        self.P = 0.5 * (self.P + self.P.T)
        self.shift(B.T @ both[:, -1])

    def shift(self, change: np.ndarray) -> None:
        """Add an error-state vector to the state."""
        self.r, self.v, self.w = self.r + change[0:3], self.v + change[6:9], self.w + change[9:12]
        self.q = quaternion_multiply(self.q, quaternion_exp(change[3:6]))
        self.points = self.points + change[CAMERA:].reshape(-1, POINT)

    def add(self, uv: np.ndarray, rho: float, rho_sigma: float) -> None:
        """Begin points at pixels ``(M, 2)`` of the present view, at inverse distance ``rho`` up to ``rho_sigma``."""
        points, by_camera, by_pixel = new_points(self.r, self.q, uv, rho, self.intrinsics)
        old, J = len(self.P), by_camera.reshape(-1, 6)
        cross = J @ self.P[:6]
        corner = J @ self.P[:6, :6] @ J.T
        own = by_pixel * np.array([self.noise, self.noise, rho_sigma])
        for k, part in enumerate(own @ own.transpose(0, 2, 1)):
            corner[POINT * k : POINT * (k + 1), POINT * k : POINT * (k + 1)] += part
        P = np.zeros((old + len(J), old + len(J)))
        P[:old, :old], P[old:, :old], P[:old, old:], P[old:, old:] = self.P, cross, cross.T, corner
        self.P, self.points = P, np.concatenate([self.points, points])

    def keep(self, mask: np.ndarray) -> None:
        """Forget the points where ``mask`` is False (marginalise them out)."""
        rows = np.concatenate([np.ones(CAMERA, bool), np.repeat(mask, POINT)])
        self.P, self.points = self.P[np.ix_(rows, rows)], self.points[mask]

    def is_sound(self) -> bool:
        """Return True if all numbers are finite and variances positive."""
        return bool(np.isfinite(self.r).all() and np.isfinite(self.P).all() and (np.diag(self.P) > -1e-9).all())

    def _index(self, rows: np.ndarray) -> np.ndarray:
        """``(M, 12)`` rows of P on which the pixels of points depend: position and attitude, and the point."""
        own = CAMERA + POINT * np.asarray(rows)[:, None] + np.arange(POINT)
        return np.concatenate([np.tile(np.arange(6), (len(own), 1)), own], 1)
