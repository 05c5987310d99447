"""Correlation of the edges of a sliding window, cached between updates.

Between two updates an edge moves by about a pixel, while most of the cost of correlating it is fetching features. Here
the products of a patch with a window larger than needed are kept in a slot of the edge and looked up; they are computed
again only when the edge has moved out of them. Equal to :func:`dvo.nets.correlation.correlate_reference` in value, up
to the order of the channels.

Memory is read in runs: the maps carry a border of zeros as wide as a window, so that a row of a window is one piece of
memory wherever it lies, and products are kept with x fastest, so that a row of a look-up is one too.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_NOWHERE = -(10**6)
PIECE = 256  # edges at once: what is in work should stay in the processor's cache


class EdgeCorrelation:
    """Maps and slots of one pyramid level.

    Args:
        scale: of the level relative to the features.
        pixels: patch pixels ``p * p``.
        radius: correlation radius.
        side: side of a slot's window in pixels of the level.
    """

    def __init__(self, scale: int, pixels: int, radius: int, side: int, device: torch.device | str) -> None:
        self.scale, self.pixels, self.radius, self.side = scale, pixels, radius, side
        self._maps = torch.zeros(0, 0, 0, 0, device=device)
        self._products = torch.zeros(0, pixels, side, side, device=device)
        self._origin = torch.zeros(0, 2, dtype=torch.long, device=device)

    def __len__(self) -> int:
        """Number of edge slots that memory is reserved for."""
        return len(self._origin)

    def keep_map(self, slot: int, level: Float[Tensor, "C h w"]) -> None:
        """Put the features of a frame into a slot for frames; the store grows while it fills."""
        c, h, w = level.shape
        have, s = len(self._maps), self.side
        if slot >= have:
            grown = level.new_zeros(slot + 1, h + 2 * s, w + 2 * s, c)
            if have:
                grown[:have] = self._maps
            self._maps = grown
        self._maps[slot, s : s + h, s : s + w] = level.permute(1, 2, 0)

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
        kk: Int[Tensor, " E"],
        frames: Int[Tensor, " E"],
    ) -> Float[Tensor, "E c"]:
        """Correlation channels of this level, ordered patch row, patch column, y offset, x offset.

        Args:
            coords: reprojected patch pixels in feature pixels (of scale 1).
            slots: of the edges.
            features: patch features, pixels last.
            kk: patch of each edge.
            frames: slot of the target frame of each edge.
        """
        e, s, r = len(slots), self.side, self.radius
        taps = 2 * r + 2
        at = coords.reshape(e, self.pixels, 2) / self.scale
        self._refresh(at, slots, features, kk, frames)
        local = (at - self._origin[slots][:, None] - r).clamp(0, s - taps + 1 - 1e-4)
        base = local.floor()
        fx, fy = (local - base)[..., None, None, :].unbind(-1)
        x, y = base.long().unbind(-1)
        pixel = torch.arange(self.pixels, device=kk.device)
        start = ((slots[:, None] * self.pixels + pixel) * s + y) * s + x
        index = start[..., None] + torch.arange(taps, device=kk.device) * s
        runs = self._products.as_strided((self._products.numel() - taps + 1, taps), (1, 1))
        out = local.new_empty(e, self.pixels, taps - 1, taps - 1)
        for a in range(0, e, PIECE):
            part = slice(a, a + PIECE)
            values = runs.index_select(0, index[part].flatten()).view(-1, self.pixels, taps, taps)
            rows = torch.lerp(values[..., :-1, :], values[..., 1:, :], fy[part])
            out[part] = torch.lerp(rows[..., :-1], rows[..., 1:], fx[part])
        return out.view(e, -1)

    def _refresh(self, at: Tensor, slots: Tensor, features: Tensor, kk: Tensor, frames: Tensor) -> None:
        """Fetch the windows of the edges that have left theirs."""
        s, r = self.side, self.radius
        _, height, width, c = self._maps.shape
        # A window beyond the border sees zeros wherever it is.
        limit = torch.tensor([width - 2 * s, height - 2 * s], device=at.device)
        at = at.clamp(-1e5, 1e5).floor().long()  # far-away projections would overflow the integers
        wanted = (at[:, self.pixels // 2] - (s // 2 - 1)).clamp(min=-s).minimum(limit)
        origin = self._origin[slots]
        # A patch seen much larger than a window can hold stays clamped; only its centre decides then.
        outside = ((at.amin(1) - r < origin) | (at.amax(1) + r + 1 >= origin + s)).any(-1)
        stale = (outside & (origin != wanted).any(-1)).nonzero()[:, 0]
        runs = self._maps.as_strided((self._maps.numel() // c - s + 1, s * c), (c, 1)) if len(stale) else self._maps
        x, y = (wanted + s).unbind(-1)
        first = (frames * height + y) * width + x
        steps = torch.arange(s, device=at.device) * width
        for edges in stale.split(PIECE // 4):
            window = runs.index_select(0, (first[edges, None] + steps).flatten()).view(len(edges), s * s, c)
            products = torch.bmm(features[kk[edges]].mT, window.mT)
            self._products[slots[edges]] = products.view(len(edges), self.pixels, s, s)
        self._origin[slots[stale]] = wanted[stale]
