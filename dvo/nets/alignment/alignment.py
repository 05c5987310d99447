"""Sub-pixel alignment of patches with other images (inverse-compositional Lucas-Kanade; Baker and Matthews, IJCV 2004).

The network measures a patch to about a quarter of a feature pixel, an image pixel. Where a patch has texture and looks
the same in the other image, alignment of the grey levels around it is several times more exact; where it does not, the
alignment is rejected and the measurement of the network stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dvo.core.kernels import use_kernels
from dvo.core.settings import check_settings

_LONGEST = 2.0  # pixels that one iteration may move
_NOISE = 1.0  # grey levels; weaker texture does not count
_SCALES = (0.25, 4.0)  # of the area of a patch, within which the affine warp of the grey levels is trusted


@dataclass(frozen=True)
class AlignmentOptions:
    """Options of the alignment, and conditions under which it replaces the measurement of the network.

    Attributes:
        window: side of the window of grey levels, pixels, odd.
        iterations: of Gauss-Newton.
        correlation: least zero-mean normalised correlation of the aligned windows, in [-1, 1].
        last_step: largest move of the last iteration, pixels.
        reach: largest distance from the measurement of the network, feature pixels.
        gain: factor of the weight of an aligned measurement in bundle adjustment.
        slope: standard deviation of the slopes of surfaces before they are measured (:mod:`dvo.nets.patch.slopes`), 1 /
            feature pixel; 0: surfaces of constant depth.

    Raises:
        DvoError: a value out of range.
    """

    window: int = 13
    iterations: int = 4
    correlation: float = 0.8
    last_step: float = 0.1
    reach: float = 0.3
    gain: float = 10.0
    slope: float = 0.0

    def __post_init__(self) -> None:
        check_settings(
            self,
            {
                "window": (3, 99),
                "iterations": (1, 100),
                "correlation": (-1, 1),
                "last_step": (0, 100),
                "reach": (0, 100),
                "gain": (0, 1e6),
                "slope": (0, 1),
            },
        )


@dataclass(frozen=True)
class Alignment:
    """Positions of the windows.

    Attributes:
        positions: ``(E, 2)`` x, y of their centres in the target images, pixels.
        correlation: ``(E,)`` zero-mean normalised correlation there.
        last_step: ``(E,)`` move of the last iteration, pixels.
    """

    positions: Tensor
    correlation: Tensor
    last_step: Tensor


def sample_images(
    images: Float[Tensor, "N H W"], frames: Int[Tensor, " E"], points: Float[Tensor, "E S 2"]
) -> Float[Tensor, "E S"]:
    """Sample images bilinearly; :func:`sample_images_plain` is its specification.

    Args:
        images: grey levels.
        frames: image of each row of points.
        points: x, y in pixels; positions outside take the value of the border.

    Returns:
        Grey levels, differentiable in images and points.
    """
    n, h, w = images.shape
    # All images one above the other, so that one call serves all; no point mixes two, as rows end at whole numbers.
    x = points[..., 0].clamp(0, w - 1) * (2 / (w - 1)) - 1
    y = (points[..., 1].clamp(0, h - 1) + (frames * h)[:, None]) * (2 / (n * h - 1)) - 1
    grid = torch.stack([x, y], -1)[None]
    column = images.reshape(1, 1, n * h, w)
    return F.grid_sample(column, grid, mode="bilinear", padding_mode="border", align_corners=True)[0, 0]


def sample_images_plain(
    images: Float[Tensor, "N H W"], frames: Int[Tensor, " E"], points: Float[Tensor, "E S 2"]
) -> Float[Tensor, "E S"]:
    """Twin of :func:`sample_images` by its definition."""
    _, h, w = images.shape
    x, y = points[..., 0].clamp(0, w - 1), points[..., 1].clamp(0, h - 1)
    left, top = x.detach().floor().clamp(max=w - 2), y.detach().floor().clamp(max=h - 2)
    u, v = x - left, y - top
    column, row, of = left.long(), top.long(), frames[:, None]
    above = images[of, row, column] * (1 - u) + images[of, row, column + 1] * u
    below = images[of, row + 1, column] * (1 - u) + images[of, row + 1, column + 1] * u
    return above * (1 - v) + below * v


def patch_warps(
    coords: Float[Tensor, "E p p 2"], tilts: Float[Tensor, "E 2 2"] | None = None
) -> Float[Tensor, "E 2 2"]:
    """Affine warps of patches from their reprojected pixels.

    Args:
        coords: reprojection of the pixels of each patch, all at the depth of its centre, ``p`` at least 3.
        tilts: what the slopes of the surfaces add to the derivatives; None for surfaces of constant depth.

    Returns:
        Derivative of the position in the target frame by the position in the patch; the identity where a patch is
        seen so obliquely, or grows or shrinks so much, that its window would not show the same.
    """
    if use_kernels(*((coords,) if tilts is None else (coords, tilts))):
        from dvo.nets.alignment.alignment_kernels import warps_of

        found = coords.new_empty(len(coords), 2, 2)
        known = found[:0] if tilts is None else tilts.contiguous()
        warps_of(coords.contiguous().numpy(), known.numpy(), *_SCALES, found.numpy())
        return found
    p = coords.shape[1]
    c, last = p // 2, p - 1
    columns = (coords[:, c, last] - coords[:, c, 0], coords[:, last, c] - coords[:, 0, c])
    warps = torch.stack(columns, -1) / last
    warps = warps if tilts is None else warps + tilts
    area = torch.linalg.det(warps)
    good = torch.isfinite(area) & (area > _SCALES[0]) & (area < _SCALES[1])
    return torch.where(good[:, None, None], warps, torch.eye(2, dtype=warps.dtype, device=warps.device))


def grey_windows(
    images: Float[Tensor, "N H W"], frames: Int[Tensor, " E"], centres: Float[Tensor, "E 2"], side: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Grey levels of windows around points, and their central differences.

    Args:
        images: grey levels.
        frames: image of each window.
        centres: of the windows, pixels.
        side: of the windows, pixels, odd.

    Returns:
        ``(1, S, 2)`` offsets of the ``S = side^2`` pixels from the centre; ``(E, S)`` their grey levels, and the
        derivatives of these by x and by y.
    """
    half = side // 2
    ticks = torch.arange(-half - 1, half + 2, dtype=images.dtype, device=images.device)
    offsets = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1)
    around = sample_images(images, frames, centres[:, None] + offsets.reshape(1, -1, 2)).unflatten(1, offsets.shape[:2])
    across = (around[:, 1:-1, 2:] - around[:, 1:-1, :-2]) / 2
    down = (around[:, 2:, 1:-1] - around[:, :-2, 1:-1]) / 2
    return offsets[1:-1, 1:-1].reshape(1, -1, 2), around[:, 1:-1, 1:-1].flatten(1), across.flatten(1), down.flatten(1)


def texture(
    images: Float[Tensor, "N H W"], frames: Int[Tensor, " E"], centres: Float[Tensor, "E 2"], side: int
) -> Float[Tensor, " E"]:
    """How strong the texture of windows is in the direction in which it is weakest (Shi and Tomasi, CVPR 1994).

    Along an edge, or on a bare surface, an alignment moves with the noise, however well the windows correlate.

    Args:
        images: grey levels.
        frames: image of each window.
        centres: of the windows, pixels.
        side: of the windows, pixels, odd.

    Returns:
        Root of the smaller eigenvalue of the mean structure tensor, grey levels a pixel.
    """
    if use_kernels(images, centres) and min(images.shape[1:]) > 1:
        from dvo.nets.alignment import alignment_kernels

        found = centres.new_empty(len(centres))
        arrays = images.contiguous().numpy(), frames.numpy(), centres.contiguous().numpy()
        alignment_kernels.texture(*arrays, side, found.numpy())
        return found
    _, _, gx, gy = grey_windows(images, frames, centres, side)
    a, b, c = gx.square().mean(1), (gx * gy).mean(1), gy.square().mean(1)
    return ((a + c) / 2 - (((a - c) / 2).square() + b.square()).sqrt()).clamp(min=0).sqrt()


def align_patches(
    images: Float[Tensor, "N H W"],
    source: Int[Tensor, " E"],
    target: Int[Tensor, " E"],
    centres: Float[Tensor, "E 2"],
    start: Float[Tensor, "E 2"],
    warps: Float[Tensor, "E 2 2"],
    options: AlignmentOptions = AlignmentOptions(),  # noqa: B008
) -> Alignment:
    """Align windows of source images with target images, up to gain and offset of the grey levels.

    Args:
        images: grey levels, 0 to 255.
        source, target: images of each pair.
        centres: middle of the window in the source image, pixels.
        start: position in the target image to start from, pixels.
        warps: derivative of the position in the target image by that in the source image; held.
        options: window and iterations.

    Returns:
        The alignment, differentiable in images, start and warps.

    Example:
        >>> image = torch.rand(240, 320).mul(255)
        >>> pair = torch.stack([image, image.roll(1, dims=1)])
        >>> centre = torch.tensor([[160.0, 120.0]])
        >>> one, two = torch.tensor([0]), torch.tensor([1])
        >>> found = align_patches(pair, one, two, centre, centre + 0.5, torch.eye(2)[None])
        >>> found.positions.shape
        torch.Size([1, 2])
    """
    if use_kernels(images, centres, start, warps) and min(images.shape[1:]) > 1:
        return _align_compiled(images, source, target, centres, start, warps, options)
    offsets, *window = grey_windows(images, source, centres, options.window)
    template, gx, gy = map(_centred, window)
    floor = _NOISE * options.window
    energy = template.square().sum(1) + floor
    # Damped by noise, so that a direction without texture does not move.
    a, b, c = gx.square().sum(1) + floor, (gx * gy).sum(1), gy.square().sum(1) + floor
    determinant = a * c - b * b
    warped = offsets @ warps.mT
    positions, length = start, torch.zeros_like(a)
    for _ in range(options.iterations):
        seen = _centred(sample_images(images, target, positions[:, None] + warped))
        gain = (energy / (seen.square().sum(1) + floor)).sqrt()
        error = seen * gain[:, None] - template
        u, v = (gx * error).sum(1), (gy * error).sum(1)
        step = torch.stack([c * u - b * v, a * v - b * u], -1) / determinant[:, None]
        step = (warps @ step[..., None])[..., 0]
        length = step.norm(dim=-1)
        positions = positions - step * (_LONGEST / length.clamp(min=_LONGEST))[:, None]
    seen = _centred(sample_images(images, target, positions[:, None] + warped))
    correlation = (seen * template).sum(1) / (energy * (seen.square().sum(1) + floor)).sqrt()
    return Alignment(positions, correlation, length)


def _align_compiled(
    images: Tensor, source: Tensor, target: Tensor, centres: Tensor, start: Tensor, warps: Tensor,
    options: AlignmentOptions,
) -> Alignment:  # fmt: skip
    """:func:`align_patches` by its kernel, which samples as :func:`sample_images_plain` does."""
    from dvo.nets.alignment.alignment_kernels import align

    grey, middle, begin, warp = (x.detach().contiguous().numpy() for x in (images, centres, start, warps))
    positions, quality = start.new_empty(len(begin), 2), start.new_empty(2, len(begin))
    align(
        grey, source.numpy(), target.numpy(), middle, begin, warp, options.window, options.iterations,
        _NOISE * options.window, _LONGEST, positions.numpy(), quality.numpy(),
    )  # fmt: skip
    return Alignment(positions, *quality)


def accept(
    found: Alignment, measured: Float[Tensor, "E 2"], size: tuple[int, int], pixels: float, options: AlignmentOptions
) -> Tensor:
    """Decide for each edge between the alignment and the measurement of the network.

    Args:
        found: the alignment.
        measured: positions measured by the network, pixels of the images.
        size: width and height of the images.
        pixels: image pixels to a feature pixel.
        options: conditions.

    Returns:
        ``(E,)`` bool, True for the alignment.
    """
    half = options.window // 2
    given = found.positions, found.correlation, found.last_step, measured
    if use_kernels(*given):
        from dvo.nets.alignment.alignment_kernels import accepted

        decided = torch.empty(len(measured), dtype=torch.bool)
        positions, correlation, last_step, network = (x.contiguous().numpy() for x in given)
        limits = options.reach * pixels, options.last_step, options.correlation
        accepted(positions, correlation, last_step, network, *size, half, *limits, decided.numpy())
        return decided
    x, y = found.positions.unbind(-1)
    inside = (x >= half) & (x <= size[0] - 1 - half) & (y >= half) & (y <= size[1] - 1 - half)
    near = (found.positions - measured).norm(dim=-1) <= options.reach * pixels
    converged = found.last_step <= options.last_step
    return inside & near & converged & (found.correlation >= options.correlation)


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(1, keepdim=True)
