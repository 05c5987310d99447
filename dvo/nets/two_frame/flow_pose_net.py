"""Pose network of TartanVO as it was published (Wang, Hu, Scherer, CoRL 2020): residual layers and two heads.

Names and shapes of the tensors are those of the published code (github.com/castacks/tartanvo,
``Network/VOFlowNet.py``), so that its checkpoint fits.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.nets.two_frame.flow_pyramid import STRIDE, initialise
from dvo.nets.two_frame.pwc_net import FLOW_UNIT
from dvo.nets.two_frame.tartanvo import intrinsics_layer

_STEM = 32
_STAGES = ((64, 3), (128, 4), (128, 6), (256, 7), (256, 3))  # channels and blocks, each stage at half of the resolution
_GRID = (2, 3)  # rows and columns of the last stage; those of the 640x448 pixels of the published training
_HIDDEN = (128, 32)
_TRANSLATION, _ROTATION = 0.13, 0.013  # unit of the outputs; radians
_FORWARD_RIGHT_DOWN = (1, 2, 0)
"""Position of right, down and forward among the outputs, which are in the order forward, right, down."""
_OFFSET = (STRIDE - 1) / 2
"""The published intrinsics layer is resized from the image: its pixel ``u`` has the ray of image pixel ``4u + 1.5``."""


class FlowPoseNet(nn.Module):
    """Motion of the camera from a flow and the intrinsics layer.

    The published code takes images of 640x448 pixels alone; the last stage of others is averaged to the same grid.
    """

    def __init__(self) -> None:
        super().__init__()
        self.firstconv = nn.Sequential(
            _convolution(4, _STEM, 2), _convolution(_STEM, _STEM), _convolution(_STEM, _STEM)
        )
        inputs = _STEM
        for number, (width, blocks) in enumerate(_STAGES, start=1):
            layers = [_Block(inputs if block == 0 else width, width, 2 if block == 0 else 1) for block in range(blocks)]
            self.add_module(f"layer{number}", nn.Sequential(*layers))
            inputs = width
        inputs *= _GRID[0] * _GRID[1]
        self.voflow_trans, self.voflow_rot = _head(inputs), _head(inputs)
        initialise(self)

    def forward(
        self, flow: Float[Tensor, "B 2 h w"], intrinsics: Float[Tensor, "B 4"]
    ) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
        """Compute the motion of the camera.

        Args:
            flow: from the first image to the second, feature pixels.
            intrinsics: ``fx fy cx cy`` of the image, image pixels; pixel centres at integers.

        Returns:
            Translation, up to scale, and rotation vector, radians, of ``T_ab``, the pose of the second camera in the
            coordinates of the first one: x right, y down, z forward.
        """
        shift = intrinsics.new_tensor([0.0, 0.0, _OFFSET, _OFFSET])
        rays = intrinsics_layer((intrinsics - shift).float() / STRIDE, *flow.shape[-2:])
        x = self.firstconv(torch.cat([flow.float() * (STRIDE / FLOW_UNIT), rays], 1))
        for number in range(1, len(_STAGES) + 1):
            x = self.get_submodule(f"layer{number}")(x)
        x = F.adaptive_avg_pool2d(x, _GRID).flatten(1)
        order = list(_FORWARD_RIGHT_DOWN)
        translation, rotation = self.voflow_trans(x).float()[:, order], self.voflow_rot(x).float()[:, order]
        return translation * _TRANSLATION, rotation * _ROTATION


class _Block(nn.Module):
    """Residual block without normalisation."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = _convolution(inputs, outputs, stride)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.downsample = nn.Conv2d(inputs, outputs, 1, stride=stride) if stride > 1 else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.conv2(self.conv1(x)) + self.downsample(x))


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.ReLU())


def _head(inputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in _HIDDEN:
        layers.append(nn.Sequential(nn.Linear(inputs, width), nn.ReLU()))
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, 3))
