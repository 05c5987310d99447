"""Depth of patches from the depth image of their frame (:mod:`dvo.odometry.stereo_depth`: from its right image).

A measurement follows the grey levels of a window around the centre of its patch (:mod:`dvo.nets.alignment`), most of
all where they change. If the pixels of the window move by flows ``f(x)``, the least-squares alignment moves by their
mean, weighted by the squared gradients, and flows by parallax are linear in the inverse depth. The depth of a patch is
therefore the mean of the inverse depths of the window, weighted by the squared gradients, and not that of its centre,
which need not be on the same surface. Where the window crosses the edge of a body, or few of what it follows is known,
the patch has no depth.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.errors import DvoError
from dvo.models.patch_vo import PatchVO
from dvo.nets.alignment import AlignmentOptions
from dvo.odometry.config import TrackerConfig
from dvo.odometry.depth_factor import SIGMA
from dvo.odometry.front_end import Observation
from dvo.odometry.scale_options import ScaleOptions
from dvo.odometry.stereo_depth import measure_stereo

_HALF = AlignmentOptions().window // 2  # of the window that a measurement follows, pixels of the working image
_NOISE = 1.0  # squared gradient, (grey levels a pixel)^2, which every pixel has, so that a bare window has a mean
_KNOWN = 0.5  # least share of the weights whose depth is known
_TRIM = 0.05  # share of the weights at either end whose inverse depths are cut to those of the others: wrong pixels
_RELIEF = 0.06  # standard deviation of inverse depth in the window, relative to it, above which it crosses an edge
_NEAREST = 0.2  # metres; bundle adjustment leaves out points that are nearer (dvo.ba.layer)


def measure_depth(model: PatchVO, seen: Observation, frame: Frame, config: TrackerConfig) -> Observation:
    """Measure the depths of the patches of a frame, if that is wanted.

    Args:
        model: the network, which measures in right images.
        seen: the patches.
        frame: of the same image; its depth or right image is read if it is used.
        config: of the tracker, whose ``scale`` says what is used.

    Returns:
        The observation with ``measured``, of zeros for a frame without depth; unchanged without the option.

    Raises:
        DvoError: a depth or a right image that is not an image of the size of the frame.
    """
    options = config.scale
    if options.stereo:
        return measure_stereo(model, seen, frame, config)
    if not options.depth:
        return seen
    depth = checked_depth(frame)
    stride = seen.image.shape[0] // seen.bounds[1]
    centres = seen.centres[0, 0].double().cpu().numpy() * stride
    found = np.zeros((len(centres), 2))
    if depth is not None:
        metres = followed_depth(depth, cv2.cvtColor(seen.image, cv2.COLOR_RGB2GRAY), centres)
        known = np.isfinite(metres)
        found[known] = np.column_stack([1 / metres[known], SIGMA**2 / variance_of_inverse(metres[known], options)])
    return replace(seen, measured=torch.from_numpy(found).to(seen.intrinsics))


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


def followed_depth(depth: np.ndarray, grey: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Depth that the windows around patch centres follow: means of inverse depths weighted by squared gradients.

    Args:
        depth: ``(H, W)`` metres; nan, 0, negative or infinite where unknown. Of the size of the image or of another.
        grey: ``(h, w)`` grey levels of the working image, 0 to 255.
        centres: ``(M, 2)`` x, y in pixels of the working image.

    Returns:
        ``(M,)`` metres, nan where less than half of the weights are on known pixels, or these are of several surfaces.
    """
    weights = _squared_gradients(grey)
    (rows, down), (columns, across) = (
        _window(centres[:, 1 - k], depth.shape[k], grey.shape[k]) for k in (0, 1)
    )  # pixels of the depth image, and those of the working image that they lie in; -1 outside
    inside = (rows >= 0)[:, :, None] & (columns >= 0)[:, None, :]
    near = depth[rows[:, :, None], columns[:, None, :]].astype(np.float64)
    weight = np.where(inside, weights[down[:, :, None], across[:, None, :]], 0.0).reshape(len(centres), -1)
    with np.errstate(invalid="ignore"):
        known = (np.isfinite(near) & (near > _NEAREST)).reshape(weight.shape)
    inverse = np.divide(1.0, near.reshape(weight.shape), out=np.zeros_like(weight), where=known)
    share = (weight * known).sum(1) / weight.sum(1).clip(min=1e-12)
    found = np.full(len(centres), np.nan)
    enough = share >= _KNOWN
    if enough.any():
        mean, deviation = _trimmed(inverse[enough], (weight * known)[enough])
        found[enough] = np.where(deviation <= _RELIEF * mean, 1 / mean, np.nan)
    return found


def _squared_gradients(grey: np.ndarray) -> np.ndarray:
    """``(h, w)`` squared gradients of grey levels by central differences, as in the alignment, and noise."""
    padded = np.pad(grey.astype(np.float64), 1, mode="edge")
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    return across**2 + down**2 + _NOISE


def _window(centres: np.ndarray, size: int, working: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of a row of a depth image that windows cover, and the pixels of the working image that they lie in.

    Args:
        centres: ``(M,)`` in pixels of the working image.
        size, working: number of pixels of the row in either image.

    Returns:
        ``(M, S)`` indices into either; -1 outside.
    """
    scale = size / working
    count = max(1, round((2 * _HALF + 1) * scale))
    first = np.rint((centres + 0.5) * scale - count / 2).astype(int)
    pixels = first[:, None] + np.arange(count)
    of = np.floor((pixels + 0.5) / scale).astype(int).clip(0, working - 1)
    inside = (pixels >= 0) & (pixels < size)
    return np.where(inside, pixels, -1), np.where(inside, of, -1)


def _trimmed(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and standard deviation of rows ``(M, S)``, whose ends are cut to their quantiles."""
    order = values.argsort(1, kind="stable")
    ranked, below = np.take_along_axis(values, order, 1), np.take_along_axis(weights, order, 1).cumsum(1)
    low, high = (
        np.take_along_axis(ranked, (below < share * below[:, -1:]).sum(1, keepdims=True), 1)
        for share in (_TRIM, 1 - _TRIM)
    )
    cut, total = values.clip(low, high), weights.sum(1)
    mean = (cut * weights).sum(1) / total
    return mean, np.sqrt(((cut - mean[:, None]) ** 2 * weights).sum(1) / total)


def variance_of_inverse(metres: np.ndarray, options: ScaleOptions) -> np.ndarray:
    """Variance of inverse depths: that of the depths, relative and by the sensor, over the fourth power of the depth.

    Args:
        metres: depths.
        options: noise, see :class:`dvo.odometry.scale_options.ScaleOptions`.

    Returns:
        Variances in 1/m^2, of the shape of ``metres``.
    """
    sensor = options.depth_base + options.depth_quadratic * (metres - 0.4) ** 2
    return ((options.depth_error * metres) ** 2 + sensor**2) / metres**4
