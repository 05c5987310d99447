"""Correlation of the edges of a sliding window, cached between updates.

Between two updates an edge moves by about a pixel, while most of the cost of its correlation is reading features. The
products of a patch with a window larger than needed are therefore cached in a slot of the edge; they are computed again
only when the edge moves out of the window. Values equal :func:`dvo.nets.correlation.correlation.correlate_reference`,
up to the order of the channels.

Memory is read contiguously: the maps are padded with zeros by the width of a window, so that a row of a window is one
contiguous range at every position, and products are stored with x fastest, so that a row of a look-up is one too.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_NOWHERE = -(10**6)
FIRST_MAPS = 8  # map slots that memory is reserved for at first
PIECE = 256  # edges processed at once, so that the working set fits in the processor's cache


class EdgeCorrelation:
    """Cached correlation of edges at one pyramid level.

    Frames have map slots and edges have edge slots; both are assigned by the caller
    (:class:`dvo.odometry.window.correlation.WindowCorrelation`).

    Args:
        scale: down-sampling of the level relative to the features.
        pixels: patch pixels ``p * p``.
        radius: correlation radius in pixels of the level.
        side: side of the cached window, pixels of the level; at least ``2 * radius + 2``.
        device: of the caches.

    Example:
        >>> cache = EdgeCorrelation(scale=1, pixels=9, radius=3, side=14, device="cpu")
        >>> cache.keep_map(0, torch.randn(32, 30, 40))
        >>> slots = torch.arange(2)
        >>> cache.forget(slots)
        >>> coords = torch.full((2, 3, 3, 2), 12.0)
        >>> kk, frames = torch.tensor([0, 1]), torch.tensor([0, 0])
        >>> cache.lookup(coords, slots, torch.randn(2, 32, 9), kk, frames).shape
        torch.Size([2, 441])
    """

    def __init__(self, scale: float, pixels: int, radius: int, side: int, device: torch.device | str) -> None:
        self.scale, self.pixels, self.radius, self.side = scale, pixels, radius, side
        self._maps = torch.zeros(0, 0, 0, 0, device=device)
        self._products = torch.zeros(0, pixels, side, side, device=device)
        self._origin = torch.zeros(0, 2, dtype=torch.long, device=device)

    def __len__(self) -> int:
        """Number of edge slots that memory is reserved for."""
        return len(self._origin)

    def keep_map(self, slot: int, level: Float[Tensor, "C h w"]) -> None:
        """Store the features of a frame; the storage grows with the largest slot, by doubling.

        Args:
            slot: map slot of the frame; its content is overwritten.
            level: features of the frame at this level.
        """
        c, h, w = level.shape
        have, s = len(self._maps), self.side
        if slot >= have:
            grown = level.new_zeros(max(slot + 1, 2 * have, FIRST_MAPS), h + 2 * s, w + 2 * s, c)
            if have:
                grown[:have] = self._maps
            self._maps = grown
        self._maps[slot, s : s + h, s : s + w] = level.permute(1, 2, 0)

    def forget(self, slots: Int[Tensor, " n"]) -> None:
        """Invalidate the cached windows of edge slots that are assigned to new edges.

        Args:
            slots: edge slots; storage is reserved for new ones.
        """
        if len(slots):
            self._reserve(int(slots.max()) + 1)
            self._origin[slots] = _NOWHERE

    def _reserve(self, count: int) -> None:
        have = len(self._origin)
        if count > have:
            extra = max(count - have, have // 2, 256)
            self._products = torch.cat([self._products, self._products.new_zeros(extra, *self._products.shape[1:])])
            self._origin = torch.cat([self._origin, self._origin.new_full((extra, 2), _NOWHERE)])

    def origins(self, slots: Int[Tensor, " n"]) -> Int[Tensor, "n 2"]:
        """Upper left corners of the cached windows, from which :meth:`restore` computes the same products again.

        Args:
            slots: edge slots.

        Returns:
            ``x, y`` in pixels of the level; far outside of the map for a window that has not been computed.
        """
        return self._origin[slots]

    def restore(
        self,
        origins: Int[Tensor, "n 2"],
        slots: Int[Tensor, " n"],
        features: Float[Tensor, "K C q"],
        kk: Int[Tensor, " n"],
        frames: Int[Tensor, " n"],
    ) -> None:
        """Compute the cached windows of edges at given positions.

        Args:
            origins: see :meth:`origins`.
            slots: edge slots; storage is reserved for new ones.
            features, kk, frames: see :meth:`lookup`.
        """
        self.forget(slots)
        known = (origins != _NOWHERE).any(-1).nonzero()[:, 0]
        if len(known):
            self._fill(origins[known], slots[known], features, kk[known], frames[known])

    def lookup(
        self,
        coords: Float[Tensor, "E p p 2"],
        slots: Int[Tensor, " E"],
        features: Float[Tensor, "K C q"],
        kk: Int[Tensor, " E"],
        frames: Int[Tensor, " E"],
    ) -> Float[Tensor, "E c"]:
        """Correlation channels of this level.

        Args:
            coords: reprojected patch pixels ``x, y`` in feature pixels (of scale 1).
            slots: edge slot of each edge.
            features: patch features, pixels last.
            kk: patch of each edge.
            frames: map slot of the target frame of each edge.

        Returns:
            ``c = p^2 * (2r+1)^2`` channels, ordered ``pixels_first``: patch row, patch column, y offset, x offset.
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
            torch.lerp(rows[..., :-1], rows[..., 1:], fx[part], out=out[part])
        return out.view(e, -1)

    def _refresh(self, at: Tensor, slots: Tensor, features: Tensor, kk: Tensor, frames: Tensor) -> None:
        """Compute the products again for edges that have moved out of their cached window."""
        s, r = self.side, self.radius
        _, height, width, _ = self._maps.shape
        # A window beyond the border contains only zeros, at any position.
        limit = torch.tensor([width - 2 * s, height - 2 * s], device=at.device)
        at = at.clamp(-1e5, 1e5)  # far-away projections would overflow the integers
        centre, low, high = (x.floor().long() for x in (at[:, self.pixels // 2], at.amin(1), at.amax(1)))
        wanted = (centre - (s // 2 - 1)).clamp(min=-s).minimum(limit)
        origin = self._origin[slots]
        # A patch whose projection is larger than a window stays clamped; its centre alone decides on a refresh then.
        outside = ((low - r < origin) | (high + r + 1 >= origin + s)).any(-1)
        stale = (outside & (origin != wanted).any(-1)).nonzero()[:, 0]
        if len(stale):
            self._fill(wanted[stale], slots[stale], features, kk[stale], frames[stale])

    def _fill(self, origins: Tensor, slots: Tensor, features: Tensor, kk: Tensor, frames: Tensor) -> None:
        """Compute the windows of edges at positions ``(n, 2)``."""
        s = self.side
        _, height, width, c = self._maps.shape
        runs = self._maps.as_strided((self._maps.numel() // c - s + 1, s * c), (c, 1))
        x, y = (origins + s).unbind(-1)
        first = (frames * height + y) * width + x
        steps = torch.arange(s, device=origins.device) * width
        for edges in torch.arange(len(slots), device=origins.device).split(PIECE // 4):
            window = runs.index_select(0, (first[edges, None] + steps).flatten()).view(len(edges), s * s, c)
            products = torch.bmm(features[kk[edges]].mT, window.mT)
            self._products[slots[edges]] = products.view(len(edges), self.pixels, s, s)
        self._origin[slots] = origins
