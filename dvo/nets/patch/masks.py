"""Masks at the resolution of the feature maps: places for patches, and measurements that count."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

from dvo.nets.patch.config import ModelConfig

_ENOUGH = 100  # places for patches, for which the margin is kept
_ROUNDS = 12  # of the selection, until it is completed from all places
_STRIDE = ModelConfig.STRIDE


def shrunk(mask: np.ndarray, margin: int) -> np.ndarray:
    """Used pixels with no ignored one within a margin; what lies outside of the image is not ignored.

    Args:
        mask: ``(H, W)`` bool, True for pixels to use.
        margin: pixels, along both axes.

    Returns:
        ``(H, W)`` bool.
    """
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel) > 0


def places_of_patches(mask: np.ndarray, patch_size: int, device: torch.device) -> Tensor:
    """Places that patches may have: with the size of a patch between their centre and ignored pixels.

    Where few places are left, the margin is halved, and then left out.

    Args:
        mask: ``(H, W)`` bool, of the working image.
        patch_size: side of a patch, feature pixels.
        device: of the result.

    Returns:
        ``(h, w)`` bool, False at the border of the feature map; not all False unless all pixels are ignored.
    """
    margin = patch_size * _STRIDE
    for smaller in (margin, margin // 2, 0):
        places = shrunk(mask, smaller)[::_STRIDE, ::_STRIDE].copy()
        places[[0, -1]] = places[:, [0, -1]] = False
        if places.sum() >= _ENOUGH:
            break
    return torch.from_numpy(places).to(device)


def visible_features(mask: np.ndarray, patch_size: int, device: torch.device) -> Tensor:
    """Pixels of the feature map at which a patch lies in used pixels alone.

    Args:
        mask: ``(H, W)`` bool, of the working image.
        patch_size: side of a patch, feature pixels.
        device: of the result.

    Returns:
        ``(h, w)`` bool.
    """
    half = patch_size // 2 * _STRIDE + _STRIDE // 2
    return torch.from_numpy(shrunk(mask, half)[::_STRIDE, ::_STRIDE].copy()).to(device)


def unmasked_centres(centres: Tensor, again: Callable[[], Tensor], places: Tensor) -> Tensor:
    """Complete a selection of patches after leaving out those in ignored pixels.

    The selection is repeated until it has given enough; whatever its rule, the patches follow it among the places that
    are left. If these are so few that it does not meet them, they are taken in regular distances.

    Args:
        centres: ``(1, 1, M, 2)`` int64 ``x, y`` of a first selection.
        again: selects as many anew.
        places: ``(h, w)`` bool, see :func:`places_of_patches`.

    Returns:
        ``(1, 1, M, 2)`` int64, in ``places`` if there are any.
    """
    count, found = centres.shape[2], []
    for _ in range(_ROUNDS):
        x, y = centres[0, 0].unbind(-1)
        found.append(centres[0, 0][places[y, x]])
        if sum(map(len, found)) >= count:
            break
        centres = again()
    chosen = torch.cat(found)[:count]
    missing = count - len(chosen)
    if missing:
        y, x = places.nonzero().unbind(-1)
        if not len(x):
            return centres
        every = torch.linspace(0, len(x) - 1, missing, device=places.device).round().long()
        chosen = torch.cat([chosen, torch.stack([x, y], -1)[every]])
    return chosen[None, None]


def in_sight(targets: Tensor, frames: Tensor, visible: Tensor) -> Tensor:
    """Find out if measurements lie in used pixels.

    Args:
        targets: ``(B, E, 2)`` feature pixels; outside of the feature map nothing is ignored.
        frames: ``(E,)`` frame of each.
        visible: ``(N, h, w)`` bool, of the frames.

    Returns:
        ``(B, E)`` bool.
    """
    height, width = visible.shape[-2:]
    nearest = targets.detach().round()
    x, y = nearest.unbind(-1)
    outside = ~((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1))  # NaN is outside
    column = x.nan_to_num(0).clamp(0, width - 1).long()
    row = y.nan_to_num(0).clamp(0, height - 1).long()
    return outside | visible[frames.expand_as(column), row, column]
