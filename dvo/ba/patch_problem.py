"""The bundle adjustment problem of patches: one value for what is unknown and what measures it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES, StateBlock
from dvo.ba.edges import EdgePlan, plan_edges
from dvo.ba.kernels import Kernel
from dvo.ba.layer.reprojection import PatchReprojection
from dvo.ba.options import Sensors
from dvo.ba.problem import Factor
from dvo.core.errors import DvoError

KERNEL = Kernel("cauchy", 0.1)
"""Robust kernel that solutions are compared by, of weighted residuals in feature pixels."""
MAX_RESIDUAL = 32.0
"""Feature pixels; a longer residual has a constant cost."""


@dataclass(frozen=True)
class PatchProblem:
    """Poses and patches, and what measures them; :func:`dvo.ba.solve.solve` solves it.

    It is one graph, with the shapes given here, or a batch of graphs with the same edges, all tensors but the indices
    and the measured depths with a leading dimension ``B``.

    Attributes:
        poses_cw: ``(N, 7)`` world to camera (to body with several sensors).
        patches: ``(K, 3, p, p)`` x, y (feature-map pixels) and inverse depth; all pixels of a patch share the one of
            its centre.
        intrinsics: ``(N, 4)`` fx fy cx cy in the same pixels; ``(S, 4)`` with several sensors.
        targets: ``(E, 2)`` measured positions of the patch centres, pixels of frame j.
        weights: ``(E, 2)`` confidence per axis (inverse variance, pixels^-2), not negative.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch of each edge, in any order. All edges of a patch have
            the same source frame.
        sensors: cameras of a rig, None for one camera.
        factors: further measurements. They and ``blocks`` have a batch dimension, of 1 for one graph.
        blocks: further unknowns that the factors concern, by name.
        plan: layout that :func:`dvo.ba.edges.plan_edges` made of the edges; None: it is made when it is needed.
        identifiers: ``(N,)`` of the frames in a keyframe graph; empty without one.
    """

    poses_cw: Tensor
    patches: Tensor
    intrinsics: Tensor
    targets: Tensor
    weights: Tensor
    ii: Tensor
    jj: Tensor
    kk: Tensor
    sensors: Sensors | None = None
    factors: tuple[Factor, ...] = ()
    blocks: Mapping[str, StateBlock] = field(default_factory=dict)
    plan: EdgePlan | None = None
    identifiers: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))

    @property
    def inverse_depths(self) -> Tensor:
        """``(K,)`` or ``(B, K)`` of the patch centres."""
        centre = self.patches.shape[-1] // 2
        return self.patches[..., 2, centre, centre]

    @property
    def centres(self) -> Tensor:
        """``(K, 2)`` or ``(B, K, 2)`` x, y of the patch centres."""
        centre = self.patches.shape[-1] // 2
        return self.patches[..., :2, centre, centre]

    @property
    def per_frame(self) -> int:
        """Patches of a frame, where each has as many."""
        return self.patches.shape[-4] // self.poses_cw.shape[-2]

    def with_values(self, *, inverse_depths: Tensor | None = None, **values: Any) -> PatchProblem:
        """The same problem with other values.

        Args:
            inverse_depths: ``(K,)`` or ``(B, K)`` of all pixels of the patches; None: as they are.
            values: fields to replace.

        Returns:
            The problem. A layout of the edges is kept only if the edges are.

        Example:
            >>> problem.with_values(poses_cw=result.poses_cw, patches=result.patches)
        """
        if inverse_depths is not None:
            patches = values.get("patches", self.patches)
            row = inverse_depths.to(patches)[..., None, None, None].expand_as(patches[..., :1, :, :])
            values["patches"] = torch.cat((patches[..., :2, :, :], row), -3)
        if not {"ii", "jj", "kk"}.isdisjoint(values):
            values.setdefault("plan", None)
        return replace(self, **values)

    def planned(self) -> PatchProblem:
        """The problem with the layout of its edges, which several solutions then share."""
        if self.plan is not None:
            return self
        frames, patches = self.poses_cw.shape[-2], self.patches.shape[-4]
        return replace(self, plan=plan_edges(self.ii, self.jj, self.kk, frames, patches))

    def edges(self, which: Tensor) -> PatchProblem:
        """The same problem with some of its edges.

        Args:
            which: ``(E,)`` bool.

        Returns:
            All frames and patches, and the chosen edges.
        """
        at = which.nonzero()[:, 0]
        sensors = self.sensors
        if sensors is not None:
            sensors = replace(sensors, source=sensors.source[at], target=sensors.target[at])
        return self.with_values(
            targets=self.targets.index_select(-2, at), weights=self.weights.index_select(-2, at),
            ii=self.ii[at], jj=self.jj[at], kk=self.kk[at], sensors=sensors,
        )  # fmt: skip

    def select(self, frames: Tensor) -> PatchProblem:
        """The problem of some frames: their patches, and the edges between them.

        Args:
            frames: ``(N,)`` bool.

        Returns:
            The problem, with frames and patches in the same order.

        Raises:
            DvoError: patches that are not as many for each frame, in the order of the frames; or further factors or
                blocks, which are not known to belong to some frames.
        """
        count, each = self.patches.shape[-4], self.per_frame
        if count != each * len(frames) or bool((self.kk // max(each, 1) != self.ii).any()):
            raise DvoError(
                "patches are not in the order of their frames", field="patches", remedy="give each frame as many"
            )
        if self.factors or self.blocks:
            raise DvoError(
                "cannot be divided among frames", field="factors", remedy="select frames before adding factors"
            )
        chosen = self.edges(frames[self.ii] & frames[self.jj])
        rows, patches = frames.nonzero()[:, 0], frames.repeat_interleave(each)
        place, patch_place = frames.cumsum(0) - 1, patches.cumsum(0) - 1
        intrinsics = self.intrinsics if self.sensors is not None else self.intrinsics.index_select(-2, rows)
        return chosen.with_values(
            poses_cw=self.poses_cw.index_select(-2, rows),
            patches=self.patches.index_select(-4, patches.nonzero()[:, 0]), intrinsics=intrinsics,
            ii=place[chosen.ii], jj=place[chosen.jj], kk=patch_place[chosen.kk],
            identifiers=self.identifiers[rows] if len(self.identifiers) else self.identifiers,
        )  # fmt: skip

    def reprojection(
        self, max_residual: float, bounds: tuple[float, float] | None, kernel: Kernel, focal_only: bool = False
    ) -> PatchReprojection:
        """The measurements as a factor of the generic kind.

        Args:
            max_residual, bounds, kernel, focal_only: see :class:`dvo.ba.layer.reprojection.PatchReprojection`.

        Returns:
            The factor, of a batch.
        """
        p = self if self.poses_cw.dim() == 3 else self.batched()
        camera_i, camera_j, extrinsics = p.ii, p.jj, None
        if p.sensors is not None:
            camera_i, camera_j = p.sensors.source, p.sensors.target
            extrinsics = p.sensors.from_body.to(p.poses_cw).expand(len(p.poses_cw), -1, 7)
        return PatchReprojection(
            p.centres, p.targets, p.weights, p.ii, p.jj, p.kk, camera_i, camera_j, extrinsics, max_residual, bounds,
            kernel, focal_only,
        )  # fmt: skip

    def exact(self) -> PatchProblem:
        """The problem on the CPU in double precision, with the layout of its edges.

        Returns:
            A problem whose tensors are detached.
        """

        def real(x: Tensor) -> Tensor:
            return x.detach().cpu().double()

        sensors = self.sensors
        if sensors is not None:
            sensors = Sensors(sensors.source.cpu(), sensors.target.cpu(), real(sensors.from_body))
        ii, jj, kk = self.ii.cpu(), self.jj.cpu(), self.kk.cpu()
        return PatchProblem(
            real(self.poses_cw), real(self.patches), real(self.intrinsics), real(self.targets), real(self.weights),
            ii, jj, kk, sensors,
            tuple(factor.exact() for factor in self.factors),
            {name: block.with_value(real(block.value)) for name, block in self.blocks.items()},
            plan_edges(ii, jj, kk, self.poses_cw.shape[-2], self.patches.shape[-4]), self.identifiers,
        )  # fmt: skip

    def batched(self) -> PatchProblem:
        """One graph as a batch of one.

        Returns:
            The problem with a leading dimension of 1; the same if it is a batch.
        """
        if self.poses_cw.dim() == 3:
            return self
        names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
        return replace(self, **{name: getattr(self, name)[None] for name in names})

    @property
    def total_weight(self) -> float:
        """Sum of the weights of one graph: half the sum of its robust squared residuals over this is the mean of
        :meth:`robust_cost`."""
        return float(self.batched()._total_weights()[0])

    def _total_weights(self) -> Tensor:
        return self.weights.sum((1, 2)).clamp(min=torch.finfo(self.weights.dtype).tiny)

    def robust_cost(
        self,
        kernel: Kernel = KERNEL,
        max_residual: float = MAX_RESIDUAL,
    ) -> Tensor:
        """Mean robust cost of the measurements at the present values: what solutions are compared by.

        An edge whose point is not in front of the camera, or whose residual is too long, costs as much as the longest
        residual. Further factors add the costs that they have.

        Args:
            kernel: robust kernel of the weighted residual, pixels times the root of the weight.
            max_residual: pixels.

        Returns:
            ``(B,)`` half the sum of the robust squared residuals over the sum of the weights, pixels squared; a scalar
            for one graph.
        """
        p = self.batched()
        values = {POSES: p.poses_cw, INVERSE_DEPTHS: p.inverse_depths, INTRINSICS: p.intrinsics}
        values |= {name: block.value for name, block in p.blocks.items()}
        factors = p.reprojection(max_residual, None, kernel), *p.factors
        cost = 0.5 * torch.stack([factor.cost(values) for factor in factors]).sum(0) / p._total_weights()
        return cost if self.poses_cw.dim() == 3 else cost[0]
