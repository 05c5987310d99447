"""Kernel of :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation` on an accelerator. Imports triton.

A program computes one pixel of a patch of one edge, and its sums are in a fixed order: the result is the same again.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from dvo.core.device_triton import on_device

CHANNELS = 32
"""Channels of the products that are summed at once."""


@triton.jit(do_not_specialize=["pixels", "height", "width"])
def correlate_pixel(  # type: ignore[no-untyped-def]
    maps,
    features,
    at,
    kk,
    frames,
    out,
    pixels,
    height,
    width,
    channels: tl.constexpr,
    taps: tl.constexpr,
    side: tl.constexpr,
    block: tl.constexpr,
):
    """Fill the windows of one pixel; programs ``(E q,)``, all tensors contiguous.

    Args:
        maps: ``(N, height, width, channels)``. features: ``(K, pixels, channels)``. at: ``(E, pixels, 2)``.
        kk, frames: ``(E,)`` int64.
        out: ``(E, pixels, taps - 1, taps - 1)``.
        taps: ``2 radius + 2``. side: that, rounded up to a power of two. block: of the channels.
    """
    row = tl.program_id(0).to(tl.int64)
    edge, pixel = row // pixels, row % pixels
    x, y = tl.load(at + 2 * row) - (taps // 2 - 1), tl.load(at + 2 * row + 1) - (taps // 2 - 1)
    unknown = (x != x) | (y != y)
    # A window beyond the border contains only zeros, at any position.
    x = tl.minimum(tl.maximum(tl.where(unknown, 0.0, x), -taps), (width - 2 * taps).to(tl.float32))
    y = tl.minimum(tl.maximum(tl.where(unknown, 0.0, y), -taps), (height - 2 * taps).to(tl.float32))
    left, top = tl.floor(x), tl.floor(y)
    fx, fy = x - left, y - top
    i = tl.arange(0, side)
    rows = (tl.load(frames + edge) * height + top.to(tl.int64) + taps + i) * width + left.to(tl.int64) + taps
    window = rows[:, None] + i[None, :]
    inside = (i < taps)[:, None] & (i < taps)[None, :]
    feature = (tl.load(kk + edge) * pixels + pixel) * channels
    products = tl.zeros((side, side), tl.float32)
    c = tl.arange(0, block)
    for first in range(0, channels, block):
        present = first + c < channels
        f = tl.load(features + feature + first + c, mask=present, other=0.0)
        place = maps + window[:, :, None] * channels + (first + c)[None, None, :]
        m = tl.load(place, mask=inside[:, :, None] & present[None, None, :], other=0.0)
        products += tl.sum(m * f[None, None, :], 2)
    # The next row and column of each: the only one that is not left out of a sum.
    below = tl.sum(tl.where(i[None, :, None] == i[:, None, None] + 1, products[None, :, :], 0.0), 1)
    blended = products + fy * (below - products)
    beside = tl.sum(tl.where(i[None, :, None] == i[None, None, :] + 1, blended[:, :, None], 0.0), 1)
    value = blended + fx * (beside - blended)
    value = tl.where(unknown, float("nan"), value)
    last: tl.constexpr = taps - 1
    place = out + row * last * last + i[:, None] * last + i[None, :]
    tl.store(place, value, mask=(i < last)[:, None] & (i < last)[None, :])


def correlate(maps: Tensor, features: Tensor, at: Tensor, kk: Tensor, frames: Tensor, radius: int) -> Tensor:
    """Look up edges at one level, as :func:`dvo.nets.correlation.edge_correlation.correlate_edges`.

    Args:
        maps, features, at, kk, frames, radius: see there; float32 and int64.

    Returns:
        ``(E, q, 2 radius + 1, 2 radius + 1)``.
    """
    (_, height, width, channels), (edges, pixels), taps = maps.shape, at.shape[:2], 2 * radius + 2
    out = at.new_empty(edges, pixels, taps - 1, taps - 1)
    given = (x.contiguous() for x in (maps, features, at, kk, frames))
    if out.numel():
        with on_device(maps):
            correlate_pixel[(edges * pixels,)](
                *given, out, pixels, height, width, channels, taps, triton.next_power_of_2(taps),
                min(CHANNELS, triton.next_power_of_2(channels)), num_warps=2, enable_fp_fusion=True,
            )  # fmt: skip
    return out
