"""Steps of a model on the window of a tracker."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.map.measured_depths import depth_factors
from dvo.map.window import Window
from dvo.models.step import Revision, StepModel, StepOptions, UpdateState, revise, step
from dvo.nets.alignment.alignment import AlignmentOptions
from dvo.odometry.window.alignment import WindowAlignment
from dvo.odometry.window.correlation import WindowCorrelation


@dataclass(frozen=True)
class StepSettings:
    """How the edges of a window are measured and weighted.

    Attributes:
        kernel: robust kernel of bundle adjustment.
        alignment: options of the sub-pixel alignment.
        align: measurements are aligned to a fraction of a pixel when they leave the window.
    """

    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)
    alignment: AlignmentOptions = AlignmentOptions()  # noqa: RUF009 (frozen)
    align: bool = True


class WindowStep:
    """Steps of a model on a window, in place.

    Args:
        model: the network.
        window: keyframes and edges.
        lookup: correlation of the window's edges.
        align: sub-pixel alignment of its measurements, None for none.
        final: align the measurements that leave the window (:meth:`finalise`), instead of those of every step.
        kernel: robust kernel of bundle adjustment, which takes the influence from moving bodies and wrong matches.

    Attributes:
        bounds: ``(width, height)`` of the feature map.
    """

    def __init__(
        self,
        model: StepModel,
        window: Window,
        lookup: WindowCorrelation,
        align: WindowAlignment | None = None,
        final: bool = True,
        kernel: Kernel = Kernel(),  # noqa: B008 (frozen)
    ) -> None:
        self.model, self.window, self.lookup, self.align, self.final = model, window, lookup, align, final
        self.kernel = kernel
        self.bounds = (0, 0)

    def of_copy(self, window: Window, last: bool) -> WindowStep:
        """Step on a copy of the window, with caches of its own.

        Args:
            window: with the same frames and edges.
            last: no step will be taken, only measurements aligned that leave the window (:meth:`finalise`).
        """
        shared = {id(self.model): self.model, id(self.window): window}
        return deepcopy(self, shared | ({id(self.lookup): self.lookup} if last else {}))

    def keep_frame(self, map_slot: int, image: np.ndarray, maps: Tensor) -> None:
        """Store feature maps and image of a frame.

        Args:
            map_slot: slot of the frame; its content is overwritten.
            image: ``(H, W, 3)`` uint8 RGB working image.
            maps: see :class:`dvo.odometry.frames.front_end.Observation`.
        """
        self.bounds = maps.shape[-1], maps.shape[-2]
        self.lookup.keep_maps(map_slot, maps)
        if self.align is not None:
            self.align.keep_image(map_slot, image)

    def forget(self, edge_slots: Tensor) -> None:
        """Invalidate the cached results of new edges.

        Args:
            edge_slots: ``(e,)``.
        """
        self.lookup.forget(edge_slots)
        if self.align is not None and not self.final:
            self.align.forget(edge_slots)

    def finalise(self, edges: Tensor) -> None:
        """Align edges that leave the window, if that is wanted.

        Args:
            edges: ``(e,)`` positions among the edges of the window.
        """
        if self.align is not None and self.final:
            self.align.finalise(edges)

    def state(self) -> UpdateState:
        """State of the window.

        Returns:
            State with a batch dimension of 1.
        """
        w = self.window
        return UpdateState(
            w.edges, w.poses_cw[None], w.patches[None], w.intrinsics[None], w.context[None], w.hidden[None],
            visible=w.visible,
        )  # fmt: skip

    def revise(self) -> Revision:
        """Run the network on the edges of the window, which does not change.

        Returns:
            Output of the network.
        """
        return revise(self.model, self.state(), self.lookup)

    def store(self, revision: Revision) -> None:
        """Store the measurements of a revision as those of the window; poses and depths do not change.

        Args:
            revision: of :meth:`revise`.
        """
        window = self.window
        window.targets, window.weights = revision.targets[0], revision.weights[0]
        window.confidence = revision.weights[0]

    def __call__(self, options: StepOptions, align: bool = False) -> None:
        """Take a step and store its result in the window, see :func:`dvo.models.step.step`.

        Args:
            options: of the step; ``bounds`` are replaced by those of the feature map, and ``kernel`` by that of the
                tracker; measured depths join its factors.
            align: use the sub-pixel alignment, if it takes part in every step. Its large weights would keep the first
                solution of a window from leaving a wrong minimum.
        """
        refine = self.align if align and not self.final else None
        factors = *options.factors, *depth_factors(self.window.measured), *depth_factors(self.window.prior)
        options = replace(options, bounds=self.bounds, kernel=self.kernel, factors=factors)
        after = step(self.model, self.state(), self.lookup, options, refine)
        assert after.targets is not None and after.weights is not None and after.confidence is not None
        window = self.window
        window.poses_cw, window.patches, window.hidden = after.poses_cw[0], after.patches[0], after.hidden[0]
        window.targets, window.weights = after.targets[0], after.weights[0]
        window.confidence = after.confidence[0]
