"""Correlation of patches with neighbourhoods of feature maps (DPVO 3.2).

For each edge and each of the ``p * p`` patch pixels, at its reprojected position: dot products of the pixel's feature
with the ``(2r + 2)^2`` nearest map features, bilinearly blended to ``(2r + 1)^2``; zero outside the map.

Three implementations give the same values:

- :func:`correlate_reference`, the specification: bilinear sampling of the features, then dot products.
- :class:`CorrelationVolume`: all products of a clip as one matrix product, then cheap look-ups. For training.
- :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation`: products with one window of features an edge. For
  tracking, where the volume would not fit.

An update operator receives them as :class:`Correlation`, which states the order of the channels. Positions receive no
gradient, as in RAFT.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dvo.geometry.precision import full_precision
from dvo.map.edges import PatchGraph
from dvo.nets.patch.patchifier import pool_levels

ChannelOrder = Literal["offsets_first", "pixels_first"]
"""``offsets_first``: x offset slowest, then y offset, patch row, patch column, as DPVO's weights expect.
``pixels_first``: patch row slowest, then patch column, y offset, x offset, which is the fastest order to read from
memory."""


@dataclass(frozen=True)
class Correlation:
    """Correlation channels of a set of edges.

    Attributes:
        levels: ``(B, E, (2r+1)^2 * p^2)`` a level of the pyramid. DPVO interleaves the levels (level fastest);
            :class:`dvo.nets.update.update.Update` undoes that on the weights of its first layer rather than on every
            edge.
        order: order of the channels of a level.
    """

    levels: list[Tensor]
    order: ChannelOrder = "offsets_first"


class CorrelationLookup(Protocol):
    """Interface of a correlation look-up: edges of a graph at given positions to correlation channels.

    The part of a step that differs between the training loop and the tracker.
    """

    def __call__(self, coords: Float[Tensor, "B E p p 2"], graph: PatchGraph) -> Correlation:
        """Look up the correlation.

        Args:
            coords: reprojected patch pixels ``x, y`` in feature pixels.
            graph: the ``E`` edges.

        Returns:
            Channels of every edge, by pyramid level.
        """
        ...


def correlate_reference(
    patches: Float[Tensor, "B K C p p"],
    maps: Float[Tensor, "B N C h w"],
    coords: Float[Tensor, "B E p p 2"],
    kk: Int[Tensor, " E"],
    jj: Int[Tensor, " E"],
    pyramid: tuple[int, ...] = (1, 4),
    radius: int = 3,
) -> list[Tensor]:
    """Reference implementation: plain, slow and with a large memory footprint.

    Args:
        patches: matching features of the patches.
        maps: matching features of the frames.
        coords: reprojected patch pixels ``x, y`` in feature pixels.
        kk, jj: patch and target frame of each edge.
        pyramid: down-sampling of each level relative to ``maps``.
        radius: correlation radius in pixels of each level.

    Returns:
        One tensor ``(B, E, (2r+1)^2 * p^2)`` for each level, channels in the order ``offsets_first``.
    """
    b, e, p = coords.shape[:3]
    steps = torch.arange(-radius, radius + 1, device=coords.device, dtype=coords.dtype)
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1)  # (x_off, y_off, 2)
    levels = []
    for level, scale in zip(pool_levels(maps, pyramid), pyramid, strict=True):
        h, w = level.shape[-2:]
        at = coords.detach()[:, :, None, None] / scale + offsets[:, :, None, None, :]  # b e X Y p p 2
        grid = torch.stack([2 * at[..., 0] / max(w - 1, 1) - 1, 2 * at[..., 1] / max(h - 1, 1) - 1], dim=-1)
        target = level[:, jj].flatten(0, 1)
        sampled = F.grid_sample(target, grid.reshape(b * e, 1, -1, 2), align_corners=True)
        sampled = sampled.reshape(b, e, -1, *at.shape[2:6])
        levels.append(torch.einsum("becxypq,becpq->bexypq", sampled, patches[:, kk]).flatten(2))
    return levels


def axis_taps(position: Tensor, size: int, radius: int) -> tuple[Tensor, Tensor, Tensor]:
    """Indices and bilinear weights of a look-up along one axis.

    Args:
        position: ``(...,)`` sub-pixel position.
        size: number of pixels along the axis.
        radius: correlation radius ``r``.

    Returns:
        ``(..., 2r+2)`` int64 indices clamped to the axis, and the weights ``(..., 2r+1)`` of the lower and the upper
        neighbour of each tap; a neighbour outside ``[0, size)`` has weight 0, so its clamped index does not contribute.
    """
    # Far-away projections would overflow the integers; they are out of the map either way.
    position = position.clamp(-4.0 * radius - 8, size + 4.0 * radius + 8)
    base = position.floor()
    fraction = (position - base)[..., None]
    taps = torch.arange(-radius, radius + 2, device=position.device)
    index = base.long()[..., None] + taps
    inside = ((index >= 0) & (index < size)).to(position.dtype)
    return index.clamp(0, size - 1), (1 - fraction) * inside[..., :-1], fraction * inside[..., 1:]


class _Volume(torch.autograd.Function):
    """All dot products of patch pixels and map pixels.

    A dense gradient of the volume for every look-up would be as large as the volume. Instead each look-up accumulates
    its gradient in one buffer and returns a scalar token to autograd, which calls this backward after all look-ups.
    """

    @staticmethod
    def forward(ctx: Any, patches: Tensor, maps: Tensor, store: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(patches, maps)
        ctx.store = store
        volume = torch.matmul(patches, maps)
        ctx.mark_non_differentiable(volume)
        return volume, patches.new_zeros(())

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        patches, maps = ctx.saved_tensors
        grad = ctx.store.pop("grad", None)
        if grad is None:
            return None, None, None
        grad = grad.view(*patches.shape[:-1], maps.shape[-1])
        return torch.matmul(grad, maps.mT), torch.matmul(patches.mT, grad), None


class _Lookup(torch.autograd.Function):
    """Bilinear look-up of windows in slices of a volume, see :class:`CorrelationVolume`."""

    @staticmethod
    def forward(
        ctx: Any,
        token: Tensor,
        volume: Tensor,
        start: Tensor,
        position: Tensor,
        size: tuple[int, int],
        radius: int,
        learn: Tensor | None,
        store: dict[str, Tensor],
    ) -> Tensor:
        h, w = size
        ix, ax, bx = axis_taps(position[..., 0], w, radius)
        iy, ay, by = axis_taps(position[..., 1], h, radius)
        # (edges, pixels, taps) -> (edges, x taps, y taps, pixels), the order of DPVO's channels
        ix, ax, bx = (t.mT.contiguous()[:, :, None, :] for t in (ix, ax, bx))
        iy, ay, by = (t.mT.contiguous()[:, None, :, :] for t in (iy * w + start[..., None], ay, by))
        index = ix + iy
        values = volume.view(-1).index_select(0, index.view(-1)).view(index.shape)  # several times faster than take
        rows = torch.addcmul(values[:, :, :-1] * ay, values[:, :, 1:], by)
        out = torch.addcmul(rows[:, :-1] * ax, rows[:, 1:], bx)
        if learn is not None:
            index, ax, bx, ay, by = (t[learn] for t in (index, ax, bx, ay, by))
        ctx.save_for_backward(index, ax, bx, ay, by, learn)
        ctx.store, ctx.length = store, volume.numel()
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        index, ax, bx, ay, by, learn = ctx.saved_tensors
        grad = grads[0] if learn is None else grads[0][learn]
        rows = F.pad(grad * ax, (0, 0, 0, 0, 0, 1)) + F.pad(grad * bx, (0, 0, 0, 0, 1, 0))
        values = F.pad(rows * ay, (0, 0, 0, 1)) + F.pad(rows * by, (0, 0, 1, 0))
        if "grad" not in ctx.store:
            ctx.store["grad"] = values.new_zeros(ctx.length)
        ctx.store["grad"].index_add_(0, index.flatten(), values.flatten())
        return (grad.new_zeros(()), *[None] * 7)


class CorrelationVolume:
    """All correlations of a clip, computed once and looked up at every update.

    Memory is ``B * K * p^2 * N * h * w`` floats, summed over the levels.

    Args:
        patches: ``(B, K, C, p, p)`` matching features of the patches, of any height and width, up to whole frames.
        maps: ``(B, N, C, h, w)`` matching features of the frames.
        pyramid: down-sampling of each level relative to ``maps``.
        radius: correlation radius in pixels of each level.
    """

    def __init__(self, patches: Tensor, maps: Tensor, pyramid: tuple[int, ...] = (1, 4), radius: int = 3) -> None:
        b, k, c, p, q = patches.shape
        self.radius, self.pyramid, self.frames = radius, pyramid, maps.shape[1]
        self.pixels, self.patches = p * q, k
        if patches.dtype in (torch.float16, torch.bfloat16):  # too coarse to place a peak between two pixels
            patches, maps = patches.float(), maps.float()
        rows = patches.permute(0, 1, 3, 4, 2).reshape(b, k * p * q, c)
        self.levels = []
        for level in pool_levels(maps, pyramid):
            columns = level.permute(0, 2, 1, 3, 4).reshape(b, c, -1)
            store: dict[str, Tensor] = {}
            with full_precision(rows.device):
                volume, token = _Volume.apply(rows, columns, store)
            self.levels.append((volume, token, store, (level.shape[-2], level.shape[-1])))

    def lookup(
        self,
        coords: Float[Tensor, "B E p p 2"],
        kk: Int[Tensor, " E"],
        jj: Int[Tensor, " E"],
        learn: Int[Tensor, " L"] | None = None,
    ) -> list[Tensor]:
        """Correlation channels of a set of edges, equal to :func:`correlate_reference`.

        Args:
            coords: reprojected patch pixels ``x, y`` in feature pixels; they receive no gradient.
            kk, jj: patch and target frame of each edge.
            learn: indices into the flattened ``B * E`` edges that propagate a gradient to the features (DPVO uses a
                random fifth), or None for all.

        Returns:
            One tensor ``(B, E, (2r+1)^2 * p^2)`` for each level, channels in the order ``offsets_first``.
        """
        b, e = coords.shape[:2]
        position = coords.detach().reshape(b * e, self.pixels, 2)
        pixel = torch.arange(self.pixels, device=kk.device)
        clip = torch.arange(b, device=kk.device) * (self.patches * self.pixels)
        row = (clip[:, None, None] + kk[:, None] * self.pixels + pixel).reshape(b * e, self.pixels)
        frame = jj.repeat(b)[:, None]
        levels = []
        for (volume, token, store, (h, w)), scale in zip(self.levels, self.pyramid, strict=True):
            start = (row * self.frames + frame) * (h * w)
            args = (position / scale, (h, w), self.radius, learn, store)
            levels.append(_Lookup.apply(token, volume, start, *args).reshape(b, e, -1))
        return levels
