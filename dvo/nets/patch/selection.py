"""Selection of the patches of a frame.

A selection gives the centres of the patches from the images; a network names the one that it was trained with
(``selection`` of its configuration), and the tracker uses the same unless its settings name another.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dvo.core.kernels import use_kernels
from dvo.core.registry import Registry

SELECTIONS = Registry(
    "patch selection",
    "dvo.patch_selections",
    {
        "random": "dvo.nets.patch.selection:random_selection",
        "grid": "dvo.nets.patch.selection:grid_selection",
        "structure": "dvo.nets.patch.selection:structure_selection",
    },
)
"""Names to ``"module:function"`` of a :class:`PatchSelection`."""

CANDIDATES = 4
"""Random positions in a cell of the grid, of which ``structure`` takes the best."""
_STRIDE = 4  # image pixels to a feature pixel
_BOX = 7  # side of the window of the structure tensor, image pixels


class PatchSelection(Protocol):
    """Interface of a patch selection."""

    def __call__(self, images: Tensor, patches: int, generator: torch.Generator | None) -> Tensor:
        """Choose the centres of the patches.

        Args:
            images: ``(B, N, 3, H, W)`` RGB, uint8 or float in [0, 255]; any size.
            patches: number in each frame.
            generator: of all random numbers, on the CPU, so that these do not depend on the device of the images.

        Returns:
            ``(B, N, patches, 2)`` int64 ``x, y`` in feature pixels, at least one from the border of
            the feature map ``(H / 4, W / 4)``, on the device of the images.
        """
        ...


def random_centres(
    frames: int, patches: int, height: int, width: int, generator: torch.Generator | None, batch: int = 1
) -> Tensor:
    """Integer patch centres, uniform over the feature map without its border.

    Args:
        frames: number of frames.
        patches: number of patches in each frame.
        height, width: size of the feature map.
        generator: on the CPU, so that the centres do not depend on the device of the network.
        batch: number of clips.

    Returns:
        ``(batch, frames, patches, 2)`` int64 ``x, y`` in ``[1, width - 2] x [1, height - 2]``.
    """
    shape = (batch, frames, patches)
    x = torch.randint(1, width - 1, shape, generator=generator)
    y = torch.randint(1, height - 1, shape, generator=generator)
    return torch.stack([x, y], dim=-1)


def random_selection(
    images: Float[Tensor, "B N 3 H W"], patches: int, generator: torch.Generator | None = None
) -> Float[Tensor, "B N M 2"]:
    """Uniform positions, as DPVO. For arguments and result see :class:`PatchSelection`."""
    b, n, height, width = _feature_size(images)
    return random_centres(n, patches, height, width, generator, b).to(images.device)


def grid_selection(
    images: Float[Tensor, "B N 3 H W"], patches: int, generator: torch.Generator | None = None
) -> Float[Tensor, "B N M 2"]:
    """One uniform position in each cell of a grid. For arguments and result see :class:`PatchSelection`."""
    b, n, height, width = _feature_size(images)
    return _positions(b, n, patches, 1, height, width, generator)[..., 0, :].to(images.device)


def structure_selection(
    images: Float[Tensor, "B N 3 H W"], patches: int, generator: torch.Generator | None = None
) -> Float[Tensor, "B N M 2"]:
    """Best of four uniform positions in each cell of a grid, by the structure tensor.

    The grid keeps the patches apart, so that a frame with texture in few places is measured elsewhere too. For
    arguments and result see :class:`PatchSelection`.

    Example:
        >>> images = torch.randint(0, 256, (1, 1, 3, 96, 128), dtype=torch.uint8)
        >>> structure_selection(images, 24).shape
        torch.Size([1, 1, 24, 2])
    """
    b, n, height, width = _feature_size(images)
    points = _positions(b, n, patches, CANDIDATES, height, width, generator).to(images.device)
    return _best(points, score_at(images, points.flatten(2, 3)))


def score_at(images: Float[Tensor, "B N 3 H W"], points: Int[Tensor, "B N P 2"]) -> Float[Tensor, "B N P"]:
    """:func:`structure_score` at some feature positions ``x, y``."""
    if images.dtype == torch.uint8 and images.device.type == "cpu" and use_kernels():
        from dvo.nets.patch.selection_kernels import structure_scores

        scores = torch.empty(points.shape[:-1])
        for image, places, out in zip(*(x.flatten(0, 1).numpy() for x in (images, points, scores)), strict=True):
            structure_scores(image, places, _STRIDE, _BOX, out)
        return scores
    scores = structure_score(images)
    index = points[..., 1] * scores.shape[-1] + points[..., 0]
    return scores.flatten(2).gather(2, index)


def structure_score(images: Float[Tensor, "B N 3 H W"]) -> Float[Tensor, "B N h w"]:
    """Smaller eigenvalue of the structure tensor over 7x7 pixels (Shi and Tomasi, CVPR 1994) at the feature positions.

    Args:
        images: RGB, uint8 or float in [0, 255].

    Returns:
        At a quarter of the resolution, in squared grey levels (of 0 to 255) per squared pixel; 0 without texture or for
        an edge.
    """
    grey = images.flatten(0, 1).float().mean(1, keepdim=True)
    around = F.pad(grey, (1, 1, 1, 1), mode="replicate")
    gx = (around[..., 1:-1, 2:] - around[..., 1:-1, :-2]) / 2
    gy = (around[..., 2:, 1:-1] - around[..., :-2, 1:-1]) / 2
    half = _BOX // 2
    products = F.pad(torch.cat([gx * gx, gy * gy, gx * gy], 1), (half, half, half, half))
    xx, yy, xy = F.avg_pool2d(products, _BOX, _STRIDE).unbind(1)
    least = (xx + yy) / 2 - ((xx - yy).square() / 4 + xy.square()).sqrt()
    return least.clamp(min=0).unflatten(0, images.shape[:2])


def _feature_size(images: Tensor) -> tuple[int, int, int, int]:
    b, n, _, height, width = images.shape
    return b, n, math.ceil(height / _STRIDE), math.ceil(width / _STRIDE)


def _best(points: Tensor, scores: Tensor) -> Tensor:
    """The position with the highest score of each cell.

    Args:
        points: ``(B, N, M, candidates, 2)``.
        scores: ``(B, N, M * candidates)``.

    Returns:
        ``(B, N, M, 2)``.
    """
    best = scores.unflatten(2, points.shape[2:4]).argmax(-1)[..., None, None].expand(-1, -1, -1, 1, 2)
    return points.gather(3, best)[..., 0, :]


def _positions(
    batch: int, frames: int, patches: int, candidates: int, height: int, width: int, generator: torch.Generator | None
) -> Tensor:
    """Uniform positions ``(batch, frames, patches, candidates, 2)`` in different cells of a grid without the border.

    The cells are nearly square and at least as many as the patches; those without a patch are chosen at random.
    """
    columns = min(patches, max(1, round(math.sqrt(patches * width / height))))
    rows = math.ceil(patches / columns)
    shape = (batch, frames, rows * columns)
    cells = torch.rand(shape, generator=generator).argsort(-1)[..., :patches]
    corners = torch.stack([cells % columns, cells // columns], -1)
    inside = torch.rand(batch, frames, patches, candidates, 2, generator=generator)
    size = torch.tensor([(width - 2) / columns, (height - 2) / rows])
    limit = torch.tensor([width - 2, height - 2])
    return ((corners[..., None, :] + inside) * size).long().add(1).minimum(limit)
