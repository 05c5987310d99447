"""One step of dense odometry: reproject, correlate, update, bundle-adjust (Teed and Deng, "DROID-SLAM", 2021).

:func:`dense_step` is pure. Training and tracking call it with edges, starting poses, hidden state and correlation
look-up of their own; it is for whole frames what :func:`dvo.models.step.step` is for patches.

Poses are ``T_cw`` (world to camera); coordinates are feature pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from dvo.ba.edges import EdgePlan
from dvo.ba.kernels import Kernel
from dvo.ba.layer.dense import dense_bundle_adjust, dense_patches, dense_plan, pixel_grid
from dvo.ba.options import BADamping, BAOptions
from dvo.geometry.projection import Reprojection, reproject
from dvo.nets.correlation.frame_correlation import PairVolume
from dvo.nets.droid.dense_update import DenseUpdate

WEIGHT = 1e-3
"""Weight of a measurement of full confidence, pixels^-2 (DROID-SLAM): there are a thousand pixels in a map."""
DAMPING = BADamping(pose=0.1, relative=1e-4, depth=1e-7)
"""Damping of a step: the constants of DROID-SLAM, to which the network adds one for each inverse depth."""

DenseMode = Literal["joint", "motion", "flow"]
"""``joint``: poses and depths. ``motion``: poses; depths stay. ``flow``: no bundle adjustment, each pixel moves by its
own revision; trains the flow revision alone."""


@dataclass(frozen=True)
class FrameGraph:
    """Edges between frames.

    Attributes:
        ii, jj: ``(E,)`` source and target frame.
        plan: layout of their pixels for bundle adjustment.
    """

    ii: Tensor
    jj: Tensor
    plan: EdgePlan

    def __len__(self) -> int:
        return len(self.ii)


def frame_graph(ii: Tensor, jj: Tensor, frames: int, height: int, width: int) -> FrameGraph:
    """Build a graph.

    Args:
        ii, jj: ``(E,)`` source and target frame of each edge.
        frames: number of frames.
        height, width: of the feature maps.

    Returns:
        The graph.
    """
    return FrameGraph(ii, jj, dense_plan(ii, jj, frames, height * width))


class DenseLookup(Protocol):
    """Interface of a correlation look-up; the part of a step that differs between training and tracking."""

    def __call__(self, coords: Float[Tensor, "B E h w 2"], graph: FrameGraph) -> Float[Tensor, "B E c h w"]:
        """Look up the correlation.

        Args:
            coords: positions of the pixels of the source frames in the target frames, feature pixels.
            graph: the ``E`` edges.

        Returns:
            Channels: level slowest, then x offset, then y offset.
        """
        ...


class VolumeLookup:
    """Correlation of edges that have a volume of their own; a :class:`DenseLookup` for tracking.

    Args:
        volumes: of the edges of the graph, in its order.
    """

    def __init__(self, volumes: Sequence[PairVolume]) -> None:
        self.volumes = volumes

    def __call__(self, coords: Tensor, graph: FrameGraph) -> Tensor:
        """Look up the correlation of a batch of one.

        Args:
            coords: ``(1, E, h, w, 2)``.
            graph: the ``E`` edges.

        Returns:
            ``(1, E, c, h, w)``.
        """
        return torch.stack([volume(at) for volume, at in zip(self.volumes, coords[0], strict=True)])[None]


@dataclass(frozen=True)
class DenseState:
    """State between two steps.

    Attributes:
        graph: ``E`` edges.
        poses_cw: ``(B, N, 7)``.
        inverse_depth: ``(B, N, h, w)``.
        intrinsics: ``(B, N, 4)`` fx fy cx cy of the feature map.
        gates: ``(B, N, 3D, h, w)`` share of the context in the gates of the update operator.
        hidden: ``(B, E, D, h, w)`` state of the update operator.
        coords: ``(B, E, h, w, 2)`` positions of the pixels in the target frames; None if they have to be computed.
        targets: ``(B, E, h, w, 2)`` revised positions; None before the first step.
        confidence: ``(B, E, h, w, 2)`` in (0, 1); None before the first step.
        damping: ``(B, N, h, w)`` predicted for the inverse depths; None before the first step, and in mode ``flow``.
        mask: ``(B, N, 576, h, w)`` for :func:`dvo.nets.droid.dense_update.upsample_map`; None for a network without
            one.
    """

    graph: FrameGraph
    poses_cw: Tensor
    inverse_depth: Tensor
    intrinsics: Tensor
    gates: Tensor
    hidden: Tensor
    coords: Tensor | None = None
    targets: Tensor | None = None
    confidence: Tensor | None = None
    damping: Tensor | None = None
    mask: Tensor | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.poses_cw.shape[1]

    def projections(self) -> Reprojection:
        """Reproject all pixels of all edges.

        Returns:
            Positions ``(B, E, h, w, 2)`` and which of them are in front of the target frame.
        """
        patches = dense_patches(self.inverse_depth)
        return reproject(self.poses_cw, patches, self.intrinsics, self.graph.ii, self.graph.jj, self.graph.ii)

    def reprojected(self) -> DenseState:
        """Reproject all pixels of all edges.

        Returns:
            The state with ``coords`` set.
        """
        return replace(self, coords=self.projections().coords)


@dataclass(frozen=True)
class HeldEdges:
    """Measurements of edges that the network no longer revises.

    Attributes:
        ii, jj: ``(H,)`` source and target frame.
        targets, confidence: ``(B, H, h, w, 2)``.
    """

    ii: Tensor
    jj: Tensor
    targets: Tensor
    confidence: Tensor


@dataclass(frozen=True)
class DenseOptions:
    """Options of a step.

    Attributes:
        mode: see :data:`DenseMode`.
        fixed: number of leading poses that bundle adjustment holds, or which.
        iterations: Gauss-Newton iterations.
        damping: of bundle adjustment, besides that of the network.
        held: further measurements.
        kernel: robust kernel of the residuals; its width is in feature pixels, for a measurement of full confidence.
        check: indices and weights, see :class:`dvo.ba.options.BAOptions`.
    """

    mode: DenseMode = "joint"
    fixed: int | Tensor | Sequence[bool] = 1
    iterations: int = 2
    damping: BADamping = DAMPING
    held: HeldEdges | None = None
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)
    check: bool | None = False


class DenseModel(Protocol):
    """Interface of a model that a step can be taken with."""

    @property
    def update(self) -> DenseUpdate:
        """The update operator."""
        ...


def dense_step(
    model: DenseModel, state: DenseState, lookup: DenseLookup, options: DenseOptions = DenseOptions()  # noqa: B008
) -> DenseState:  # fmt: skip
    """Revise the flow of all edges, then fit poses and inverse depths to it by bundle adjustment.

    Args:
        model: provides the update operator, for instance a :class:`dvo.models.droid.DroidVO`.
        state: edges, poses and depths to start from. Detach them to cut gradients between steps.
        lookup: correlation of the frames of each edge.
        options: mode, fixed poses, damping, held edges.

    Returns:
        The state with new poses, depths, hidden state, targets, confidence and damping. ``coords`` is None, except in
        mode ``flow``.

    Raises:
        DvoError: invalid indices or weights, if ``options.check`` is set.
    """
    if state.coords is None:
        state = state.reprojected()
    graph = state.graph
    assert state.coords is not None
    # Positions and targets receive no gradient from later steps, as in RAFT and DROID-SLAM.
    coords = state.coords.detach()
    targets = coords if state.targets is None else state.targets.detach()
    height, width = coords.shape[2:4]
    grid = pixel_grid(height, width, coords.device).permute(1, 2, 0)
    motion = torch.cat((coords - grid, targets - coords), -1).permute(0, 1, 4, 2, 3)
    gates = state.gates.index_select(1, graph.ii)
    revision = model.update(state.hidden, gates, lookup(coords, graph), motion)
    targets = coords + revision.delta
    state = replace(state, hidden=revision.hidden, targets=targets, confidence=revision.confidence, coords=None)
    if options.mode == "flow":
        return replace(state, coords=targets)
    damping, mask = None, None
    if options.mode == "joint":
        damping, mask = model.update.agg(revision.hidden, graph.ii, state.frames)
    poses_cw, inverse_depth = _adjust(state, damping, options)
    return replace(state, poses_cw=poses_cw, inverse_depth=inverse_depth, damping=damping, mask=mask)


def _adjust(state: DenseState, damping: Tensor | None, options: DenseOptions) -> tuple[Tensor, Tensor]:
    assert state.targets is not None and state.confidence is not None
    graph, targets, confidence, held = state.graph, state.targets, state.confidence, options.held
    ii, jj, plan = graph.ii, graph.jj, graph.plan
    h, w = state.inverse_depth.shape[-2:]
    if held is not None and len(held.ii):
        ii, jj = torch.cat((held.ii, ii)), torch.cat((held.jj, jj))
        targets = torch.cat((held.targets, targets), 1)
        confidence = torch.cat((held.confidence, confidence), 1)
        plan = dense_plan(ii, jj, state.frames, h * w)
    motion_only = options.mode == "motion"
    kernel = replace(options.kernel, width=options.kernel.width * math.sqrt(WEIGHT))
    settings = BAOptions(
        fixed=options.fixed, iterations=options.iterations, damping=options.damping, motion_only=motion_only,
        bounds=(float(w), float(h)), kernel=kernel, check=options.check,
    )  # fmt: skip
    return dense_bundle_adjust(
        state.poses_cw, state.inverse_depth, state.intrinsics, targets, WEIGHT * confidence, ii, jj, settings,
        damping=damping, plan=plan,
    )  # fmt: skip
