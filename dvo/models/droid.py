"""Dense recurrent visual odometry as one network (DROID-SLAM: Teed and Deng, NeurIPS 2021), without its back end.

Two encoders give features of the frames, and steps (:mod:`dvo.models.dense_step`) refine poses and inverse depth maps:
each reprojects every pixel, correlates it there, revises flow and confidence, and solves a dense bundle adjustment.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dvo.ba.options import COLD_UPDATES, BADamping
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.models.dense_step import DAMPING, DenseMode, DenseOptions, DenseState, FrameGraph, dense_step, frame_graph
from dvo.nets.correlation.correlation import CorrelationVolume
from dvo.nets.droid.dense_update import DenseUpdate
from dvo.nets.droid.droid import PRESETS, STRIDE, DroidConfig, DroidEncoder, standardise_images

__all__ = ["DroidFeatures", "DroidVO", "neighbour_edges"]


@dataclass(frozen=True)
class DroidFeatures:
    """Output of the encoders for a batch of clips.

    Attributes:
        matching: ``(B, N, C, h, w)`` features for correlation, divided by 4.
        hidden: ``(B, N, D, h, w)`` initial state of the edges that begin in a frame.
        gates: ``(B, N, 3D, h, w)`` share of the context in the gates of the update operator.
    """

    matching: Tensor
    hidden: Tensor
    gates: Tensor


def neighbour_edges(frames: int, reach: int) -> tuple[Tensor, Tensor]:
    """Edges between all frames at most ``reach`` apart, in both directions.

    Args:
        frames: number of frames.
        reach: largest distance.

    Returns:
        Source and target frames ``(E,)``.
    """
    i, j = torch.meshgrid(torch.arange(frames), torch.arange(frames), indexing="ij")
    near = ((i - j).abs() <= reach) & (i != j)
    return i[near], j[near]


def damping_of(update: int) -> BADamping:
    """Damping of the given update of a new graph, see :func:`dvo.ba.options.damping_at`.

    Args:
        update: number, from 0.

    Returns:
        That of DROID-SLAM; strong relative damping in the first updates.
    """
    return replace(DAMPING, relative=0.1) if update < COLD_UPDATES else DAMPING


class DroidVO(nn.Module):
    """Encoders and update operator. The state dict of the ``full`` configuration has DROID-SLAM's names and shapes.

    Args:
        config: sizes, see :class:`dvo.nets.droid.droid.DroidConfig`.

    Example:
        >>> model = DroidVO(preset("tiny"))
        >>> images = torch.zeros(1, 4, 3, 96, 128, dtype=torch.uint8)
        >>> intrinsics = torch.tensor([80.0, 80.0, 64.0, 48.0]).expand(1, 4, 4)
        >>> state = model(images, intrinsics, updates=2)
        >>> state.inverse_depth.shape
        torch.Size([1, 4, 12, 16])
    """

    architecture = "droid"
    config_type = DroidConfig
    presets = PRESETS
    STRIDE = STRIDE

    def __init__(self, config: DroidConfig) -> None:
        super().__init__()
        self.config = config
        self.fnet = DroidEncoder(config.stem_channels, config.feature_channels, "instance")
        self.cnet = DroidEncoder(config.stem_channels, 2 * config.hidden_channels, "none")
        self.update = DenseUpdate(config)

    def match_features(self, images: Float[Tensor, "B N 3 H W"]) -> Float[Tensor, "B N C h w"]:
        """Matching features of images, divided by 4.

        Args:
            images: RGB, uint8 or float in the same range.

        Returns:
            Features at an eighth of the resolution, in full precision.

        Raises:
            DvoError: images too small for the correlation pyramid.
        """
        height, width = images.shape[-2:]
        least = self.config.smallest_side
        if min(height, width) < least:
            raise DvoError(
                f"{width}x{height} pixels are too few for the network", field="images",
                remedy=f"give images of at least {least}x{least} pixels",
            )  # fmt: skip
        found = self.fnet(standardise_images(images.flatten(0, 1)))
        return found.float().unflatten(0, images.shape[:2]) / 4.0

    def context(self, images: Float[Tensor, "B N 3 H W"]) -> tuple[Tensor, Tensor]:
        """Context of images.

        Args:
            images: RGB, uint8 or float in the same range.

        Returns:
            ``hidden`` and ``gates`` of :class:`DroidFeatures`.
        """
        found = self.cnet(standardise_images(images.flatten(0, 1)))
        hidden, context = found.split(self.config.hidden_channels, 1)
        gates = self.update.gru.context_gates(torch.relu(context))
        return torch.tanh(hidden).unflatten(0, images.shape[:2]), gates.unflatten(0, images.shape[:2])

    def encode(self, images: Float[Tensor, "B N 3 H W"]) -> DroidFeatures:
        """Encode images.

        Args:
            images: RGB, uint8 or float in the same range.

        Returns:
            Matching and context features.

        Raises:
            DvoError: images too small for the correlation pyramid.
        """
        return DroidFeatures(self.match_features(images), *self.context(images))

    def forward(
        self,
        images: Float[Tensor, "B N 3 H W"],
        intrinsics: Float[Tensor, "B N 4"],
        *,
        updates: int = 8,
        reach: int = 3,
    ) -> DenseState:
        """Run a fixed number of updates on a clip, from poses and depths of which nothing is known.

        Args:
            images: uint8 RGB (or float in the same range).
            intrinsics: ``fx fy cx cy`` in image pixels.
            updates: number of steps.
            reach: edges join frames at most so far apart.

        Returns:
            State after the last update: poses ``T_cw`` relative to the first frame and inverse depths, up to scale.
        """
        b, n = images.shape[:2]
        start = se3.identity(b, n, device=images.device)
        edges = neighbour_edges(n, reach)
        return deque(self.unroll(images, intrinsics, *edges, updates=updates, poses_cw=start), maxlen=1)[0]

    def unroll(
        self,
        images: Float[Tensor, "B N 3 H W"],
        intrinsics: Float[Tensor, "B N 4"],
        ii: Tensor,
        jj: Tensor,
        *,
        updates: int,
        poses_cw: Float[Tensor, "B N 7"],
        fixed: int = 1,
        mode: DenseMode = "joint",
        iterations: int = 2,
        features: DroidFeatures | None = None,
    ) -> Iterator[DenseState]:
        """Run updates on a clip; the training pass.

        Args:
            images: uint8 RGB (or float in the same range).
            intrinsics: ``fx fy cx cy`` in image pixels.
            ii, jj: ``(E,)`` source and target frame of each edge.
            updates: number of steps.
            poses_cw: initial poses ``T_cw``; inverse depths begin at 1.
            fixed: number of leading poses that stay.
            mode: see :data:`dvo.models.dense_step.DenseMode`.
            iterations: Gauss-Newton iterations an update.
            features: of :meth:`encode` of the images, where they are known.

        Yields:
            The state after each update, with ``coords``. Poses and depths are detached between updates: only the
            hidden state carries gradients across.
        """
        features = self.encode(images) if features is None else features
        b, n, _, h, w = features.matching.shape
        ii, jj = ii.to(images.device), jj.to(images.device)
        graph = frame_graph(ii, jj, n, h, w)
        volume = CorrelationVolume(features.matching, features.matching, self.config.pyramid, self.config.radius)

        def lookup(coords: Tensor, graph: FrameGraph) -> Tensor:
            levels = volume.lookup(coords, graph.ii, graph.jj)
            return torch.cat([level.view(b, len(graph), -1, h, w) for level in levels], 2)

        depth = torch.ones(b, n, h, w, device=images.device)
        hidden = features.hidden.index_select(1, ii)
        state = DenseState(graph, poses_cw, depth, intrinsics / STRIDE, features.gates, hidden)
        for update in range(updates):
            state = replace(state, poses_cw=state.poses_cw.detach(), inverse_depth=state.inverse_depth.detach())
            options = DenseOptions(mode, fixed, iterations, damping_of(update))
            state = dense_step(self, state, lookup, options)
            if state.coords is None:
                state = state.reprojected()
            yield state
