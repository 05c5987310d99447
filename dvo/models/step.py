"""One step of patch-flow visual odometry: reproject, correlate, update, bundle-adjust (DPVO 3.2, 3.3).

Training unrolls this step on a clip (:meth:`dvo.models.patch_vo.PatchVO.unroll`), the tracker takes it once or more a
frame (:class:`dvo.odometry.tracker.PatchOdometry`). A step maps a state to a state. Everything in which the two loops
differ is an argument: the edges and the poses and depths to start from (in the state), the implementation of the
correlation (the lookup), which poses are fixed and how strongly bundle adjustment is damped (the options).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

from torch import Tensor

from dvo.ba.layer import bundle_adjust
from dvo.ba.options import BADamping, BAOptions
from dvo.ba.problem import Factor
from dvo.geometry.projection import reproject
from dvo.graph.edges import PatchGraph
from dvo.nets.correlation import CorrelationLookup
from dvo.nets.update import UpdateOperator

Mode = Literal["joint", "structure", "flow"]
"""``joint`` refines poses and depths, ``structure`` depths alone; ``flow`` leaves bundle adjustment out."""


@dataclass(frozen=True)
class UpdateState:
    """Poses, patches and edges before or after a step; poses are world to camera, lengths in feature pixels.

    Attributes:
        graph: the edges.
        poses_cw: ``(B, N, 7)``.
        patches: ``(B, K, 3, p, p)`` x, y, inverse depth.
        intrinsics: ``(B, N, 4)`` fx fy cx cy of the feature maps.
        context: ``(B, K, D)`` context features of the patches.
        hidden: ``(B, E, D)`` state of the update operator, zero for a new edge.
        coords: ``(B, E, p, p, 2)`` reprojection of the patches under these poses and depths; None if not computed yet.
        targets: ``(B, E, 2)`` positions of the patch centres that the network asked for in the step that led here; None
            before the first step.
        weights: ``(B, E, 2)`` confidence of the targets; None before the first step.
    """

    graph: PatchGraph
    poses_cw: Tensor
    patches: Tensor
    intrinsics: Tensor
    context: Tensor
    hidden: Tensor
    coords: Tensor | None = None
    targets: Tensor | None = None
    weights: Tensor | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.poses_cw.shape[1]

    def reprojected(self) -> UpdateState:
        """The state with ``coords`` computed."""
        graph = self.graph
        found = reproject(self.poses_cw, self.patches, self.intrinsics, graph.ii, graph.jj, graph.kk)
        return replace(self, coords=found.coords)


@dataclass(frozen=True)
class StepOptions:
    """Options of a step.

    Attributes:
        mode: see :data:`Mode`.
        fixed: number of leading poses that bundle adjustment holds.
        iterations: Gauss-Newton iterations.
        damping: of bundle adjustment.
        bounds: ``(width, height)`` of the feature map, see :func:`dvo.ba.layer.bundle_adjust`.
        check: indices and weights, see :class:`dvo.ba.options.BAOptions`.
        factors: further measurements for bundle adjustment, for example of depth or of an inertial sensor.
    """

    mode: Mode = "joint"
    fixed: int = 1
    iterations: int = 2
    damping: BADamping = BADamping()
    bounds: tuple[float, float] | None = None
    check: bool | None = False
    factors: tuple[Factor, ...] = ()


@dataclass(frozen=True)
class Revision:
    """Output of the network for every edge, before bundle adjustment.

    Attributes:
        coords: ``(B, E, p, p, 2)`` reprojected patch pixels that the correlation was taken at.
        hidden: ``(B, E, D)`` new state of the update operator.
        delta: ``(B, E, 2)`` revision of the flow, feature pixels.
        weights: ``(B, E, 2)`` confidence in (0, 1).
    """

    coords: Tensor
    hidden: Tensor
    delta: Tensor
    weights: Tensor

    @property
    def targets(self) -> Tensor:
        """``(B, E, 2)`` revised positions of the patch centres."""
        centre = self.coords.shape[2] // 2
        return self.coords[:, :, centre, centre] + self.delta


class StepModel(Protocol):
    """The part of a model that a step needs."""

    @property
    def update(self) -> UpdateOperator:
        """The update operator."""
        ...


def revise(model: StepModel, state: UpdateState, lookup: CorrelationLookup) -> Revision:
    """Run the update operator on all edges; poses and depths do not change.

    Args:
        model: has the update operator.
        state: its ``coords`` are used if they are there.
        lookup: correlation of patches and feature maps.
    """
    if state.coords is None:
        state = state.reprojected()
    graph, coords = state.graph, state.coords
    assert coords is not None
    # Positions receive no gradient: the network learns from the targets, not from where it looked (RAFT, DPVO).
    coords = coords.detach()
    correlation = lookup(coords, graph)
    context = state.context.index_select(1, graph.kk)
    hidden, delta, weights = model.update(state.hidden, context, correlation, graph)
    return Revision(coords, hidden, delta, weights)


def step(
    model: StepModel,
    state: UpdateState,
    lookup: CorrelationLookup,
    options: StepOptions = StepOptions(),  # noqa: B008
) -> UpdateState:
    """Revise the flow of all edges, and let bundle adjustment explain it by poses and inverse depths.

    Args:
        model: has the update operator, for instance a :class:`dvo.models.patch_vo.PatchVO`.
        state: edges, poses and patches to start from. Detach poses and patches to cut gradients between steps.
        lookup: correlation of patches and feature maps.
        options: mode, fixed poses, damping.

    Returns:
        The state with new poses, patches, hidden state, targets and weights. ``coords`` is None, but in mode ``flow``,
        in which each edge moves by its own revision alone.
    """
    revision = revise(model, state, lookup)
    targets, graph = revision.targets, state.graph
    state = replace(state, hidden=revision.hidden, targets=targets, weights=revision.weights, coords=None)
    if options.mode == "flow":
        return replace(state, coords=revision.coords + revision.delta[:, :, None, None])
    measured = targets, revision.weights, graph.ii, graph.jj, graph.kk
    solved = bundle_adjust(
        state.poses_cw,
        state.patches,
        state.intrinsics,
        *measured,
        BAOptions(
            fixed=options.fixed,
            iterations=options.iterations,
            damping=options.damping,
            structure_only=options.mode == "structure",
            bounds=options.bounds,
            check=options.check,
        ),
        factors=options.factors,
    )
    return replace(state, poses_cw=solved.poses_cw, patches=solved.patches)


def recent_depth(patches: Tensor, per_frame: int, frames: int) -> Tensor:
    """Median inverse depth of the newest frames, from which the patches of a new frame start (DPVO 3.4).

    Args:
        patches: ``(B, K, 3, p, p)``, newest last.
        per_frame: patches of a frame.
        frames: number of frames to take the median over.

    Returns:
        ``(B,)``.
    """
    return patches[:, -frames * per_frame :, 2, 0, 0].median(dim=1).values
