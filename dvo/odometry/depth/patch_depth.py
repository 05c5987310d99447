"""Depth of patches from the depth image of their frame (:mod:`dvo.odometry.depth.stereo_depth`: from its right image).

A measurement follows the grey levels of a window around the centre of its patch (:mod:`dvo.nets.alignment.alignment`),
most of all where they change. A plane is fitted to the inverse depths of the window: the inverse depth of a plane is
linear in the image. Its value at the centre is the depth of the patch; its slopes take part in the affine warp of the
window (:func:`dvo.nets.alignment.alignment.patch_warps`), without which the windows of slanted surfaces follow what
they do not show. If the pixels of a window move by flows ``f(x)`` beside the warp, the least-squares alignment moves by
their mean, weighted by the squared gradients, and flows by parallax are linear in the inverse depth. The fit has the
same weights, so that what the plane leaves has the mean 0. Where the window crosses the edge of a body, or few of what
it follows is known, the patch has no depth.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.map.measurements import SIGMA
from dvo.models.patch_vo import PatchVO
from dvo.nets.alignment.alignment import AlignmentOptions
from dvo.odometry.depth.scale_options import ScaleOptions
from dvo.odometry.depth.stereo_depth import measure_stereo
from dvo.odometry.frames.front_end import Observation
from dvo.odometry.window.patch_window import StepSettings

_HALF = AlignmentOptions().window // 2  # of the window that a measurement follows, pixels of the working image
_NOISE = 1.0  # squared gradient, (grey levels a pixel)^2, which every pixel has, so that a bare window has a mean
_KNOWN = 0.5  # least share of the weights whose depth is known
_TRIM = 0.05  # share of the weights at either end whose inverse depths are cut to those of the others: wrong pixels
_RELIEF = 0.06  # standard deviation of inverse depth from the plane, relative to it, above which it crosses an edge
_RIDGE = 0.3  # squared pixels that hold the slopes where all that changes lies on a line
_ROUNDS = 3  # fits, all but the first with the outer values cut
_NEAREST = 0.2  # metres; bundle adjustment leaves out points that are nearer (dvo.ba.layer.layer)


def measure_depth(
    model: PatchVO, seen: Observation, frame: Frame, options: ScaleOptions, settings: StepSettings
) -> Observation:
    """Measure the depths of the patches of a frame.

    Args:
        model: the network, which measures in right images.
        seen: the patches.
        frame: of the same image; its depth or right image is read if it is used.
        options: of the scale, with ``depth`` or ``stereo``.
        settings: of measurements in right images.

    Returns:
        The observation with ``measured`` and ``slopes``, of zeros for a frame without depth.

    Raises:
        DvoError: a depth or a right image that is not an image of the size of the frame.
    """
    if options.stereo:
        return measure_stereo(model, seen, frame, settings, options.stereo_error)
    depth = checked_depth(frame)
    stride = seen.image.shape[0] // seen.bounds[1]
    centres = seen.centres[0, 0].double().cpu().numpy() * stride
    found, slopes = np.zeros((len(centres), 2)), np.zeros((len(centres), 2))
    if depth is not None:
        metres, relative = followed_planes(depth, cv2.cvtColor(seen.image, cv2.COLOR_RGB2GRAY), centres)
        known = np.isfinite(metres)
        found[known] = np.column_stack([1 / metres[known], SIGMA**2 / variance_of_inverse(metres[known], options)])
        slopes[known] = relative[known] * stride
    measured, tilted = (torch.from_numpy(values).to(seen.intrinsics) for values in (found, slopes))
    return replace(seen, measured=measured, slopes=tilted)


def checked_depth(frame: Frame) -> np.ndarray | None:
    """Read the depth of a frame.

    Args:
        frame: with an image and a camera.

    Returns:
        ``(H, W)`` metres, or None.

    Raises:
        DvoError: an array of another type or shape.
    """
    if frame.depth is None:
        return None
    depth = np.asarray(frame.depth)
    if depth.dtype.kind != "f" or depth.shape != frame.image.shape[:2]:
        height, width = frame.image.shape[:2]
        message = f"has shape {depth.shape} and type {depth.dtype}, the image is {width}x{height} (width x height)"
        remedy = "give float32 metres (H, W), nan where unknown, registered to the image"
        raise DvoError(message, field=f"frame {frame.index}: depth", remedy=remedy)
    return depth


def followed_planes(depth: np.ndarray, grey: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planes that the windows around patch centres follow: fits to inverse depths, weighted by squared gradients.

    Args:
        depth: ``(H, W)`` metres; nan, 0, negative or infinite where unknown. Of the size of the image or of another.
        grey: ``(h, w)`` grey levels of the working image, 0 to 255.
        centres: ``(M, 2)`` x, y in pixels of the working image.

    Returns:
        ``(M,)`` metres at the centres, nan where less than half of the weights are on known pixels, or these are of
        several surfaces; and ``(M, 2)`` derivatives of the inverse depth by x and y over itself, 1 / pixel.
    """
    weights = _squared_gradients(grey)
    (rows, down, y), (columns, across, x) = (
        _window(centres[:, 1 - k], depth.shape[k], grey.shape[k]) for k in (0, 1)
    )  # pixels of the depth image, -1 outside; those of the working image that they lie in; distances from the centre
    inside = (rows >= 0)[:, :, None] & (columns >= 0)[:, None, :]
    near = depth[rows[:, :, None], columns[:, None, :]].astype(np.float64)
    weight = np.where(inside, weights[down[:, :, None], across[:, None, :]], 0.0).reshape(len(centres), -1)
    offsets = np.stack(np.broadcast_arrays(x[:, None, :], y[:, :, None]), -1).reshape(*weight.shape, 2)
    with np.errstate(invalid="ignore"):
        known = (np.isfinite(near) & (near > _NEAREST)).reshape(weight.shape)
    inverse = np.divide(1.0, near.reshape(weight.shape), out=np.zeros_like(weight), where=known)
    share = (weight * known).sum(1) / weight.sum(1).clip(min=1e-12)
    metres, slopes = np.full(len(centres), np.nan), np.zeros((len(centres), 2))
    enough = share >= _KNOWN
    if enough.any():
        value, slope, deviation = _planes(inverse[enough], (weight * known)[enough], offsets[enough])
        flat = (deviation <= _RELIEF * value) & (value > 0)
        metres[enough] = np.divide(1.0, value, out=np.full_like(value, np.nan), where=flat)
        slopes[enough] = np.divide(slope, value[:, None], out=np.zeros_like(slope), where=flat[:, None])
    return metres, slopes


def _squared_gradients(grey: np.ndarray) -> np.ndarray:
    """``(h, w)`` squared gradients of grey levels by central differences, as in the alignment, and noise."""
    padded = np.pad(grey.astype(np.float64), 1, mode="edge")
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    return across**2 + down**2 + _NOISE


def _window(centres: np.ndarray, size: int, working: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of a row of a depth image that windows cover, and the pixels of the working image that they lie in.

    Args:
        centres: ``(M,)`` in pixels of the working image.
        size, working: number of pixels of the row in either image.

    Returns:
        ``(M, S)`` indices into either, -1 outside; and the distances from the centres, pixels of the working image.
    """
    scale = size / working
    count = max(1, round((2 * _HALF + 1) * scale))
    first = np.rint((centres + 0.5) * scale - count / 2).astype(int)
    pixels = first[:, None] + np.arange(count)
    places = (pixels + 0.5) / scale
    of = np.floor(places).astype(int).clip(0, working - 1)
    inside = (pixels >= 0) & (pixels < size)
    return np.where(inside, pixels, -1), np.where(inside, of, -1), places - 0.5 - centres[:, None]


def _planes(values: np.ndarray, weights: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted planes through rows ``(M, S)`` at offsets ``(M, S, 2)``.

    Returns:
        ``(M,)`` values at the offset 0, ``(M, 2)`` slopes, and ``(M,)`` standard deviation of the rows from the planes,
        whose ends are cut to their quantiles.
    """
    share = weights / weights.sum(1, keepdims=True)
    middle = np.einsum("ms,msk->mk", share, offsets)
    centred = offsets - middle[:, None]
    spread = np.linalg.inv(np.einsum("ms,msk,msl->mkl", share, centred, centred) + _RIDGE * np.eye(2))
    cut = values
    for _ in range(_ROUNDS):
        mean = (share * cut).sum(1)
        slopes = np.einsum("mkl,ms,msl->mk", spread, share * (cut - mean[:, None]), centred)
        plane = mean[:, None] + np.einsum("msk,mk->ms", centred, slopes)
        rest = _cut(values - plane, weights)
        cut = plane + rest
    return mean - (middle * slopes).sum(1), slopes, np.sqrt((share * rest**2).sum(1))


def _cut(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rows ``(M, S)`` whose ends are cut to their weighted quantiles."""
    order = values.argsort(1, kind="stable")
    ranked, below = np.take_along_axis(values, order, 1), np.take_along_axis(weights, order, 1).cumsum(1)
    low, high = (
        np.take_along_axis(ranked, (below < share * below[:, -1:]).sum(1, keepdims=True), 1)
        for share in (_TRIM, 1 - _TRIM)
    )
    return values.clip(low, high)


def variance_of_inverse(metres: np.ndarray, options: ScaleOptions) -> np.ndarray:
    """Variance of inverse depths: that of the depths, relative and by the sensor, over the fourth power of the depth.

    Args:
        metres: depths.
        options: noise, see :class:`dvo.odometry.depth.scale_options.ScaleOptions`.

    Returns:
        Variances in 1/m^2, of the shape of ``metres``.
    """
    sensor = options.depth_base + options.depth_quadratic * (metres - 0.4) ** 2
    return ((options.depth_error * metres) ** 2 + sensor**2) / metres**4
