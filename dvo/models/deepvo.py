"""Pose regression from image pairs (DeepVO: Wang, Clark, Wen, Trigoni, "DeepVO: Towards End-to-End Visual Odometry
with Deep Recurrent Convolutional Neural Networks", ICRA 2017).

Convolutions turn two neighbouring images into features, recurrent layers carry information along the clip, and a linear
layer gives the motion between the two frames. There is no geometry in it: no correspondence, no depth, no bundle
adjustment. Two things follow.

- The network does not know the camera. Images are resized to one working size, and the same flow is another motion
  under another focal length; what it gives is right for the intrinsics that it was trained on, at best for their mean.
- The scale is that of the training clips: translations are in units of the median depth of the clip (rendered clips,
  and recordings with depth), or such that the mean step of the clip is 0.15 (recordings without depth, see
  :mod:`train.data.real`). The ratio of translation to depth is what two images show, whatever the scale of the scene;
  so within a sequence the scale of the trajectory follows the depth of the view, and drifts with it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dvo.geometry import se3, so3
from dvo.nets.two_frame.deepvo import PRESETS, DeepVOConfig, PairEncoder, fit_images

TRANSLATION_UNIT = 0.15
"""Length of a step for which the network's last layer gives 1, median depths; the unit of the loss as well.

With ``kappa = 100`` both terms of the loss are then of one size on rendered clips, whose steps measure 0.07 median
depths and 0.04 rad (root mean square over 40 clips with 1 to 14 pixels of flow)."""
ROTATION_UNIT = 0.1
"""Angle for which the last layer gives 1, radians."""

RecurrentState = tuple[Tensor, Tensor]
"""Hidden state and cell of the recurrent layers, each ``(layers, B, hidden_channels)``."""


class DeepVO(nn.Module):
    """Convolutional encoder of image pairs, recurrent layers, and a linear layer for the motion.

    Args:
        config: sizes, see :class:`dvo.nets.two_frame.deepvo.DeepVOConfig`.

    Example:
        >>> model = DeepVO(DeepVO.presets["tiny"])
        >>> steps, state = model(torch.zeros(1, 5, 3, 96, 128, dtype=torch.uint8))
        >>> steps.shape
        torch.Size([1, 4, 6])
    """

    architecture = "deepvo"
    config_type = DeepVOConfig
    presets = PRESETS

    def __init__(self, config: DeepVOConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = PairEncoder(config)
        self.recurrent = nn.LSTM(config.pair_features, config.hidden_channels, config.layers, batch_first=True)
        self.head = nn.Linear(config.hidden_channels, 6)
        unit = torch.tensor([TRANSLATION_UNIT] * 3 + [ROTATION_UNIT] * 3)
        self.register_buffer("unit", unit, persistent=False)

    def forward(
        self, images: Float[Tensor, "B N 3 H W"], state: RecurrentState | None = None
    ) -> tuple[Float[Tensor, "B N-1 6"], RecurrentState]:
        """Regress the motion between neighbouring frames.

        Args:
            images: uint8 RGB (or float in the same range), of any size; see
                :func:`dvo.nets.two_frame.deepvo.fit_images`.
            state: of the recurrent layers after the frames before; None at the beginning of a sequence.

        Returns:
            Steps, see :func:`step_pose`; and the state after the last one. A sequence in pieces that share a frame,
            with the state handed on, gives the steps of the whole.
        """
        features = self.encoder(fit_images(images, self.config.height, self.config.width))
        hidden, state = self.recurrent(features, state)
        return self.head(hidden) * self.unit, state


def step_pose(step: Float[Tensor, "... 6"]) -> Float[Tensor, "... 7"]:
    """Pose of the next camera in the frame of the camera before it, ``T_wc[k]^-1 T_wc[k+1]``.

    Args:
        step: position of the next camera (not the ``tau`` of a tangent vector), median depths, and the rotation vector
            of its orientation, radians. For the small rotations between frames it is, to first order, the vector of
            Euler angles that the paper regresses.

    Returns:
        The pose.
    """
    return torch.cat([step[..., :3], so3.exp(step[..., 3:])], -1)


def pose_step(pose: Float[Tensor, "... 7"]) -> Float[Tensor, "... 6"]:
    """Step of a pose, the inverse of :func:`step_pose`.

    Args:
        pose: of the next camera in the frame of the camera before it.

    Returns:
        Position and rotation vector.
    """
    return torch.cat([pose[..., :3], so3.log(pose[..., 3:])], -1)


def true_steps(poses_cw: Float[Tensor, "B N 7"]) -> Float[Tensor, "B N-1 6"]:
    """Steps of a trajectory.

    Args:
        poses_cw: world to camera.

    Returns:
        Step from each frame to the next, in the unit of the poses and radians.
    """
    return pose_step(se3.steps(poses_cw))


def chain(steps: Float[Tensor, "B N-1 6"]) -> Float[Tensor, "B N 7"]:
    """Trajectory of steps: their product.

    Args:
        steps: from each frame to the next, see :func:`step_pose`.

    Returns:
        Poses ``T_cw`` in the world of the first camera.
    """
    poses = [se3.identity(len(steps), dtype=steps.dtype, device=steps.device)]
    for step in step_pose(steps).unbind(1):
        poses.append(se3.normalise(se3.compose(poses[-1], step)))
    return se3.inverse(torch.stack(poses, 1))
