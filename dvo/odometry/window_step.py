"""Steps of a model on the window of a tracker."""

from __future__ import annotations

from dataclasses import replace

from dvo.graph.window import Window
from dvo.models.step import Revision, StepModel, StepOptions, UpdateState, revise, step
from dvo.nets.correlation import CorrelationLookup


class WindowStep:
    """Steps of a model on a window, in place.

    Args:
        model: the network.
        window: keyframes and edges.
        lookup: correlation of the window's edges.

    Attributes:
        bounds: ``(width, height)`` of the feature map.
    """

    def __init__(self, model: StepModel, window: Window, lookup: CorrelationLookup) -> None:
        self.model, self.window, self.lookup = model, window, lookup
        self.bounds = (0, 0)

    def state(self) -> UpdateState:
        """State of the window.

        Returns:
            State with a batch dimension of 1.
        """
        w = self.window
        return UpdateState(
            w.edges, w.poses_cw[None], w.patches[None], w.intrinsics[None], w.context[None], w.hidden[None]
        )

    def revise(self) -> Revision:
        """Run the network on the edges of the window, which does not change.

        Returns:
            Output of the network.
        """
        return revise(self.model, self.state(), self.lookup)

    def __call__(self, options: StepOptions) -> None:
        """Take a step and store its result in the window, see :func:`dvo.models.step.step`.

        Args:
            options: of the step; ``bounds`` are replaced by those of the feature map.
        """
        after = step(self.model, self.state(), self.lookup, replace(options, bounds=self.bounds))
        assert after.targets is not None and after.weights is not None
        window = self.window
        window.poses_cw, window.patches, window.hidden = after.poses_cw[0], after.patches[0], after.hidden[0]
        window.targets, window.weights = after.targets[0], after.weights[0]
