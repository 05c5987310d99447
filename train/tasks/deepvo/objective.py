"""Loss of a pose-regression network: squared errors of position and orientation (DeepVO, ICRA 2017, eq. 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from dvo.core.settings import check_settings
from dvo.models.deepvo import TRANSLATION_UNIT


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms.

    Attributes:
        kappa: weight of the squared error of the orientation, 1/rad^2, beside a squared error of the position in units
            of :data:`dvo.models.deepvo.TRANSLATION_UNIT`. The 100 of the paper stands beside metres, of which a car
            makes about one between two frames.

    Raises:
        DvoError: a weight that is no number, or negative.
    """

    kappa: float = 100.0

    def __post_init__(self) -> None:
        check_settings(self, {"kappa": (0, math.inf)})


@dataclass(frozen=True)
class StepErrors:
    """Mean squared errors of the steps of each clip.

    Attributes:
        translation: ``(B,)`` squared units of :data:`dvo.models.deepvo.TRANSLATION_UNIT`.
        rotation: ``(B,)`` squared radians.
    """

    translation: Tensor
    rotation: Tensor

    def total(self, config: LossConfig) -> Tensor:
        """Weighted sum of both terms, the mean over the clips.

        Args:
            config: weights.

        Returns:
            Scalar.
        """
        return (self.translation + config.kappa * self.rotation).mean()


def step_errors(steps: Float[Tensor, "B N-1 6"], truth: Float[Tensor, "B N-1 6"]) -> StepErrors:
    """Errors of regressed steps: the squared norms of the differences, in mean over the steps of a clip.

    The paper takes the difference of Euler angles; here it is that of rotation vectors, which agrees with it to first
    order for the rotations between neighbouring frames and has no order of axes.

    Args:
        steps: of the network, median depths and radians, see :func:`dvo.models.deepvo.step_pose`.
        truth: true steps, see :func:`dvo.models.deepvo.true_steps`.

    Returns:
        The errors, with gradients to ``steps``.
    """
    difference = steps - truth
    translation, rotation = difference[..., :3] / TRANSLATION_UNIT, difference[..., 3:]
    return StepErrors(translation.square().sum(-1).mean(-1), rotation.square().sum(-1).mean(-1))
