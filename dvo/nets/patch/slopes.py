"""Slopes of the surfaces of patches, from how their windows of grey levels differ in other images.

The inverse depth of a plane is linear in the image. Where it is ``d (1 + s o)`` at an offset ``o`` from the centre of
a patch, the pixel there moves by ``du/dlog(d) s o`` more than at the depth of the centre, and the affine warp of the
window (:func:`dvo.nets.alignment.alignment.patch_warps`) has this part. After the alignment, the differences of the
grey levels that are left tell the slopes: one step of Gauss-Newton, with position, gain and offset of the grey levels
eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dvo.nets.alignment.alignment import AlignmentOptions, grey_windows, sample_images

_NOISE = 2.0  # grey levels, standard deviation of those of any image


@dataclass(frozen=True)
class SlopeEquations:
    """Normal equations of the slopes, one of each edge; those of the edges of a patch add up.

    Attributes:
        matrix: ``(E, 2, 2)``, information of grey levels of independent noise.
        vector: ``(E, 2)``; the step of the slopes solves ``matrix step = vector``.
    """

    matrix: Tensor
    vector: Tensor


def slope_equations(
    images: Float[Tensor, "N H W"],
    source: Int[Tensor, " E"],
    target: Int[Tensor, " E"],
    centres: Float[Tensor, "E 2"],
    positions: Float[Tensor, "E 2"],
    warps: Float[Tensor, "E 2 2"],
    rates: Float[Tensor, "E 2"],
    options: AlignmentOptions = AlignmentOptions(),  # noqa: B008 (frozen)
) -> SlopeEquations:
    """Normal equations of the slopes of surfaces around the present ones.

    Args:
        images: grey levels, 0 to 255.
        source, target: images of each pair.
        centres: middle of the window in the source image, pixels.
        positions: where it was aligned in the target image, pixels.
        warps: derivative of the position in the target image by that in the source image, with the present slopes.
        rates: derivative of the position in the target image by the logarithm of the inverse depth, pixels.
        options: size of the window.

    Returns:
        The equations of slopes in 1 / pixel.
    """
    offsets, grey, gx, gy = grey_windows(images, source, centres, options.window)
    seen = sample_images(images, target, positions[:, None] + offsets @ warps.mT)
    template, seen = (values - values.mean(1, keepdim=True) for values in (grey, seen))
    floor = _NOISE**2 * offsets.shape[1]
    gain = ((template.square().sum(1) + floor) / (seen.square().sum(1) + floor)).sqrt()
    error = seen * gain[:, None] - template
    back = torch.linalg.solve(warps, rates[..., None])[..., 0]  # the rates in the source image
    along = gx * back[:, :1] + gy * back[:, 1:]
    columns = torch.stack([along * offsets[..., 0], along * offsets[..., 1], gx, gy, template], 1)
    columns = columns - columns.mean(2, keepdim=True)
    matrix, vector = columns @ columns.mT, -(columns @ error[..., None])[..., 0]
    rest = matrix[:, 2:, 2:] + floor * torch.eye(3, dtype=images.dtype, device=images.device)
    share = torch.linalg.solve(rest, matrix[:, 2:, :2])
    information = 1 / (error.square().mean(1) + _NOISE**2)
    matrix, vector = (
        matrix[:, :2, :2] - matrix[:, :2, 2:] @ share,
        vector[:, :2] - (share.mT @ vector[:, 2:, None])[..., 0],
    )
    return SlopeEquations(matrix * information[:, None, None], vector * information[:, None])
