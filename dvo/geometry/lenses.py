"""Lens models by name, and rays through them in both directions.

A model is two steps. The *bend* takes the angle of a ray from the optical axis to a radius in the plane; the *warp*
moves a point of the plane. The result is in normalised coordinates: a pixel is ``(fx x + cx, fy y + cy)``. Formulas,
for a ray ``(X, Y, Z)`` with ``R = |(X, Y)|``, ``d = |(X, Y, Z)|`` and the angle ``theta = atan2(R, Z)``:

* ``none``: ``R / Z``.
* ``radtan``: OpenCV's (docs of calib3d; Brown 1966), ``k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]``: the bend is
  ``R / Z``, the warp ``x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y +
  p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4``, ``y' = y (...) / (...) + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4``.
* ``fisheye``: Kannala and Brandt 2006 as in ``cv2.fisheye``, ``k1 k2 k3 k4``: ``theta (1 + k1 theta^2 + ... + k4
  theta^8)``.
* ``ucm``: unified camera model as in basalt (Usenko, Demmel, Cremers, "The Double Sphere Camera Model", 3DV 2018),
  ``alpha``: ``R / (alpha d + (1 - alpha) Z)``.
* ``mei``: the same sphere with another focal length (Mei and Rives, ICRA 2007; ``cv2.omnidir``), ``xi [k1 k2 p1 p2
  [k3]]``: ``R / (Z + xi d)``, then the warp of ``radtan``.
* ``eucm``: enhanced unified camera model (Khomutenko, Garcia, Martinet, RA-L 2016), ``alpha beta``:
  ``R / (alpha sqrt(beta R^2 + Z^2) + (1 - alpha) Z)``.
* ``double_sphere``: the paper of basalt, ``xi alpha``: ``R / (alpha sqrt(R^2 + z^2) + (1 - alpha) z)`` with
  ``z = xi d + Z``.
* ``fov``: Devernay and Faugeras 2001, as in PTAM, DSO and COLMAP, ``w``: ``atan(2 tan(theta) tan(w / 2)) / w``.
* ``thin_prism_fisheye``: COLMAP's, ``k1 k2 p1 p2 k3 k4 sx1 sy1``: the bend is ``theta``, the warp ``u (1 + k1 r^2 +
  ... + k4 r^8)`` with the terms of p1, p2, s1 and s3 above.
* ``fisheye624``: that of Project Aria (COLMAP's ``RAD_TAN_THIN_PRISM_FISHEYE``), ``k1 ... k6 p1 p2 s1 s2 s3 s4``: the
  bend is ``theta (1 + k1 theta^2 + ... + k6 theta^12)``, the warp has the terms of p1, p2 and s1 to s4 above, with p1
  and p2 in the other order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from dvo.core.errors import DvoError

DistortionModel = Literal[
    "none", "radtan", "fisheye", "ucm", "mei", "eucm", "double_sphere", "fov", "thin_prism_fisheye", "fisheye624"
]

_SAMPLES = 4096  # of the angle from the axis, to find where a model folds back
_PLANE = math.pi / 2  # no plane holds a ray of this angle
_Bend = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Lens:
    """Lens model.

    Attributes:
        names: of the coefficients.
        counts: numbers of coefficients that may be given; the rest is 0.
        bend: radius in the plane and its derivative from angles (radians) and coefficients; None for ``tan``. A
            derivative that is not positive says that the model does not reach that angle.
        warp: coefficients of the plane from those of the lens, see :func:`_warp`; None without such a step.
        widest: angle that the bend is defined up to.
        limits: open interval of a coefficient by its name.
    """

    names: tuple[str, ...]
    counts: tuple[int, ...]
    bend: _Bend | None = None
    warp: Callable[[np.ndarray], np.ndarray] | None = None
    widest: float = math.pi
    limits: tuple[tuple[str, float, float], ...] = ()

    def padded(self, coefficients: tuple[float, ...]) -> np.ndarray:
        """``(len(names),)`` float64 coefficients, 0 where none is given.

        Args:
            coefficients: of a camera.
        """
        found = np.zeros(len(self.names))
        found[: len(coefficients)] = coefficients
        return found

    def check(self, coefficients: tuple[float, ...], name: str) -> None:
        """Refuse what cannot be the coefficients of the model.

        Args:
            coefficients: of a camera.
            name: of the model.

        Raises:
            DvoError: another number of coefficients, or one outside of its limits.
        """
        if len(coefficients) not in self.counts:
            raise DvoError(
                f"{len(coefficients)} coefficients for the model {name}",
                field="coefficients",
                remedy=f"{name} has {' '.join(self.names) or 'none'} ({', '.join(map(str, self.counts))} numbers)",
            )
        given = dict(zip(self.names, coefficients, strict=False))
        for key, low, high in self.limits:
            if not low < given.get(key, 0.0) < high:  # NaN fails too
                raise DvoError(
                    f"{key}={given.get(key, 0.0):g} is no coefficient of the model {name}",
                    field="coefficients",
                    remedy=f"{name} has {' '.join(self.names)} with {key} between {low:g} and {high:g}",
                )


def _odd(theta: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``theta (1 + k1 theta^2 + k2 theta^4 + ...)`` and its derivative."""
    t2 = theta * theta
    value, slope = np.zeros_like(theta), np.zeros_like(theta)
    for n in range(len(k), 0, -1):
        value, slope = t2 * (k[n - 1] + value), t2 * ((2 * n + 1) * k[n - 1] + slope)
    return theta * (1 + value), 1 + slope


def _over(s: np.ndarray, c: np.ndarray, below: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``sin / below`` and its derivative, -1 where ``below`` is not positive: no place shows such a ray."""
    safe = np.where(below > 0, below, 1.0)
    return s / safe, np.where(below > 0, (c * below - s * change) / safe**2, -1.0)


def _ucm(theta: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s, c = np.sin(theta), np.cos(theta)
    return _over(s, c, k[0] + (1 - k[0]) * c, (k[0] - 1) * s)


def _mei(theta: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s, c = np.sin(theta), np.cos(theta)
    return _over(s, c, k[0] + c, -s)


def _eucm(theta: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s, c = np.sin(theta), np.cos(theta)
    alpha, beta = k
    d = np.sqrt(beta * s * s + c * c)
    return _over(s, c, alpha * d + (1 - alpha) * c, alpha * (beta - 1) * s * c / d - (1 - alpha) * s)


def _double_sphere(theta: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s, c = np.sin(theta), np.cos(theta)
    xi, alpha = k
    z = xi + c
    d = np.sqrt(s * s + z * z)
    safe = np.where(d > 0, d, 1.0)
    return _over(s, c, alpha * d + (1 - alpha) * z, -alpha * s * xi / safe - (1 - alpha) * s)


def _fov(theta: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s, c = np.sin(theta), np.cos(theta)
    t = 2 * math.tan(k[0] / 2)
    return np.arctan2(t * s, c) / k[0], t / (c * c + t * t * s * s) / k[0]


def _brown(k: np.ndarray) -> np.ndarray:
    """Coefficients of the plane from OpenCV's order ``k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4``."""
    k = np.concatenate([k, np.zeros(12 - len(k))])
    return np.concatenate([k[[0, 1, 4]], [0.0], k[5:8], k[2:4], k[8:12]])


def _prism(k: np.ndarray) -> np.ndarray:
    """The same from COLMAP's ``k1 k2 p1 p2 k3 k4 sx1 sy1``."""
    return np.concatenate([k[[0, 1, 4, 5]], np.zeros(3), k[2:4], [k[6], 0.0, k[7], 0.0]])


def _aria(k: np.ndarray) -> np.ndarray:
    """The same from ``k1 ... k6 p1 p2 s1 s2 s3 s4``, whose p1 is OpenCV's p2."""
    return np.concatenate([np.zeros(7), k[[7, 6]], k[8:12]])


_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
_UNIT = ("alpha", -1e-12, 1 + 1e-12)
LENSES: dict[DistortionModel, Lens] = {
    "none": Lens((), (0,), widest=_PLANE),
    "radtan": Lens(_BROWN, (0, 4, 5, 8, 12), warp=_brown, widest=_PLANE),
    "fisheye": Lens(("k1", "k2", "k3", "k4"), (0, 1, 2, 3, 4), _odd),
    "ucm": Lens(("alpha",), (1,), _ucm, limits=(_UNIT,)),
    "mei": Lens(("xi", *_BROWN[:5]), (1, 5, 6), _mei, lambda k: _brown(k[1:]), limits=(("xi", -1, 100),)),
    "eucm": Lens(("alpha", "beta"), (2,), _eucm, limits=(_UNIT, ("beta", 0, 100))),
    "double_sphere": Lens(("xi", "alpha"), (2,), _double_sphere, limits=(("xi", -1, 100), _UNIT)),
    "fov": Lens(("w",), (1,), _fov, widest=_PLANE, limits=(("w", 0, math.pi),)),
    "thin_prism_fisheye": Lens(
        ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), (8,), lambda t, k: (t, np.ones_like(t)), _prism
    ),
    "fisheye624": Lens(
        ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4"), (12,),
        lambda t, k: _odd(t, k[:6]), _aria,
    ),
}  # fmt: skip
"""Models by name; :mod:`dvo.geometry.lenses` has their formulas and sources."""
assert set(LENSES) == set(get_args(DistortionModel))


def _radial(r2: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radial factor of the warp and its derivative with respect to ``r^2``."""
    k1, k2, k3, k4 = w[:4]
    if k4:
        top, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))), k1 + r2 * (2 * k2 + r2 * (3 * k3 + 4 * k4 * r2))
    else:
        top, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * k3 * r2)
    if not w[4:7].any():
        return top, slope
    k4, k5, k6 = w[4:7]
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    change = k4 + r2 * (2 * k5 + 3 * k6 * r2)
    safe = np.where(below > 0, below, 1.0)
    factor = top / safe
    return factor, np.where(below > 0, (slope - factor * change) / safe, -np.inf)


def _warp(points: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Warped points ``(..., 2)`` and the Jacobian ``(..., 2, 2)`` with respect to the points.

    Coefficients ``w``: ``(13,)``, four of the numerator, three of the denominator, p1, p2, s1, s2, s3, s4.
    """
    p1, p2, s1, s2, s3, s4 = w[7:]
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial, slope = _radial(r2, w)
    to_x, to_y = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    off_diagonal = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    rows = [
        [radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, off_diagonal],
        [off_diagonal, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x],
    ]
    if w[9:].any():
        to_x, to_y = to_x + r2 * (s1 + s2 * r2), to_y + r2 * (s3 + s4 * r2)
        along = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
        rows = [
            [entry + a * z for entry, z in zip(row, (x, y), strict=True)] for row, a in zip(rows, along, strict=True)
        ]
    return np.stack([to_x, to_y], axis=-1), np.stack([np.stack(row, -1) for row in rows], axis=-2)


@dataclass(frozen=True)
class _Profile:
    """Increasing function of an angle, tabulated up to where it folds back.

    Attributes:
        function: value and derivative.
        angles, values: of the table; the last is the end of the range.
    """

    function: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    angles: np.ndarray
    values: np.ndarray

    def invert(self, radius: np.ndarray, iterations: int = 60) -> np.ndarray:
        """Angles of the radii, NaN beyond the range: Newton's method within the cell of the table."""
        cell = np.clip(np.searchsorted(self.values, radius), 1, len(self.values) - 1)
        low, high = self.angles[cell - 1], self.angles[cell]
        below, above = self.values[cell - 1], self.values[cell]
        found = low + (high - low) * np.clip((radius - below) / np.maximum(above - below, 1e-300), 0, 1)
        for _ in range(iterations):
            value, slope = self.function(found)
            low, high = np.where(value <= radius, found, low), np.where(value >= radius, found, high)
            better = found - (value - radius) / np.where(slope > 0, slope, 1.0)
            better = np.where((slope > 0) & (better >= low) & (better <= high), better, (low + high) / 2)
            done = not (np.abs(better - found) > 1e-16).any()
            found = better
            if done:
                break
        return np.where(radius <= self.values[-1], found, np.nan)


def _profile(function: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], widest: float) -> _Profile:
    angles = np.linspace(0, widest, _SAMPLES + 1)
    if widest == _PLANE:
        angles = angles[:-1]
    with np.errstate(all="ignore"):
        values, slopes = function(angles)
        rising = (slopes > 0) & np.isfinite(values)
        if not rising.all():
            last = int(np.argmin(rising))
            if last == 0:
                return _Profile(function, np.zeros(2), np.zeros(2))
            low, high = angles[last - 1], angles[last]
            for _ in range(60):
                middle = (low + high) / 2
                value, slope = function(np.array([middle]))
                low, high = (middle, high) if slope[0] > 0 and np.isfinite(value[0]) else (low, middle)
            angles = np.append(angles[:last], low)
            values = function(angles)[0]
    return _Profile(function, angles, np.maximum.accumulate(values))


@lru_cache(maxsize=64)
def _bent(model: DistortionModel, coefficients: tuple[float, ...]) -> _Profile | None:
    lens = LENSES[model]
    bend, k = lens.bend, lens.padded(coefficients)
    return None if bend is None else _profile(lambda theta: bend(theta, k), lens.widest)


@lru_cache(maxsize=64)
def _warped(model: DistortionModel, coefficients: tuple[float, ...]) -> tuple[np.ndarray, _Profile] | None:
    """Coefficients of the warp, and its radial part as a function of ``atan(r)``."""
    lens = LENSES[model]
    if lens.warp is None:
        return None
    w = lens.warp(lens.padded(coefficients))
    if not w.any():
        return None

    def function(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.tan(angle)
        factor, slope = _radial(r * r, w)
        return r * factor, (factor + 2 * r * r * slope) * (1 + r * r)

    return w, _profile(function, _PLANE)


def distort_plane(points: np.ndarray, model: DistortionModel, coefficients: tuple[float, ...]) -> np.ndarray:
    """Normalised coordinates through the lens.

    Args:
        points: ``(..., 2)`` ideal ones, ``(X / Z, Y / Z)``.
        model, coefficients: of the lens.

    Returns:
        ``(..., 2)`` float64 distorted ones; beyond the range of the model what its formula gives.
    """
    lens = LENSES[model]
    if lens.bend is not None:
        r = np.linalg.norm(points, axis=-1, keepdims=True)
        bent, slope = lens.bend(np.arctan(r), lens.padded(coefficients))
        near, _ = lens.bend(np.full_like(r, 1e-9), lens.padded(coefficients))
        points = points * np.where(r > 1e-9, bent / np.where(r > 1e-9, r, 1.0), near / 1e-9)
    warped = _warped(model, coefficients)
    return points.copy() if warped is None else _warp(points, warped[0])[0]


def distort_rays(rays: np.ndarray, model: DistortionModel, coefficients: tuple[float, ...]) -> np.ndarray:
    """Rays through the lens, also those that look sideways and backwards.

    Args:
        rays: ``(..., 3)`` of any length, x right, y down, z forward.
        model, coefficients: of the lens.

    Returns:
        ``(..., 2)`` distorted normalised coordinates; NaN for rays outside of the range of the model.
    """
    lens, bent = LENSES[model], _bent(model, coefficients)
    rays = np.asarray(rays, dtype=np.float64)
    aside = np.linalg.norm(rays[..., :2], axis=-1)
    theta = np.arctan2(aside, rays[..., 2])
    if bent is None or lens.bend is None:
        ahead = rays[..., 2] > 0
        radius = np.where(ahead, aside / np.where(ahead, rays[..., 2], 1.0), np.nan)
    else:
        inside = theta <= bent.angles[-1]
        radius = np.where(inside, bent.function(np.where(inside, theta, 0.0))[0], np.nan)
    plane = rays[..., :2] * (radius / np.where(aside > 0, aside, 1.0))[..., None]
    warped = _warped(model, coefficients)
    if warped is None:
        return plane
    w, profile = warped
    within = radius <= math.tan(profile.angles[-1])
    return np.where(within[..., None], _warp(np.where(within[..., None], plane, 0.0), w)[0], np.nan)


def undistort_to_rays(
    points: np.ndarray, model: DistortionModel, coefficients: tuple[float, ...], iterations: int = 20
) -> np.ndarray:
    """Inverse of :func:`distort_rays` by Newton's method, begun within the range of the model.

    Args:
        points: ``(..., 2)`` distorted normalised coordinates.
        model, coefficients: of the lens.
        iterations: most steps of Newton's method in the plane.

    Returns:
        ``(..., 3)`` unit rays; NaN where no ray comes from.
    """
    plane = _unwarp(np.asarray(points, dtype=np.float64), model, coefficients, iterations)
    radius = np.linalg.norm(plane, axis=-1)
    bent = _bent(model, coefficients)
    theta = np.arctan(radius) if bent is None else bent.invert(radius)
    direction = plane / np.where(radius > 0, radius, 1.0)[..., None]
    return np.concatenate([direction * np.sin(theta)[..., None], np.cos(theta)[..., None]], axis=-1)


def undistort_plane(
    points: np.ndarray, model: DistortionModel, coefficients: tuple[float, ...], iterations: int = 20
) -> np.ndarray:
    """Inverse of :func:`distort_plane`.

    Args:
        points: ``(..., 2)`` distorted normalised coordinates.
        model, coefficients: of the lens.
        iterations: most steps of Newton's method in the plane.

    Returns:
        ``(..., 2)`` ideal normalised coordinates; NaN where no ray comes from, or one of 90 degrees and more.
    """
    plane = _unwarp(np.asarray(points, dtype=np.float64), model, coefficients, iterations)
    bent = _bent(model, coefficients)
    if bent is None:
        return plane
    radius = np.linalg.norm(plane, axis=-1)
    theta = bent.invert(radius)
    ahead = theta < _PLANE - 1e-6  # NaN fails too
    reached, _ = bent.function(np.full_like(radius, 1e-9))
    ratio = np.tan(np.where(ahead, theta, 0.0)) / np.where(radius > 1e-9, radius, 1.0)
    ratio = np.where(radius > 1e-9, ratio, 1e-9 / reached)
    return np.where(ahead[..., None], plane * ratio[..., None], np.nan)


def _unwarp(points: np.ndarray, model: DistortionModel, coefficients: tuple[float, ...], iterations: int) -> np.ndarray:
    """Points of the plane before the warp; NaN where there is none."""
    warped = _warped(model, coefficients)
    if warped is None:
        return points.copy()
    w, profile = warped
    radius = np.linalg.norm(points, axis=-1)
    end = float(profile.angles[-1])
    # The radial part alone is one-dimensional and safe to invert: what it gives is on the right side of a fold.
    near = np.tan(np.nan_to_num(profile.invert(np.minimum(radius, profile.values[-1])), nan=end))
    ideal = points * (near / np.where(radius > 0, radius, 1.0))[..., None]
    limit = math.tan(end)
    for _ in range(iterations):
        value, jacobian = _warp(ideal, w)
        residual = value - points
        determinant = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
        safe = np.where(np.abs(determinant) > 1e-6, determinant, 1e-6)
        step = np.stack(
            [
                jacobian[..., 1, 1] * residual[..., 0] - jacobian[..., 0, 1] * residual[..., 1],
                jacobian[..., 0, 0] * residual[..., 1] - jacobian[..., 1, 0] * residual[..., 0],
            ],
            axis=-1,
        )
        step = np.clip(step / safe[..., None], -0.3, 0.3)
        ideal = ideal - step
        if not (np.abs(step) > 1e-15 * (1 + np.abs(ideal))).any():
            break
    size = np.linalg.norm(ideal, axis=-1)
    with np.errstate(invalid="ignore"):
        value, _ = _warp(ideal, w)
        error = np.abs(value - points).max(axis=-1)
    found = (error < 1e-9 * (1 + radius)) & (size <= limit)
    return np.where(found[..., None], ideal, np.nan)


def in_range_plane(points: np.ndarray, model: DistortionModel, coefficients: tuple[float, ...]) -> np.ndarray:
    """Test whether ideal normalised coordinates lie within the range of a model.

    Args:
        points: ``(..., 2)``.
        model, coefficients: of the lens.

    Returns:
        ``(...)`` bool, True where the distorted radius grows all the way from the centre to the point.
    """
    r = np.linalg.norm(points, axis=-1)
    bent, warped = _bent(model, coefficients), _warped(model, coefficients)
    inside = np.isfinite(r)
    if bent is not None:
        inside &= np.arctan(r) < bent.angles[-1]
        r = bent.function(np.where(inside, np.arctan(r), 0.0))[0]
    if warped is not None and warped[1].angles[-1] < _PLANE * (1 - 1.5 / _SAMPLES):
        inside &= r < math.tan(warped[1].angles[-1])
    return np.asarray(inside)


def widest_angle(model: DistortionModel, coefficients: tuple[float, ...]) -> float:
    """Largest angle from the optical axis that a model reaches, radians.

    Args:
        model, coefficients: of the lens.
    """
    bent, warped = _bent(model, coefficients), _warped(model, coefficients)
    angle = _PLANE if bent is None else float(bent.angles[-1])
    if warped is None:
        return angle
    end = float(warped[1].angles[-1])
    if bent is None:
        return end
    return float(np.nan_to_num(bent.invert(np.array([math.tan(end)])), nan=angle)[0])


def magnification(model: DistortionModel, coefficients: tuple[float, ...]) -> float:
    """Radius over angle at the optical axis: ``fx`` times this is the focal length there.

    Args:
        model, coefficients: of the lens.
    """
    lens = LENSES[model]
    return 1.0 if lens.bend is None else float(lens.bend(np.zeros(1), lens.padded(coefficients))[1][0])
