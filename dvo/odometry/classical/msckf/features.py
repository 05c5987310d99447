"""Points seen from clones: triangulation, residuals without the point (null space), and the gate of chi-square."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.geometry.poses import skew, so3_exp

NEAREST, FARTHEST = 0.1, 200.0  # metres along the optical axis
ROUNDS = 6  # Gauss-Newton steps of a triangulation
GATE = 1.645  # normal quantile of the chi-square gate: 95 %


@dataclass(frozen=True)
class Views:
    """Observations of points, those of a point in a row.

    Attributes:
        point: ``(K,)`` number of the point, 0, 0, ..., 1, 1, ...
        clone: ``(K,)`` row of the clone that sees it.
        xy: ``(K, 2)`` on the plane z = 1 of the camera.
        delay: ``(K,)`` seconds from the time of the clone to that of the pixel's row.
    """

    point: np.ndarray
    clone: np.ndarray
    xy: np.ndarray
    delay: np.ndarray

    @property
    def count(self) -> int:
        """Number of points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    @property
    def begins(self) -> np.ndarray:
        """``(M + 1,)`` positions at which the observations of a point begin, and the end."""
        return np.searchsorted(self.point, np.arange(self.count + 1))


@dataclass(frozen=True)
class Clones:
    """Poses of the body at the times of images, N of them.

    Attributes:
        R: ``(N, 3, 3)`` body to world.
        p: ``(N, 3)`` metres.
        v: ``(N, 3)`` velocity in the world, m/s: moves a pose within the time of an image.
        rate: ``(N, 3)`` angular rate in the axes of the body, rad/s.
    """

    R: np.ndarray
    p: np.ndarray
    v: np.ndarray
    rate: np.ndarray

    def shifted(self, rows: np.ndarray, delay: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses at other times: ``R (K, 3, 3)``, ``p (K, 3)`` and the turn ``(K, 3, 3)`` since the clone."""
        turn = so3_exp(self.rate[rows] * delay[:, None])
        return self.R[rows] @ turn, self.p[rows] + self.v[rows] * delay[:, None], turn


@dataclass(frozen=True)
class Projected:
    """Residuals without the points.

    Attributes:
        residual: ``(m,)`` on the plane z = 1.
        jacobian: ``(m, n)`` with respect to the error of the state.
        begins: ``(M + 1,)`` rows at which points begin, and the end.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    begins: np.ndarray


def triangulate(views: Views, R_wc: np.ndarray, p_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points by the rays, then by Gauss-Newton over bearing and inverse depth in the first view (Montiel et al. 2006).

    Args:
        views: observations.
        R_wc, p_wc: ``(K, 3, 3)``, ``(K, 3)`` camera of every observation.

    Returns:
        ``(M, 3)`` points in the world, and ``(M,)`` bool, True for those that can be used.
    """
    from dvo.odometry.classical.msckf import features_kernels

    points, good = np.zeros((views.count, 3)), np.zeros(views.count, bool)
    features_kernels.triangulate(
        views.begins, np.ascontiguousarray(views.xy), np.ascontiguousarray(R_wc), np.ascontiguousarray(p_wc),
        NEAREST, FARTHEST, ROUNDS, points, good,
    )  # fmt: skip
    return points, good


@dataclass(frozen=True)
class Layout:
    """Columns of the error of the state that observations depend on; None for what is not estimated.

    Attributes:
        size: of the error.
        clones: ``(N,)`` first of the six columns ``[p, theta]`` of each clone.
        extrinsics: first of the six columns ``[p, theta]`` of the camera in the body.
        delay: column of a delay that all observations share.
    """

    size: int
    clones: np.ndarray
    extrinsics: int | None = None
    delay: int | None = None


def linearise(
    views: Views, points: np.ndarray, clones: Clones, first: Clones, R_bc: np.ndarray, p_bc: np.ndarray, layout: Layout
) -> Projected:
    """Residuals of points, projected to the left null space of their point Jacobian.

    Source: Mourikis & Roumeliotis 2007, eq. 20-24.

    Args:
        views: observations, of every point two or more.
        points: ``(M, 3)`` in the world.
        clones: where the residuals are computed.
        first: first estimates of the clones, at which the Jacobians are.
        R_bc, p_bc: camera in the body.
        layout: of the columns.
    """
    from dvo.odometry.classical.msckf import features_kernels

    R, p, _ = clones.shifted(views.clone, views.delay)
    body = (np.swapaxes(R, 1, 2) @ (points[views.point] - p)[..., None])[..., 0]
    local = (body - p_bc) @ R_bc
    residual = views.xy - local[:, :2] / np.maximum(local[:, 2:], 1e-3)
    R, p, turn = first.shifted(views.clone, views.delay)
    body = (np.swapaxes(R, 1, 2) @ (points[views.point] - p)[..., None])[..., 0]
    local = (body - p_bc) @ R_bc
    inverse = 1 / np.maximum(local[:, 2], 1e-3)
    slope = np.zeros((len(local), 2, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = inverse
    slope[:, :, 2] = -local[:, :2] * (inverse**2)[:, None]
    by_body = slope @ R_bc.T
    by_point = by_body @ np.swapaxes(R, 1, 2)
    by_turn = by_body @ skew(body)  # of the pose at the time of the row
    by_pose = np.concatenate([-by_point, by_turn @ np.swapaxes(turn, 1, 2)], 2)
    others, places = [np.zeros((len(local), 2, 0))], []
    if layout.extrinsics is not None:
        others += [-by_body, slope @ skew(local)]
        places += list(range(layout.extrinsics, layout.extrinsics + 6))
    if layout.delay is not None:
        others.append(by_turn @ first.rate[views.clone][..., None] - by_point @ first.v[views.clone][..., None])
        places.append(layout.delay)
    sizes = 2 * np.diff(views.begins) - 3
    begins = np.concatenate([[0], np.cumsum(sizes)])
    jacobian, free = np.zeros((begins[-1], layout.size)), np.zeros(begins[-1])
    features_kernels.project(
        views.begins, layout.clones[views.clone], by_pose, by_point, np.concatenate(others, 2), residual,
        np.array(places, np.int64), begins, jacobian, free,
    )  # fmt: skip
    return Projected(free, jacobian, begins)


def chi_square_bound(freedoms: int, quantile: float = GATE) -> float:
    """Quantile of the chi-square distribution (Wilson & Hilferty 1931).

    Args:
        freedoms: degrees of freedom.
        quantile: of the normal distribution.
    """
    part = 2 / (9 * freedoms)
    return freedoms * (1 - part + quantile * np.sqrt(part)) ** 3


def passing(measured: Projected, P: np.ndarray, sigma: float) -> np.ndarray:
    """Points whose residual is as large as the covariance of the state and the noise let expect.

    Args:
        measured: residuals with their Jacobian.
        P: ``(n, n)`` covariance of the state.
        sigma: of an observation on the plane z = 1.

    Returns:
        ``(M,)`` bool.
    """
    HP = measured.jacobian @ P
    passed = np.zeros(len(measured.begins) - 1, bool)
    for m, (begin, end) in enumerate(zip(measured.begins[:-1], measured.begins[1:], strict=True)):
        r = measured.residual[begin:end]
        S = HP[begin:end] @ measured.jacobian[begin:end].T
        S[np.diag_indices(len(r))] += sigma**2
        passed[m] = r @ np.linalg.solve(S, r) < chi_square_bound(len(r))
    return passed


def compressed(measured: Projected, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual and Jacobian of some points, turned so that no more rows than columns are left (ibid., eq. 26-28).

    Args:
        measured: residuals of all points.
        kept: ``(M,)`` bool.
    """
    rows = np.repeat(kept, np.diff(measured.begins))
    H, r = measured.jacobian[rows], measured.residual[rows]
    if len(r) > H.shape[1]:
        both: np.ndarray = np.asarray(np.linalg.qr(np.column_stack([H, r]), mode="r"))[: H.shape[1]]
        H, r = both[:, :-1], both[:, -1]
    return r, H
