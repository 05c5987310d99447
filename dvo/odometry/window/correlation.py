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


class WindowCorrelation:
    """:class:`dvo.nets.correlation.correlation.CorrelationLookup` over a window.

    Args:
        window: provides the edges and patch features.
        config: of the network.
        device: of the maps.
    """

    def __init__(self, window: Window, config: ModelConfig, device: torch.device) -> None:
        self.window, self.pyramid = window, config.pyramid
        self.levels = [EdgeCorrelation(scale, config.radius, device) for scale in config.pyramid]

    @property
    def capacity(self) -> int:
        """Number of frames that memory is reserved for."""
        return max(len(level.maps) for level in self.levels)

    def keep_maps(self, map_slot: int, maps: Tensor) -> None:
        """Store the feature maps of a frame.

        Args:
            map_slot: slot of the frame; its content is overwritten.
            maps: ``(1, 1, C, h, w)`` matching features.
        """
        for level, pooled in zip(self.levels, pool_levels(maps, self.pyramid), strict=True):
            level.keep_map(map_slot, pooled[0, 0])

    def __call__(self, coords: Tensor, graph: PatchGraph) -> Correlation:
        """Look up the edges of the window, see :class:`dvo.nets.correlation.correlation.CorrelationLookup`.

        Args:
            coords: ``(1, E, p, p, 2)`` reprojected patch pixels in feature pixels.
            graph: the edges of the window.

        Returns:
            Channels in the order ``pixels_first``.
        """
        window = self.window
        features = window.matching.flatten(2).mT.contiguous()
        maps = window.map_slots[graph.jj]
        found = [level.lookup(coords[0], features, graph.kk, maps)[None] for level in self.levels]
        return Correlation(found, "pixels_first")
