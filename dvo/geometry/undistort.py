"""Lens distortion: functions on points, and the resampling of images to a camera without distortion; and to one without
a rolling shutter, as far as the camera turns.

The models are those of :mod:`dvo.geometry.lenses`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.lenses import (
    LENSES,
    distort_plane,
    distort_rays,
    in_range_plane,
    undistort_plane,
    undistort_to_rays,
)

_CELLS = 16  # of the grid, on each axis, on which the rows of a rolling shutter are corrected
_FAR_OFF = -1e4  # pixels, outside of every image


def distort(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Apply the lens model.

    Args:
        points: ``(..., 2)`` ideal normalised coordinates ``(X / Z, Y / Z)``.
        camera: camera with its model and coefficients.

    Returns:
        ``(..., 2)`` float64 distorted normalised coordinates; a pixel is ``(fx x + cx, fy y + cy)`` of them.
    """
    points = np.asarray(points, dtype=np.float64)
    if not camera.needs_undistortion:
        return points.copy()
    return distort_plane(points, camera.model, camera.coefficients)


def undistort(points: np.ndarray, camera: Camera, iterations: int = 20) -> np.ndarray:
    """Inverse of :func:`distort` by Newton's method.

    Args:
        points: ``(..., 2)`` distorted normalised coordinates ``((u - cx) / fx, (v - cy) / fy)``.
        camera: the camera with its model and coefficients.
        iterations: most steps of Newton's method.

    Returns:
        ``(..., 2)`` ideal normalised coordinates; NaN where no ideal point maps there (outside of the lens model's
        range: beyond the radius at which it folds back, or at 90 degrees and more of a fisheye).
    """
    points = np.asarray(points, dtype=np.float64)
    if not camera.needs_undistortion:
        return points.copy()
    return undistort_plane(points, camera.model, camera.coefficients, iterations)


def project(rays: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels of rays.

    Args:
        rays: ``(..., 3)`` of any length, x right, y down, z forward; those behind a wide lens too.
        camera: camera with its model and coefficients.

    Returns:
        ``(..., 2)`` float64 pixels, inside of the image or not; NaN for rays outside of the range of the lens model.
    """
    distorted = distort_rays(rays, camera.model, camera.coefficients)
    return distorted * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def unproject(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Rays of pixels, the inverse of :func:`project`.

    Args:
        pixels: ``(..., 2)``.
        camera: camera with its model and coefficients.

    Returns:
        ``(..., 3)`` float64 unit rays, those behind a wide lens too; NaN where no ray maps there.
    """
    points = (np.asarray(pixels, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return undistort_to_rays(points, camera.model, camera.coefficients)


def in_range(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Test whether points lie within the range of the lens model.

    Farther out the polynomials fold back, and :func:`distort` gives places that the lens never fills.

    Args:
        points: ``(..., 2)`` ideal normalised coordinates.
        camera: camera with its model and coefficients.

    Returns:
        ``(...)`` bool, True where the distorted radius grows all the way from the centre to the point.
    """
    return in_range_plane(np.asarray(points, dtype=np.float64), camera.model, camera.coefficients)


def read_at_once(image: np.ndarray, camera: Camera, offsets: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Image of a rolling shutter as if all rows had been read at the time of the frame by a camera that only turns.

    Args:
        image: ``(H, W, 3)`` uint8 of a camera without lens distortion.
        camera: of the image; its ``readout`` is above 0.
        offsets: ``(S,)`` increasing seconds relative to the time of the frame, which span the readout.
        turns: ``(S, 3)`` rotation vectors from the orientation at the time of the frame to those at the offsets, in
            the axes of the camera, rad.

    Returns:
        ``(H, W, 3)`` uint8; what lies outside of the image repeats its border.
    """
    import cv2

    height, width = image.shape[:2]
    u, v = np.meshgrid(np.linspace(0, width - 1, _CELLS + 1), np.linspace(0, height - 1, _CELLS + 1))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    row = v
    for _ in range(3):  # the row that shows a point is one that is near
        time = (row - (height - 1) / 2) * camera.readout / height
        turn = np.stack([np.interp(time, offsets, axis) for axis in turns.T], -1)
        seen = rays - np.cross(turn, rays)  # a camera turns by a few hundredths of a radian in a readout
        x, y = np.moveaxis(seen[..., :2] / seen[..., 2:], -1, 0)
        column, row = x * camera.fx + camera.cx, y * camera.fy + camera.cy
    across, down = (np.linspace(0, _CELLS, size, dtype=np.float32) for size in (width, height))
    grid = np.meshgrid(across, down)
    shift = np.stack([column - u, row - v], -1).astype(np.float32)
    x, y = np.moveaxis(cv2.remap(shift, *grid, cv2.INTER_LINEAR), -1, 0)
    x, y = x + np.arange(width, dtype=np.float32), y + np.arange(height, dtype=np.float32)[:, None]
    return cv2.remap(np.ascontiguousarray(image), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _scaled(camera: Camera, scale: float) -> Camera:
    fx, fy = camera.focal_lengths
    return replace(camera, fx=fx * scale, fy=fy * scale, model="none", coefficients=())


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
    if not camera.needs_undistortion:
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
            remedy="check the order (radtan: k1 k2 p1 p2 k3), the lens model and the focal length",
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

        source, new, size = self.source, self.camera, (self.source.width, self.source.height)
        k = LENSES[source.model].padded(source.coefficients)
        if source.model == "fisheye":
            return cv2.fisheye.initUndistortRectifyMap(source.matrix, k, np.eye(3), new.matrix, size, kind)
        if source.model == "radtan":
            used = next(count for count in (5, 8, 12) if not k[count:].any())
            return cv2.initUndistortRectifyMap(source.matrix, k[:used], np.eye(3), new.matrix, size, kind)
        u, v = np.meshgrid(np.arange(float(new.width)), np.arange(float(new.height)))
        ideal = np.stack([(u - new.cx) / new.fx, (v - new.cy) / new.fy], axis=-1)
        real = distort(ideal, source) * [source.fx, source.fy] + [source.cx, source.cy]
        real = np.where(in_range(ideal, source)[..., None], real, _FAR_OFF).clip(_FAR_OFF, -_FAR_OFF)
        x, y = np.ascontiguousarray(np.moveaxis(real.astype(np.float32), -1, 0))
        return (x, y) if kind == cv2.CV_32FC1 else cv2.convertMaps(x, y, kind)

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
        if not self.source.needs_undistortion:
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
        if not self.source.needs_undistortion:
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
