"""Correlation of a tracker's edges, remembered between updates.

Between two updates an edge moves by a pixel or so, while most of the cost of :func:`correlate_windows` is fetching
features. Here the products of a patch with a window larger than needed are kept in a slot of the edge and looked up;
they are fetched again only when the edge has moved out of them. Equal to :func:`correlate_windows` in value.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dvo.nets.correlation import axis_taps

_NOWHERE = -(10**6)


class EdgeCorrelation:
    """Slots of one pyramid level.

    Args:
        scale: of the level relative to the features.
        pixels: patch pixels ``p * p``.
        radius: correlation radius.
        side: side of a slot's window in pixels of the level.
    """

    def __init__(self, scale: int, pixels: int, radius: int, side: int, device: torch.device | str) -> None:
        self.scale, self.pixels, self.radius, self.side = scale, pixels, radius, side
        self._products = torch.zeros(0, side * side, pixels, device=device)
        self._origin = torch.zeros(0, 2, dtype=torch.long, device=device)

    def forget(self, slots: Int[Tensor, " n"]) -> None:
        """Slots that get a new edge."""
        if len(slots):
            self._reserve(int(slots.max()) + 1)
            self._origin[slots] = _NOWHERE

    def _reserve(self, count: int) -> None:
        have = len(self._origin)
        if count > have:
            extra = max(count - have, have // 2, 256)
            self._products = torch.cat([self._products, self._products.new_zeros(extra, *self._products.shape[1:])])
            self._origin = torch.cat([self._origin, self._origin.new_full((extra, 2), _NOWHERE)])

    def lookup(
        self,
        coords: Float[Tensor, "E p p 2"],
        slots: Int[Tensor, " E"],
        features: Float[Tensor, "K C q"],
        maps: Float[Tensor, "n h w C"],
        kk: Int[Tensor, " E"],
        jj: Int[Tensor, " E"],
    ) -> Float[Tensor, "E c"]:
        """Correlation channels of this level.

        Args:
            coords: reprojected patch pixels in feature pixels (of scale 1).
            slots: of the edges.
            features: patch features, pixels last.
            maps: of the frames, at this level.
            kk, jj: patch, and index of the target frame among the maps.
        """
        e = len(slots)
        at = coords.reshape(e, self.pixels, 2) / self.scale
        self._refresh(at, slots, features, maps, kk, jj)
        reach = self.side - 2 * self.radius - 2
        local = (at - self._origin[slots][:, None] - self.radius).clamp(0, reach + 1 - 1e-4) + self.radius
        ix, ax, bx = axis_taps(local[..., 0], self.side, self.radius)
        iy, ay, by = axis_taps(local[..., 1], self.side, self.radius)
        pixel = torch.arange(self.pixels, device=kk.device)
        start = slots[:, None] * (self.side * self.side * self.pixels) + pixel
        iy = iy * (self.side * self.pixels) + start[..., None]
        ix, ax, bx = (t.mT.contiguous()[:, :, None, :] for t in (ix * self.pixels, ax, bx))
        iy, ay, by = (t.mT.contiguous()[:, None, :, :] for t in (iy, ay, by))
        index = ix + iy
        values = self._products.view(-1).index_select(0, index.view(-1)).view(index.shape)
        rows = torch.addcmul(values[:, :, :-1] * ay, values[:, :, 1:], by)
        return torch.addcmul(rows[:, :-1] * ax, rows[:, 1:], bx).reshape(e, -1)

    def _refresh(self, at: Tensor, slots: Tensor, features: Tensor, maps: Tensor, kk: Tensor, jj: Tensor) -> None:
        """Fetch the windows of the edges that have left theirs."""
        _, h, w, c = maps.shape
        margin = 2 * self.side
        limit = torch.tensor([w + margin, h + margin], device=at.device)
        centre = at[:, self.pixels // 2].clamp(min=-float(margin)).minimum(limit.to(at.dtype)).floor().long()
        wanted = centre - (self.side // 2 - 1)
        origin = self._origin[slots]
        # A patch seen much larger than a window can hold stays clamped; only its centre decides then.
        low = at.amin(1).clamp(min=-float(margin)).minimum(limit.to(at.dtype)).floor().long() - self.radius
        high = at.amax(1).clamp(min=-float(margin)).minimum(limit.to(at.dtype)).floor().long() + self.radius + 1
        outside = ((low < origin) | (high >= origin + self.side)).any(-1)
        stale = (outside & (origin != wanted).any(-1)).nonzero()[:, 0]
        if not len(stale):
            return
        wanted = wanted[stale]
        taps = torch.arange(self.side, device=at.device)
        x, y = wanted[:, :1] + taps, wanted[:, 1:] + taps
        inside = ((y >= 0) & (y < h))[:, :, None] & ((x >= 0) & (x < w))[:, None, :]
        rows = (jj[stale, None] * h + y.clamp(0, h - 1))[:, :, None] * w + x.clamp(0, w - 1)[:, None, :]
        window = maps.reshape(-1, c).index_select(0, rows.flatten()).view(len(stale), -1, c)
        products = torch.bmm(window, features[kk[stale]]) * inside.flatten(1)[..., None]
        self._products[slots[stale]] = products
        self._origin[slots[stale]] = wanted
