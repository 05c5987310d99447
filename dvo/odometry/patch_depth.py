"""Depth of patches from the depth image of their frame (:mod:`dvo.odometry.stereo_depth`: from its right image).

The depth of a patch is the median over a neighbourhood of its centre. Where the neighbourhood crosses the edge of a
body, or few of its pixels are known, the patch has none: which of the two surfaces its features lie on is not known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.errors import DvoError
from dvo.models.patch_vo import PatchVO
from dvo.odometry.config import TrackerConfig
from dvo.odometry.depth_factor import SIGMA
from dvo.odometry.front_end import Observation
from dvo.odometry.scale_options import ScaleOptions
from dvo.odometry.stereo_depth import measure_stereo

_REACH = 1.5  # from the centre to the border of the neighbourhood, pixels of the working image
_KNOWN = 0.5  # least share of known pixels in it
_STEP = 0.06  # relative difference of the first and the last decile of its depths above which it crosses an edge
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
    height, width = seen.image.shape[:2]
    depth = checked_depth(frame)
    stride = height // seen.bounds[1]
    centres = seen.centres[0, 0].double().cpu().numpy() * stride
    found = np.zeros((len(centres), 2))
    if depth is not None:
        scale = np.array([depth.shape[1] / width, depth.shape[0] / height])
        metres = sample_depth(depth, (centres + 0.5) * scale - 0.5, max(1, round(_REACH * float(scale.max()))))
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


def sample_depth(depth: np.ndarray, positions: np.ndarray, reach: int) -> np.ndarray:
    """Depth at positions of a depth image.

    Args:
        depth: ``(H, W)`` metres; nan, 0, negative or infinite where unknown.
        positions: ``(M, 2)`` x, y in pixels.
        reach: of the neighbourhood, pixels: it has ``2 reach + 1`` to the side.

    Returns:
        ``(M,)`` metres: the median of the known pixels, nan where fewer than half are known or where they are of
        several surfaces.
    """
    height, width = depth.shape
    steps = np.arange(-reach, reach + 1)
    x, y = (np.rint(positions[:, k]).astype(int)[:, None] + steps for k in (0, 1))
    inside = ((y >= 0) & (y < height))[:, :, None] & ((x >= 0) & (x < width))[:, None, :]
    near = depth[y.clip(0, height - 1)[:, :, None], x.clip(0, width - 1)[:, None, :]].astype(np.float64)
    with np.errstate(invalid="ignore"):
        near = np.where(inside & np.isfinite(near) & (near > _NEAREST), near, np.nan).reshape(len(positions), -1)
    enough = np.isfinite(near).mean(1) >= _KNOWN
    found = np.full(len(positions), np.nan)
    if enough.any():
        low, median, high = np.nanquantile(near[enough], [0.1, 0.5, 0.9], axis=1)
        found[enough] = np.where(high - low <= _STEP * median, median, np.nan)
    return found


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
