"""Lens distortion: functions on points, and the resampling of images to a camera without distortion.

Models (coordinates are normalised, ``x = X/Z``):

* ``radtan``: OpenCV's radial-tangential, ``x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)``,
  ``y' = y (...) + p1 (r^2 + 2 y^2) + 2 p2 x y``; coefficients ``k1 k2 p1 p2 [k3]`` (Brown 1966; OpenCV calib3d).
* ``fisheye``: Kannala-Brandt 2006 as in ``cv2.fisheye``, ``theta' = theta (1 + k1 theta^2 + ... + k4 theta^8)`` with
  ``theta = atan(r)``; coefficients ``k1 k2 k3 k4``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera


def needs_undistortion(camera: Camera) -> bool:
    """True if images of the camera differ from those of a pinhole camera.

    A fisheye with zero coefficients needs undistortion too: its model maps the angle, not its tangent.

    Args:
        camera: with its model and coefficients.
    """
    return camera.model == "fisheye" or camera.is_distorted


def _padded(camera: Camera, count: int) -> np.ndarray:
    coefficients = np.zeros(count)
    coefficients[: len(camera.coefficients)] = camera.coefficients
    return coefficients


def _radtan(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Distorted points ``(..., 2)`` and the Jacobian ``(..., 2, 2)`` with respect to the ideal ones."""
    k1, k2, p1, p2, k3 = _padded(camera, 5)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)  # d radial / d r2
    distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    off_diagonal = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian = np.stack(
        [
            np.stack([radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, off_diagonal], -1),
            np.stack([off_diagonal, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x], -1),
        ],
        axis=-2,
    )
    return distorted, jacobian


def _kannala_brandt(theta: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Distorted angle and its derivative, for ideal angles of any shape (radians)."""
    k1, k2, k3, k4 = _padded(camera, 4)
    t2 = theta * theta
    value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    return value, slope


def distort(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Apply the lens model.

    Args:
        points: ``(..., 2)`` ideal normalised coordinates ``(X / Z, Y / Z)``.
        camera: camera with its model and coefficients.

    Returns:
        ``(..., 2)`` float64 distorted normalised coordinates; a pixel is ``(fx x + cx, fy y + cy)`` of them.
    """
    points = np.asarray(points, dtype=np.float64)
    if not needs_undistortion(camera):
        return points.copy()
    if camera.model == "radtan":
        return _radtan(points, camera)[0]
    r = np.linalg.norm(points, axis=-1, keepdims=True)
    distorted, _ = _kannala_brandt(np.arctan(r), camera)
    return points * np.where(r > 1e-9, distorted / np.where(r > 1e-9, r, 1.0), 1.0)


def undistort(points: np.ndarray, camera: Camera, iterations: int = 20) -> np.ndarray:
    """Inverse of :func:`distort` by Newton's method.

    Args:
        points: ``(..., 2)`` distorted normalised coordinates ``((u - cx) / fx, (v - cy) / fy)``.
        camera: the camera with its model and coefficients.
        iterations: most steps of Newton's method.

    Returns:
        ``(..., 2)`` ideal normalised coordinates; NaN where no ideal point maps there (outside of the lens model's
        range: beyond the radius at which the polynomial folds back, or at 90 degrees and more for ``fisheye``).
    """
    points = np.asarray(points, dtype=np.float64)
    if not needs_undistortion(camera):
        return points.copy()
    if camera.model == "fisheye":
        radius = np.linalg.norm(points, axis=-1)
        theta = radius.copy()
        for _ in range(iterations):
            value, slope = _kannala_brandt(theta, camera)
            step = (value - radius) / np.where(np.abs(slope) > 1e-6, slope, 1e-6)
            theta = theta - np.clip(step, -0.3, 0.3)  # short steps stay on the first, rising branch
        value, slope = _kannala_brandt(theta, camera)
        found = (np.abs(value - radius) < 1e-9) & (slope > 0) & (theta >= 0) & (theta < math.pi / 2 - 1e-6)
        ratio = np.where(radius > 1e-9, np.tan(np.where(found, theta, 0.0)) / np.where(radius > 1e-9, radius, 1.0), 1.0)
        return np.where(found[..., None], points * ratio[..., None], np.nan)
    ideal = points.copy()
    for _ in range(iterations):
        value, jacobian = _radtan(ideal, camera)
        residual = value - points
        determinant = np.linalg.det(jacobian)
        safe = np.where(np.abs(determinant) > 1e-6, determinant, 1e-6)
        step = np.stack(
            [
                jacobian[..., 1, 1] * residual[..., 0] - jacobian[..., 0, 1] * residual[..., 1],
                jacobian[..., 0, 0] * residual[..., 1] - jacobian[..., 1, 0] * residual[..., 0],
            ],
            axis=-1,
        )
        ideal = ideal - np.clip(step / safe[..., None], -0.3, 0.3)
    value, jacobian = _radtan(ideal, camera)
    found = (np.abs(value - points).max(axis=-1) < 1e-9) & in_range(ideal, camera)
    return np.where(found[..., None], ideal, np.nan)


def in_range(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Test whether points lie within the range of the lens model.

    Farther out the polynomials fold back, and :func:`distort` gives places that the lens never fills.

    Args:
        points: ``(..., 2)`` ideal normalised coordinates.
        camera: camera with its model and coefficients.

    Returns:
        ``(...)`` bool, True where the distorted radius grows all the way from the centre to the point.
    """
    r = np.linalg.norm(points, axis=-1)[..., None] * np.linspace(0, 1, 17)
    if camera.model == "fisheye":
        return np.asarray((_kannala_brandt(np.arctan(r), camera)[1] > 0).all(axis=-1))
    k1, k2, _, _, k3 = _padded(camera, 5)
    r2 = r * r
    return np.asarray((1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0).all(axis=-1))


def _scaled(camera: Camera, scale: float) -> Camera:
    return replace(camera, fx=camera.fx * scale, fy=camera.fy * scale, model="none", coefficients=())


def _rows_per_row(camera: Camera, target: Camera) -> float:
    """Rows of the real image to a row of an undistorted one, by least squares over the image."""
    u, v = np.meshgrid(np.linspace(0, target.width - 1, 17), np.linspace(0, target.height - 1, 17))
    ideal = np.stack([(u - target.cx) / target.fx, (v - target.cy) / target.fy], axis=-1)
    offsets = v - v.mean()
    return float((offsets * distort(ideal, camera)[..., 1] * camera.fy).sum() / (offsets**2).sum())


def _border(camera: Camera) -> np.ndarray:
    """Pixels ``(M, 2)`` along the image's edge, about every fourth."""
    u = np.linspace(0, camera.width - 1, max(camera.width // 4, 2))
    v = np.linspace(0, camera.height - 1, max(camera.height // 4, 2))
    sides = [
        np.column_stack([u, np.zeros_like(u)]),
        np.column_stack([u, np.full_like(u, camera.height - 1)]),
        np.column_stack([np.zeros_like(v), v]),
        np.column_stack([np.full_like(v, camera.width - 1), v]),
    ]
    return np.concatenate(sides)


def _all_seen(camera: Camera, scale: float) -> bool:
    """True if every pixel of the undistorted image with focal lengths times ``scale`` falls into the real image."""
    target = _scaled(camera, scale)
    ideal = (_border(target) - [target.cx, target.cy]) / [target.fx, target.fy]
    if not in_range(ideal, camera).all():
        return False
    real = distort(ideal, camera) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    limit = np.array([camera.width - 1, camera.height - 1])
    return bool(((real >= -0.5) & (real <= limit + 0.5)).all())


def undistorted_camera(camera: Camera) -> Camera:
    """Pinhole camera to which :class:`Undistorter` resamples.

    Same size, same principal point, same aspect; the focal lengths are multiplied by the smallest factor in
    [0.75, 2] for which every pixel is seen by the real camera, so that there are no black edges for features to stick
    to. (OpenCV's ``getOptimalNewCameraMatrix(alpha=0)`` has the same aim, but stretches the two axes differently, and
    for wide fisheyes zooms out until the corners are smeared; 0.75 bounds that.)

    ``readout`` becomes the one that suits the rows of the result best: each is made of pixels of several real rows, and
    all of them may cover only a part of the sensor. The time of the middle row moves by the readout of a few rows.

    Args:
        camera: the real camera.

    Raises:
        DvoError: at twice the focal length the lens model still folds the image over itself or leaves it.
    """
    if not needs_undistortion(camera):
        return _scaled(camera, 1.0)
    pinhole = _widest(camera)
    if camera.readout > 0:
        pinhole = replace(pinhole, readout=min(camera.readout * _rows_per_row(camera, pinhole), 1.0))
    return pinhole


def _widest(camera: Camera) -> Camera:
    """Pinhole camera with the shortest focal length that :func:`undistorted_camera` allows."""
    low, high = 0.75, 2.0
    if _all_seen(camera, low):
        return _scaled(camera, low)
    if not _all_seen(camera, high):
        raise DvoError(
            f"these {camera.model} coefficients fold the {camera.width}x{camera.height} image over itself",
            field="distortion",
            remedy="check the order (k1 k2 p1 p2 k3), the model (radtan or fisheye) and the focal length",
        )
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (low, middle) if _all_seen(camera, middle) else (middle, high)
    return _scaled(camera, high)


class Undistorter:
    """Resample images of one camera to a pinhole camera of the same size; the maps are computed at the first image.

    Args:
        source: the real camera.

    Attributes:
        source: the real camera.
        camera: the camera of the images that come out (see :func:`undistorted_camera`); ``model`` is ``none``.

    Raises:
        DvoError: distortion that cannot belong to this camera.
    """

    def __init__(self, source: Camera) -> None:
        self.source = source
        self.camera = undistorted_camera(source)

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        return self._make_maps(cv2.CV_16SC2)  # fixed point: faster, and exact to 1/64 of a pixel

    @cached_property
    def _depth_maps(self) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        return self._make_maps(cv2.CV_32FC1)  # OpenCV's nearest neighbour of fixed-point maps is up to a pixel off

    def _make_maps(self, kind: int) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        size = (self.source.width, self.source.height)
        if self.source.model == "fisheye":
            return cv2.fisheye.initUndistortRectifyMap(
                self.source.matrix, _padded(self.source, 4), np.eye(3), self.camera.matrix, size, kind
            )
        return cv2.initUndistortRectifyMap(
            self.source.matrix, _padded(self.source, 5), np.eye(3), self.camera.matrix, size, kind
        )

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Resample an image of ``source`` to the image of ``camera``, bilinearly.

        Args:
            image: ``(H, W)`` or ``(H, W, C)``.

        Returns:
            Image of the same size and type; 0 where the real camera does not see (wide fisheyes only).

        Raises:
            ValueError: an image of another size than that of ``source``.
        """
        self._check(image)
        if not needs_undistortion(self.source):
            return image
        import cv2

        return cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR)

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """Resample a depth image of ``source`` to the image of ``camera``, to the nearest pixel.

        Interpolation would invent surfaces between a foreground and its background. The two cameras share centre and
        axes, so that the depth Z of a point is the same in both.

        Args:
            depth: ``(H, W)`` float32, Z of each pixel, nan where it is not known.

        Returns:
            ``(H, W)`` float32; nan also where the real camera does not see.

        Raises:
            ValueError: an image of another size than that of ``source``.
        """
        self._check(depth)
        if not needs_undistortion(self.source):
            return depth
        import cv2

        maps, border = self._depth_maps, cv2.BORDER_CONSTANT
        return cv2.remap(depth, *maps, interpolation=cv2.INTER_NEAREST, borderMode=border, borderValue=math.nan)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Resample a mask of ``source`` to the image of ``camera``, to the nearest pixel.

        Args:
            mask: ``(H, W)`` bool.

        Returns:
            ``(H, W)`` bool; False also where the real camera does not see.

        Raises:
            ValueError: a mask of another size than that of ``source``.
        """
        return self.depth(mask.astype(np.float32)) == 1

    def _check(self, image: np.ndarray) -> None:
        if image.shape[:2] != (self.source.height, self.source.width):
            raise ValueError(f"image {image.shape[:2]} is not {self.source.height}x{self.source.width}")
