"""Correlation of two feature maps over a square of displacements (the cost volume of PWC-Net, Sun et al., CVPR 2018).

:func:`local_correlation` computes it by products of matrices; :func:`local_correlation_plain` is its specification,
and the tests compare values and gradients of the two.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def local_correlation(
    first: Float[Tensor, "B C h w"], second: Float[Tensor, "B C h w"], radius: int
) -> Float[Tensor, "B K h w"]:
    """Correlate each pixel of a map with the pixels of another one around the same place.

    A row of the first map times a row of the second one is a matrix of which a band of ``2 radius + 1`` diagonals is
    wanted; read as a matrix with rows longer by one, the band becomes columns, without a copy of single elements.

    Args:
        first, second: feature maps.
        radius: largest displacement, feature pixels.

    Returns:
        Dot products over ``sqrt(C)``; channel ``(dy + radius) (2 radius + 1) + dx + radius`` belongs to pixel
        ``(x + dx, y + dy)`` of the second map, and is zero where that lies outside.

    Example:
        >>> a, b = torch.randn(2, 1, 16, 12, 16)
        >>> local_correlation(a, b, 3).shape
        torch.Size([1, 49, 12, 16])
    """
    b, c, h, w = first.shape
    side, length = 2 * radius + 1, w + 2 * radius
    rows = (first / c**0.5).permute(0, 2, 3, 1).reshape(b * h, w, c)
    rows = F.pad(rows, (0, 0, 0, 1))  # one more, so that the longer rows end within the products
    padded = F.pad(second, (radius, radius, radius, radius)).transpose(1, 2).contiguous()  # (B, h + 2r, C, w + 2r)
    found = []
    for dy in range(side):
        products = torch.bmm(rows, padded[:, dy : dy + h].reshape(b * h, c, length))
        # Element (x, x + k) of rows of this length is element (x, k) of rows that are longer by one.
        band = products.flatten(1)[:, : w * (length + 1)].unflatten(1, (w, length + 1))[..., :side]
        found.append(band.unflatten(0, (b, h)))
    return torch.stack(found, 1).permute(0, 1, 4, 2, 3).reshape(b, side * side, h, w)


def local_correlation_plain(
    first: Float[Tensor, "B C h w"], second: Float[Tensor, "B C h w"], radius: int
) -> Float[Tensor, "B K h w"]:
    """Compute :func:`local_correlation` one displacement at a time; for tests, since its gradient takes longer.

    Args:
        first, second, radius: as there.

    Returns:
        The same values.
    """
    h, w = first.shape[-2:]
    padded = F.pad(second, (radius, radius, radius, radius))
    shifts = range(2 * radius + 1)
    products = [(first * padded[..., dy : dy + h, dx : dx + w]).sum(1) for dy in shifts for dx in shifts]
    return torch.stack(products, 1) / first.shape[1] ** 0.5


def warp(features: Float[Tensor, "B C h w"], flow: Float[Tensor, "B 2 h w"]) -> Float[Tensor, "B C h w"]:
    """Fetch features from where a flow points to, by bilinear interpolation.

    Args:
        features: of the second image.
        flow: from the first image to the second, feature pixels.

    Returns:
        ``features`` at ``(x, y) + flow(x, y)``, zero outside of the map.
    """
    h, w = features.shape[-2:]
    flow = flow.float()
    x = torch.arange(w, device=flow.device) + flow[:, 0]
    y = torch.arange(h, device=flow.device)[:, None] + flow[:, 1]
    grid = torch.stack([(2 * x + 1) / w - 1, (2 * y + 1) / h - 1], -1)
    return F.grid_sample(features.float(), grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def double(flow: Float[Tensor, "B 2 h w"], height: int, width: int) -> Float[Tensor, "B 2 H W"]:
    """Resample a flow to a map of twice the resolution.

    Args:
        flow: feature pixels; pixel ``u`` lies on pixel ``2 u`` of the result, as in encoders of centred convolutions.
        height, width: of the result, ``2 h`` or ``2 h - 1`` and ``2 w`` or ``2 w - 1``.

    Returns:
        The flow in pixels of the result, continued at the last row and column.
    """
    h, w = flow.shape[-2:]
    fine = F.interpolate(2 * flow, size=(2 * h - 1, 2 * w - 1), mode="bilinear", align_corners=True)
    return F.pad(fine, (0, width - 2 * w + 1, 0, height - 2 * h + 1), mode="replicate")
