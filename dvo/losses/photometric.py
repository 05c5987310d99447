"""Photometric error between windows of two images: soft census, or SSIM with a robust L1.

Both are bounded, so that an occluded window cannot dominate a mean, and both have a twin by their definition.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Photometric = Literal["census", "ssim"]
"""Forms of :func:`photometric_error`."""

_CENSUS_SLOPE = 0.81  # squared grey levels at which a difference to the centre counts as large (UnFlow, of 0 to 255)
_CENSUS_HALF = 0.1  # squared difference of two codes at which a pixel counts half
_C1, _C2 = 0.01**2, 0.03**2  # stabilisers of SSIM, grey levels of 0 to 1
_SSIM_SHARE = 0.85  # of the error, the rest is L1 (Godard, Mac Aodha, Brostow, CVPR 2017)
_EPSILON = 1e-3  # where the robust L1 turns from square to linear, grey levels of 0 to 1


def photometric_error(
    reference: Float[Tensor, "*E p p"], warped: Float[Tensor, "*E p p"], form: Photometric = "census"
) -> Float[Tensor, "*E"]:
    """Dissimilarity of windows.

    Args:
        reference: grey levels, 0 to 255; ``p`` odd and at least 3.
        warped: grey levels of the other image where the pixels of the window are projected to.
        form: ``census``: :func:`census_error`, indifferent to an offset of the grey levels; ``ssim``:
            :func:`ssim_error`.

    Returns:
        About 0 for equal windows, at most 1.

    Example:
        >>> window = 255 * torch.rand(10, 7, 7)
        >>> bool((photometric_error(window, window) < 1e-6).all())
        True
    """
    return census_error(reference, warped) if form == "census" else ssim_error(reference, warped)


def census_error(reference: Float[Tensor, "*E p p"], warped: Float[Tensor, "*E p p"]) -> Float[Tensor, "*E"]:
    """Soft Hamming distance of the census codes of windows (ternary census: Stein 2004; soft: UnFlow, AAAI 2018).

    The code of a pixel is its difference to the centre, squashed to (-1, 1).

    Args:
        reference, warped: grey levels, 0 to 255.

    Returns:
        Mean over the pixels but the centre, in [0, 1).
    """
    squared = (_codes(reference) - _codes(warped)).square()
    p = reference.shape[-1]
    return (squared / (_CENSUS_HALF + squared)).flatten(-2).sum(-1) / (p * p - 1)


def _codes(window: Tensor) -> Tensor:
    middle = window.shape[-1] // 2
    difference = window - window[..., middle : middle + 1, middle : middle + 1]
    return difference / (_CENSUS_SLOPE + difference.square()).sqrt()


def ssim_error(reference: Float[Tensor, "*E p p"], warped: Float[Tensor, "*E p p"]) -> Float[Tensor, "*E"]:
    """Weighted sum of structural dissimilarity of windows and of the robust mean difference of their pixels.

    Args:
        reference, warped: grey levels, 0 to 255.

    Returns:
        ``0.85 (1 - SSIM) / 2 + 0.15 L1``, with one SSIM over the whole window and a Charbonnier L1, in [0, 1].
    """
    a, b = reference / 255, warped / 255
    mean_a, mean_b = a.mean((-2, -1)), b.mean((-2, -1))
    da, db = a - mean_a[..., None, None], b - mean_b[..., None, None]
    var_a, var_b, cov = da.square().mean((-2, -1)), db.square().mean((-2, -1)), (da * db).mean((-2, -1))
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a.square() + mean_b.square() + _C1)
    structure = (2 * cov + _C2) / (var_a + var_b + _C2)
    absolute = ((a - b).square() + _EPSILON**2).sqrt().mean((-2, -1)) - _EPSILON
    return _SSIM_SHARE * (1 - luminance * structure) / 2 + (1 - _SSIM_SHARE) * absolute


def photometric_error_plain(
    reference: Float[Tensor, "E p p"], warped: Float[Tensor, "E p p"], form: Photometric = "census"
) -> Float[Tensor, " E"]:
    """Twin of :func:`photometric_error` by its definition, a window and a pixel at a time."""
    one = _census_plain if form == "census" else _ssim_plain
    return torch.stack([one(a, b) for a, b in zip(reference, warped, strict=True)])


def _census_plain(a: Tensor, b: Tensor) -> Tensor:
    p = len(a)
    middle, total = p // 2, a.new_zeros(())
    for row in range(p):
        for column in range(p):
            if (row, column) == (middle, middle):
                continue
            da, db = a[row, column] - a[middle, middle], b[row, column] - b[middle, middle]
            gap = da / torch.sqrt(_CENSUS_SLOPE + da**2) - db / torch.sqrt(_CENSUS_SLOPE + db**2)
            total = total + gap**2 / (_CENSUS_HALF + gap**2)
    return total / (p**2 - 1)


def _ssim_plain(a: Tensor, b: Tensor) -> Tensor:
    x, y = (a / 255).flatten(), (b / 255).flatten()
    mx, my = x.sum() / len(x), y.sum() / len(y)
    vx, vy = ((x - mx) ** 2).sum() / len(x), ((y - my) ** 2).sum() / len(y)
    cov = ((x - mx) * (y - my)).sum() / len(x)
    ssim = (2 * mx * my + _C1) * (2 * cov + _C2) / ((mx**2 + my**2 + _C1) * (vx + vy + _C2))
    robust = (torch.sqrt((x - y) ** 2 + _EPSILON**2) - _EPSILON).sum() / len(x)
    return _SSIM_SHARE * (1 - ssim) / 2 + (1 - _SSIM_SHARE) * robust
