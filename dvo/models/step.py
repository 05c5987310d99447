"""One step of patch-flow visual odometry: reproject, correlate, update, bundle-adjust (DPVO 3.2, 3.3).

Training unrolls this step on a clip (:meth:`dvo.models.patch_vo.PatchVO.unroll`), the tracker applies it once or more
per frame (:class:`dvo.odometry.patch.tracker.PatchOdometry`). A step maps a state to a state. All differences between
the two loops are arguments: the edges and the poses and depths to start from (in the state), the implementation of the
correlation (the lookup), which poses are fixed and how strongly bundle adjustment is damped (the options).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

from torch import Tensor

from dvo.ba.blocks import StateBlock
from dvo.ba.layer.layer import adjust_dense, dense_solution
from dvo.ba.options import BAOptions
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor
from dvo.geometry.projection import reproject
from dvo.map.edges import PatchGraph
from dvo.nets.correlation.correlation import CorrelationLookup
from dvo.nets.patch.masks import in_sight
from dvo.nets.update.update import UpdateOperator


@dataclass(frozen=True)
class UpdateState:
    """Poses, patches and edges before or after a step; poses are ``T_cw``, image coordinates in feature pixels.

    Attributes:
        graph: the edges.
        poses_cw: ``(B, N, 7)``.
        patches: ``(B, K, 3, p, p)`` x, y, inverse depth.
        intrinsics: ``(B, N, 4)`` fx fy cx cy of the feature maps.
        context: ``(B, K, D)`` context features of the patches.
        hidden: ``(B, E, D)`` state of the update operator, zero for a new edge.
        coords: ``(B, E, p, p, 2)`` reprojection of the patches under these poses and depths; None if not computed yet.
        targets: ``(B, E, 2)`` positions of the patch centres measured by the network in the last step; None before
            the first one.
        confidence: ``(B, E, 2)`` of the network in the targets, in (0, 1), their weights in bundle adjustment; None
            before the first step.
        visible: ``(N, h, w)`` bool, pixels of the feature maps that measurements may lie in; None: all.
        states: ``(B, N, D)`` values of the further unknowns of the last step, by name.
    """

    graph: PatchGraph
    poses_cw: Tensor
    patches: Tensor
    intrinsics: Tensor
    context: Tensor
    hidden: Tensor
    coords: Tensor | None = None
    targets: Tensor | None = None
    confidence: Tensor | None = None
    visible: Tensor | None = None
    states: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.poses_cw.shape[1]

    def reprojected(self) -> UpdateState:
        """Reproject the patches of all edges.

        Returns:
            The state with ``coords`` set.
        """
        graph = self.graph
        found = reproject(self.poses_cw, self.patches, self.intrinsics, graph.ii, graph.jj, graph.kk)
        return replace(self, coords=found.coords)


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
    """Interface of a model that a step can be taken with: it has an update operator."""

    @property
    def update(self) -> UpdateOperator:
        """The update operator."""
        ...


def revise(model: StepModel, state: UpdateState, lookup: CorrelationLookup) -> Revision:
    """Run the update operator on all edges; poses and depths do not change.

    Measurements that lie in ignored pixels (``state.visible``) get the weight 0.

    Args:
        model: provides the update operator.
        state: its ``coords`` are used if they are set, and computed otherwise.
        lookup: correlation of patches and feature maps.

    Returns:
        Flow revision, confidence and new hidden state of every edge.
    """
    if state.coords is None:
        state = state.reprojected()
    graph, coords = state.graph, state.coords
    assert coords is not None
    # Positions receive no gradient, as in RAFT and DPVO: the loss reaches the network through the targets alone.
    coords = coords.detach()
    correlation = lookup(coords, graph)
    context = state.context.index_select(1, graph.kk)
    hidden, delta, weights = model.update(state.hidden, context, correlation, graph)
    revision = Revision(coords, hidden, delta, weights)
    if state.visible is None:
        return revision
    return replace(revision, weights=weights * in_sight(revision.targets, graph.jj, state.visible)[..., None])


def step(
    model: StepModel,
    state: UpdateState,
    lookup: CorrelationLookup,
    options: BAOptions,
    *,
    factors: tuple[Factor, ...] = (),
    blocks: Mapping[str, StateBlock] | None = None,
) -> UpdateState:
    """Revise the flow of all edges, then fit poses and inverse depths to it by bundle adjustment.

    Args:
        model: provides the update operator, for instance a :class:`dvo.models.patch_vo.PatchVO`.
        state: edges, poses and patches to start from. Detach poses and patches to cut gradients between steps.
        lookup: correlation of patches and feature maps.
        options: of bundle adjustment; values are not checked.
        factors: further measurements, for example of depth or of an inertial sensor.
        blocks: further unknowns that the factors concern, by name.

    Returns:
        The state with new poses, patches, hidden state, targets and confidence, and without ``coords``.

    Raises:
        DvoError: factors or blocks that do not fit.
    """
    revision, graph = revise(model, state, lookup), state.graph
    given = state.poses_cw, state.patches, state.intrinsics, revision.targets, revision.weights
    problem = PatchProblem(*given, graph.ii, graph.jj, graph.kk, factors=factors, blocks=blocks or {})
    # What a sensor gives may come from another package; all else is made here.
    further = factors or blocks
    solved = adjust_dense(problem, replace(options, check=False)) if further else dense_solution(problem, options)
    return replace(
        state, hidden=revision.hidden, targets=revision.targets, confidence=revision.weights, coords=None,
        poses_cw=solved.poses_cw, patches=solved.patches, states=solved.blocks,
    )  # fmt: skip


def flow_step(model: StepModel, state: UpdateState, lookup: CorrelationLookup) -> UpdateState:
    """Revise the flow of all edges, each of which moves by its own revision alone; poses and depths do not change.

    Args:
        model, state, lookup: see :func:`step`.

    Returns:
        The state with new hidden state, targets, confidence and ``coords``.
    """
    revision = revise(model, state, lookup)
    coords = revision.coords + revision.delta[:, :, None, None]
    return replace(state, hidden=revision.hidden, targets=revision.targets, confidence=revision.weights, coords=coords)


def recent_depth(patches: Tensor, per_frame: int, frames: int) -> Tensor:
    """Median inverse depth of the newest frames, the initial depth of the patches of a new frame (DPVO 3.4).

    Args:
        patches: ``(B, K, 3, p, p)``, newest last.
        per_frame: patches of a frame.
        frames: number of frames to take the median over.

    Returns:
        ``(B,)`` inverse depth.
    """
    return patches[:, -frames * per_frame :, 2, 0, 0].median(dim=1).values
