"""Weight of the flow loss that follows the trends of the losses: the Trending-Aware Penalty of MambaVO.

MambaVO (Wang et al., arXiv 2412.20082) scales the matching loss, every 50 steps, by the ratio of the norms of the pose
and the matching gradient, and multiplies that by the exponentials of the trends of both losses: a present loss against
the mean of its last four values. Neither the equations of the paper nor code of its authors was at hand; this is a
reading of descriptions and of a reproduction by others (mohamyt/MambaVO-RRR):

    ratio(L)  = L / mean of its last K values, clamped to [1/2, 2]
    penalty   = exp(ratio(L_flow) - ratio(L_pose))
    loss      = L_pose + beta * penalty * L_flow

The term that grows faster against its own recent past gains weight at once, and loses it as the mean follows; equal
trends change nothing. Deviations, the first against a runaway that the reproduction saw (a factor of 90):

- the clamp, and ``beta`` is the clamped and smoothed ratio of the gradients on one parameter
  (:class:`dvo.losses.balance.Coefficient`);
- the mean is over the values before the present one;
- the flow loss of the ratio is without ``beta``, so that a new ``beta`` is no trend.

Weights are constants: no gradient passes through them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

CLAMP = (0.5, 2.0)
"""Smallest and largest ratio of a loss to its recent mean."""
FLOOR = 1e-8
"""Lowest mean: smaller ones count as no trend."""


def trend_ratio(value: float, recent: tuple[float, ...], window: int) -> float:
    """Ratio of a loss to the mean of its values before, clamped to :data:`CLAMP`.

    Args:
        value: present loss.
        recent: values before, oldest first.
        window: number of values that the mean needs; with fewer there is no trend yet.

    Returns:
        The ratio; 1 for no trend.
    """
    mean = sum(recent[-window:]) / window if len(recent) >= window else 0.0
    if mean < FLOOR:
        return 1.0
    return min(max(value / mean, CLAMP[0]), CLAMP[1])


@dataclass
class TrendPenalty:
    """Penalty factor of the flow loss, from the histories of both losses.

    Attributes:
        window: values in a mean.
        value: present factor, from ``exp(-1.5)`` to ``exp(1.5)``.
        pose, flow: last values of the losses, oldest first.

    Example:
        >>> penalty = TrendPenalty(window=2)
        >>> [round(penalty.follow(1.0, flow), 3) for flow in (1.0, 1.0, 1.5, 1.25)]
        [1.0, 1.0, 1.649, 1.0]
    """

    window: int = 4
    value: float = 1.0
    pose: tuple[float, ...] = ()
    flow: tuple[float, ...] = ()

    def follow(self, pose: float, flow: float) -> float:
        """Take the losses of a step and return the new factor.

        A step without one of the losses (not positive, or not finite) changes nothing.

        Args:
            pose: present pose loss, in any constant unit.
            flow: present flow loss, in any constant unit.

        Returns:
            The factor of the flow loss.
        """
        if not all(math.isfinite(value) and value > 0 for value in (pose, flow)):
            return self.value
        flow_ratio, pose_ratio = trend_ratio(flow, self.flow, self.window), trend_ratio(pose, self.pose, self.window)
        self.value = math.exp(flow_ratio - pose_ratio)
        self.pose = (*self.pose, pose)[-self.window :]
        self.flow = (*self.flow, flow)[-self.window :]
        return self.value

    def state_dict(self) -> dict[str, Any]:
        """Plain values, for checkpoints.

        Returns:
            Name to value.
        """
        return {"value": self.value, "pose": list(self.pose), "flow": list(self.flow)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`.

        Args:
            state: plain values; of values beyond the window, the oldest are dropped.
        """
        self.value = float(state["value"])
        self.pose = tuple(float(value) for value in state["pose"])[-self.window :]
        self.flow = tuple(float(value) for value in state["flow"])[-self.window :]
