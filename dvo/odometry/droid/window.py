"""Window of keyframes of the dense odometry: features, poses, inverse depth maps, and the frame graph between them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.layer.dense import pixel_grid
from dvo.ba.options import BADamping
from dvo.models.dense_step import DAMPING, DenseOptions, DenseState, HeldEdges, VolumeLookup, dense_step, frame_graph
from dvo.models.droid import DroidVO
from dvo.nets.correlation.frame_correlation import PairVolume
from dvo.odometry.droid.edges import Edge, flow_distances

CONFIDENT = 0.1
"""Confidence of a measurement above which it can be an inlier."""
AGREEMENT = 0.5
"""Largest distance of an inlier from the reprojection after bundle adjustment, feature pixels."""


@dataclass(eq=False)
class Keyframe:
    """Frame with an inverse depth map.

    Attributes:
        number: identifier in the log.
        timestamp: seconds.
        pose_cw: ``(7,)`` world to camera.
        inverse_depth: ``(h, w)``.
        intrinsics: ``(4,)`` of the feature map.
        matching: ``(C, h, w)`` features for correlation.
        hidden, gates: ``(D, h, w)`` and ``(3D, h, w)`` context.
        colors: ``(h, w, 3)`` uint8 RGB at the centres of the feature pixels.
        confidence: ``(h, w)`` mean over the edges that begin here, in [0, 1].
    """

    number: int
    timestamp: float
    pose_cw: Tensor
    inverse_depth: Tensor
    intrinsics: Tensor
    matching: Tensor
    hidden: Tensor
    gates: Tensor
    colors: np.ndarray
    confidence: Tensor


@dataclass(eq=False)
class FrameEdge:
    """Measurement of the pixels of one keyframe in another one.

    Attributes:
        source, target: the keyframes.
        hidden: ``(D, h, w)`` state of the update operator.
        volume: correlation of the two.
        positions, confidence: ``(h, w, 2)``; None before the first update.
        age: number of updates.
    """

    source: Keyframe
    target: Keyframe
    hidden: Tensor | None
    volume: PairVolume | None
    positions: Tensor | None = None
    confidence: Tensor | None = None
    age: int = 0


@dataclass(frozen=True)
class Agreement:
    """Agreement of measurements with the poses and depths.

    Attributes:
        confidence: mean of the pixels in view, in [0, 1].
        inliers: share of the pixels in view that are confident and where bundle adjustment reprojects them.
        flow: mean length of the flow of the first edge, feature pixels; infinite if it shows too little.
    """

    confidence: float
    inliers: float
    flow: float


def agreement(state: DenseState) -> Agreement:
    """Agreement of the measurements of a state, after a step.

    Args:
        state: of a batch of one; without ``coords``, those after bundle adjustment are computed.

    Returns:
        The agreement.
    """
    assert state.targets is not None and state.confidence is not None
    there = state.projections()
    coords = there.coords if state.coords is None else state.coords
    h, w = coords.shape[2:4]
    x, y = coords.unbind(-1)
    seen = there.valid & (x > -0.5) & (x < w - 0.5) & (y > -0.5) & (y < h - 0.5)
    count = float(seen.sum().clamp(min=1))
    confidence = state.confidence.mean(-1)
    found = seen & (confidence > CONFIDENT) & ((state.targets - coords).norm(dim=-1) < AGREEMENT)
    first = seen[0, 0]
    flow = coords[0, 0] - pixel_grid(h, w, coords.device).permute(1, 2, 0)
    length = float(flow.norm(dim=-1)[first].mean()) if float(first.float().mean()) > 0.4 else float("inf")
    share = float((confidence * seen).sum()) / count
    return Agreement(share, float(found.sum()) / count if count > 0.1 * seen.numel() else 0.0, length)


class DenseWindow:
    """Keyframes of a sliding window and the edges between them.

    The newest keyframe is the last one. Memory is bounded: ``max_edges`` edges have a correlation volume and a state,
    ``max_held`` further ones a measurement alone.

    Args:
        model: the network.
        max_edges: edges that the network revises.
        max_held: held edges.
        max_age: updates after which an edge is held.

    Attributes:
        keyframes: in order of time.
        edges: that the network revises.
        held: whose measurement stays as it is.
    """

    def __init__(self, model: DroidVO, *, max_edges: int, max_held: int, max_age: int) -> None:
        self.model, self.max_edges, self.max_held, self.max_age = model, max_edges, max_held, max_age
        self.keyframes: list[Keyframe] = []
        self.edges: list[FrameEdge] = []
        self.held: list[FrameEdge] = []

    def __len__(self) -> int:
        return len(self.keyframes)

    def clear(self) -> None:
        """Remove everything."""
        self.keyframes, self.edges, self.held = [], [], []

    def pairs(self) -> list[Edge]:
        """Positions of the frames of all edges, held ones included."""
        place = {id(keyframe): position for position, keyframe in enumerate(self.keyframes)}
        return [(place[id(e.source)], place[id(e.target)]) for e in (*self.edges, *self.held)]

    def join(self, pairs: Iterable[Edge]) -> None:
        """Add edges, except those that are there; beyond ``max_edges`` the oldest ones are held.

        Args:
            pairs: positions of source and target.
        """
        there = set(self.pairs())
        new = [pair for pair in dict.fromkeys(pairs) if pair not in there][: self.max_edges]
        surplus = len(self.edges) + len(new) - self.max_edges
        if surplus > 0:
            oldest = sorted(range(len(self.edges)), key=lambda k: -self.edges[k].age)[:surplus]
            self._hold(set(oldest))
        config = self.model.config
        for i, j in new:
            source, target = self.keyframes[i], self.keyframes[j]
            volume = PairVolume(source.matching, target.matching, config.pyramid, config.radius)
            self.edges.append(FrameEdge(source, target, source.hidden, volume))

    def _hold(self, positions: set[int]) -> None:
        """Keep the measurement of edges and drop what the network needs."""
        gone = [self.edges[k] for k in sorted(positions)]
        self.edges = [edge for k, edge in enumerate(self.edges) if k not in positions]
        kept = [replace(edge, hidden=None, volume=None) for edge in gone if edge.positions is not None]
        self.held = [*self.held, *kept][-self.max_held :] if self.max_held else []

    def remove(self, position: int) -> Keyframe:
        """Remove a keyframe with its edges.

        Args:
            position: of the keyframe.

        Returns:
            The keyframe.
        """
        gone = self.keyframes.pop(position)
        self.edges = [e for e in self.edges if gone is not e.source and gone is not e.target]
        self.held = [e for e in self.held if gone is not e.source and gone is not e.target]
        return gone

    def distances(self, translation_share: float, pairs: list[Edge] | None = None) -> np.ndarray:
        """Distances of the keyframes, see :func:`dvo.odometry.droid.edges.flow_distances`.

        Args:
            translation_share: weight of the flow without the rotation.
            pairs: of positions; None for all.

        Returns:
            Feature pixels.
        """
        poses, depths, intrinsics = self._geometry()
        return flow_distances(poses, depths, intrinsics, translation_share, pairs)

    def _geometry(self) -> tuple[Tensor, Tensor, Tensor]:
        frames = self.keyframes
        return (
            torch.stack([frame.pose_cw for frame in frames]),
            torch.stack([frame.inverse_depth for frame in frames]),
            torch.stack([frame.intrinsics for frame in frames]),
        )

    def update(self, fixed: int, damping: BADamping = DAMPING, kernel: Kernel = Kernel()) -> Agreement:  # noqa: B008
        """Revise all edges once and adjust poses and depths to them and to the held ones.

        Args:
            fixed: number of leading keyframes whose poses stay.
            damping: of bundle adjustment.
            kernel: robust kernel of the residuals, see :class:`dvo.models.dense_step.DenseOptions`.

        Returns:
            Agreement of all edges.
        """
        ends = torch.tensor(self.pairs()).view(-1, 2)
        active = len(self.edges)
        (ii, jj), (held_ii, held_jj) = ends[:active].unbind(1), ends[active:].unbind(1)
        poses, depths, intrinsics = self._geometry()
        graph = frame_graph(ii.to(poses.device), jj.to(poses.device), len(self), *depths.shape[-2:])
        gates = torch.stack([frame.gates for frame in self.keyframes])[None]
        hidden = torch.stack([edge.hidden for edge in self.edges if edge.hidden is not None])[None]
        state = DenseState(graph, poses[None], depths[None], intrinsics[None], gates, hidden).reprojected()
        assert state.coords is not None
        targets = [
            at if e.positions is None else e.positions for e, at in zip(self.edges, state.coords[0], strict=True)
        ]
        held = None
        if self.held:
            positions = torch.stack([e.positions for e in self.held if e.positions is not None])[None]
            confidence = torch.stack([e.confidence for e in self.held if e.confidence is not None])[None]
            held = HeldEdges(held_ii.to(poses.device), held_jj.to(poses.device), positions, confidence)
        state = replace(state, targets=torch.stack(targets)[None])
        lookup = VolumeLookup([edge.volume for edge in self.edges if edge.volume is not None])
        state = dense_step(
            self.model, state, lookup, DenseOptions(fixed=fixed, damping=damping, held=held, kernel=kernel)
        )
        self._take(state)
        return agreement(state)

    def _take(self, state: DenseState) -> None:
        """Take over the result of a step."""
        assert state.targets is not None and state.confidence is not None
        for k, frame in enumerate(self.keyframes):
            frame.pose_cw, frame.inverse_depth = state.poses_cw[0, k], state.inverse_depth[0, k]
            from_here = state.graph.ii == k
            if bool(from_here.any()):
                frame.confidence = state.confidence[0, from_here].mean((0, -1))
        for k, edge in enumerate(self.edges):
            edge.hidden, edge.age = state.hidden[0, k], edge.age + 1
            edge.positions, edge.confidence = state.targets[0, k], state.confidence[0, k]
        self._hold({k for k, edge in enumerate(self.edges) if edge.age > self.max_age})
