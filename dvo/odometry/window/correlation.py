"""Correlation of the edges of a sliding window."""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.map.edges import PatchGraph
from dvo.map.window import Window
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.correlation.edge_correlation import EdgeCorrelation
from dvo.nets.patch.config import ModelConfig
from dvo.nets.patch.patchifier import pool_levels

# Sides allow several pixels of motion before the products of a window must be computed again.
_SIDE_FINE, _SIDE_COARSE = 14, 12


class WindowCorrelation:
    """:class:`dvo.nets.correlation.correlation.CorrelationLookup` over a window, with a cache for each level of the
    pyramid.

    Args:
        window: provides the edges and patch features.
        config: of the network.
        device: of the caches.
    """

    def __init__(self, window: Window, config: ModelConfig, device: torch.device) -> None:
        self.window, self.pyramid = window, config.pyramid
        self.levels = [
            EdgeCorrelation(
                scale, config.patch_size**2, config.radius, _SIDE_FINE if scale == 1 else _SIDE_COARSE, device
            )
            for scale in config.pyramid
        ]

    @property
    def capacity(self) -> int:
        """Number of edge slots that memory is reserved for."""
        return max(len(level) for level in self.levels)

    def keep_maps(self, map_slot: int, maps: Tensor) -> None:
        """Store the feature maps of a frame.

        Args:
            map_slot: slot of the frame; its content is overwritten.
            maps: ``(1, 1, C, h, w)`` matching features.
        """
        for level, pooled in zip(self.levels, pool_levels(maps, self.pyramid), strict=True):
            level.keep_map(map_slot, pooled[0, 0])

    def forget(self, edge_slots: Tensor) -> None:
        """Invalidate the slots of new edges.

        Args:
            edge_slots: ``(e,)``.
        """
        for level in self.levels:
            level.forget(edge_slots)

    def origins(self) -> Tensor:
        """Positions of the cached windows of the edges, for :meth:`restore`.

        Returns:
            ``(L, E, 2)`` for each level.
        """
        return torch.stack([level.origins(self.window.edge_slots) for level in self.levels])

    def restore(self, origins: Tensor) -> None:
        """Compute the cached windows of all edges at given positions; the maps of the frames are stored already.

        An interpolated value depends in its last bit on the position of its window, so that positions are kept; the
        products are the same whenever they are computed.

        Args:
            origins: of :meth:`origins`.
        """
        window = self.window
        maps = window.map_slots[window.jj]
        for level, part in zip(self.levels, origins, strict=True):
            level.restore(part, window.edge_slots, window.matching.flatten(2), window.kk, maps)

    def __call__(self, coords: Tensor, graph: PatchGraph) -> Correlation:
        """Look up the edges of the window, see :class:`dvo.nets.correlation.correlation.CorrelationLookup`.

        Args:
            coords: ``(1, E, p, p, 2)`` reprojected patch pixels in feature pixels.
            graph: the edges of the window.

        Returns:
            Channels in the order ``pixels_first``.
        """
        window = self.window
        matching = window.matching.flatten(2)
        maps = window.map_slots[graph.jj]
        found = [level.lookup(coords[0], window.edge_slots, matching, graph.kk, maps)[None] for level in self.levels]
        return Correlation(found, "pixels_first")
