"""Sizes and pose network of TartanVO (Wang, Hu, Scherer, "TartanVO: A Generalizable Learning-based VO", CoRL 2020).

The pose network reads a flow together with the intrinsics layer, two channels that hold the ray of each pixel, so that
one network serves all cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.geometry import so3
from dvo.nets.patch.encoder import ResidualBlock
from dvo.nets.sizes import Sizes, check_sizes, named_preset
from dvo.nets.two_frame.flow_pyramid import STRIDE, initialise

FlowUnits = Literal["pixels", "rays"]
"""Units of the flow that the pose network reads: feature pixels (TartanVO), or pixels over the focal length."""

Design = Literal["compact", "published"]
"""Layers: those of :mod:`dvo.nets.two_frame.flow_pyramid` and :class:`PoseNetwork`, or those of the published code,
PWC-Net
(:mod:`dvo.nets.two_frame.pwc_net`) and residual layers of one size (:mod:`dvo.nets.two_frame.flow_pose_net`)."""

RANGES = {
    "stem_channels": (1, 512),
    "radius": (1, 8),
    "decoder_channels": (1, 512),
    "head_channels": (1, 2048),
    "passes": (1, 8),
}
LEVELS, CHANNELS, GRID = 6, 1024, 32
_PIXELS, _RAYS = 0.1, 10.0  # factors that bring usual flows near one: some ten feature pixels, a tenth of a radian
_LEAST_AHEAD = 0.1  # cosine of the largest angle from the axis at which a turned ray is projected
_ROTATION = 0.05  # radians to a unit of the output, as TartanVO's scale of its output


@dataclass(frozen=True)
class TartanVOConfig(Sizes):
    """Sizes of :class:`dvo.models.tartanvo.TartanVO`.

    Attributes:
        stem_channels: encoder channels at half of the resolution.
        feature_channels: matching features at 1/4, 1/8, ... of the resolution.
        radius: of the correlation, in feature pixels of each level.
        decoder_channels: of the flow decoders.
        pose_channels: of the stages of the pose network, each at half of the resolution of the one before.
        grid: rows and columns to which the last stage is averaged, whatever the size of the image.
        head_channels: hidden channels of the two heads, translation and rotation.
        flow_units: see :data:`FlowUnits`.
        passes: of the pose network over the flow, each but the first over what the rotation found so far leaves of it
            (:func:`derotate`); TartanVO has one.
        design: see :data:`Design`; the sizes of ``published`` are fixed: the settings above keep their defaults.

    Raises:
        DvoError: a size of another type or out of range, or one that the design does not have.
    """

    stem_channels: int = 16
    feature_channels: tuple[int, ...] = (32, 48, 64)
    radius: int = 3
    decoder_channels: int = 48
    pose_channels: tuple[int, ...] = (32, 48, 64, 96)
    grid: tuple[int, ...] = (3, 4)
    head_channels: int = 64
    flow_units: FlowUnits = "pixels"
    passes: int = 1
    design: Design = "compact"

    def __post_init__(self) -> None:
        check_settings(self, RANGES)
        check_sizes(self.feature_channels, "feature_channels", (1, LEVELS), CHANNELS)
        check_sizes(self.pose_channels, "pose_channels", (1, LEVELS), CHANNELS)
        check_sizes(self.grid, "grid", (2, 2), GRID)
        if self.design == "published" and replace(self, design="compact") != TartanVOConfig():
            remedy = "leave the other sizes at their defaults, or use compact"
            raise DvoError("the sizes of the published network are fixed", field="design", remedy=remedy)

    @property
    def smallest_side(self) -> int:
        """Smallest height and width of an image, pixels: two pixels of the coarsest level."""
        levels = 5 if self.design == "published" else len(self.feature_channels)
        return 2 ** (levels + 2)


PRESETS: dict[str, TartanVOConfig] = {
    # Sized to track 320x240 video on two CPU cores.
    "small": TartanVOConfig(flow_units="rays", passes=2),
    # For tests and controlled studies.
    "tiny": TartanVOConfig(
        stem_channels=8,
        feature_channels=(16, 16, 24),
        radius=2,
        decoder_channels=16,
        pose_channels=(16, 24, 32),
        grid=(2, 3),
        head_channels=16,
    ),
    # The network of the paper, tensor for tensor.
    "full": TartanVOConfig(design="published"),
}


def preset(name: str) -> TartanVOConfig:
    """Configuration of a preset, a key of :data:`PRESETS`; see :func:`dvo.nets.sizes.named_preset`."""
    return named_preset(PRESETS, name)


def intrinsics_layer(intrinsics: Float[Tensor, "B 4"], height: int, width: int) -> Float[Tensor, "B 2 h w"]:
    """Rays of the pixels of a map, ``(x - cx) / fx`` and ``(y - cy) / fy`` (TartanVO 3.3).

    Args:
        intrinsics: ``fx fy cx cy`` in pixels of the map; pixel centres at integers.
        height, width: of the map.

    Returns:
        The two channels, differentiable by the intrinsics.
    """
    fx, fy, cx, cy = (value[:, None, None] for value in intrinsics.unbind(-1))
    x = (torch.arange(width, device=intrinsics.device, dtype=intrinsics.dtype) - cx) / fx
    y = (torch.arange(height, device=intrinsics.device, dtype=intrinsics.dtype)[:, None] - cy) / fy
    return torch.stack([x.expand(-1, height, -1), y.expand(-1, -1, width)], 1)


def derotate(
    flow: Float[Tensor, "B 2 h w"], rotation: Float[Tensor, "B 4"], intrinsics: Float[Tensor, "B 4"]
) -> Float[Tensor, "B 2 h w"]:
    """Flow that is left when the second camera is turned back by a rotation about its centre.

    The rays of the second image are turned into the orientation of the first one and projected again; no depth is
    needed. For the true rotation what is left is the flow of the translation alone.

    Args:
        flow: from the first image to the second, pixels of the map.
        rotation: ``qx qy qz qw`` of the second camera in the coordinates of the first one.
        intrinsics: ``fx fy cx cy`` in pixels of the map.

    Returns:
        Flow to the turned image, differentiable by flow and rotation. Rays that the rotation turns by more than about
        84 degrees from the axis of the camera are projected as if they were at that angle.
    """
    h, w = flow.shape[-2:]
    fx, fy, cx, cy = (value[:, None, None] for value in intrinsics.unbind(-1))
    x = torch.arange(w, device=flow.device, dtype=flow.dtype)
    y = torch.arange(h, device=flow.device, dtype=flow.dtype)[:, None]
    right, down = (x + flow[:, 0] - cx) / fx, (y + flow[:, 1] - cy) / fy
    rays = torch.stack([right, down, torch.ones_like(right)], -1)
    rays = so3.rotate(rotation[:, None, None], rays / rays.norm(dim=-1, keepdim=True))
    ahead = rays[..., 2].clamp(min=_LEAST_AHEAD)
    return torch.stack([rays[..., 0] / ahead * fx + cx - x, rays[..., 1] / ahead * fy + cy - y], 1)


class PoseNetwork(nn.Module):
    """Motion of the camera from a flow and the intrinsics layer.

    Args:
        config: sizes.
    """

    def __init__(self, config: TartanVOConfig) -> None:
        super().__init__()
        self.config = config
        first, *others = config.pose_channels
        self.conv1 = nn.Conv2d(4, first, 3, padding=1)
        self.stages = nn.Sequential(
            *(ResidualBlock(a, b, 2, "none") for a, b in zip(config.pose_channels, others, strict=False))
        )
        rows, columns = config.grid
        inputs = config.pose_channels[-1] * rows * columns
        self.translation = _head(inputs, config.head_channels)
        self.rotation = _head(inputs, config.head_channels)
        initialise(self)
        with torch.no_grad():
            for head in (self.translation, self.rotation):
                list(head.parameters())[-2].mul_(0.1)  # an untrained network answers near zero

    def forward(
        self, flow: Float[Tensor, "B 2 h w"], intrinsics: Float[Tensor, "B 4"]
    ) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
        """Compute the motion of the camera.

        Args:
            flow: from the first image to the second, feature pixels.
            intrinsics: ``fx fy cx cy`` of the image, image pixels.

        Returns:
            Translation, up to scale, and rotation vector, radians, of the pose of the second camera in the coordinates
            of the first one: ``T_ab``, with ``T_wc[b] = T_wc[a] T_ab``.
        """
        small = intrinsics.float() / STRIDE
        rays = intrinsics_layer(small, *flow.shape[-2:])
        unit = _RAYS / small[:, :2, None, None] if self.config.flow_units == "rays" else _PIXELS
        x = F.relu(self.conv1(torch.cat([flow.float() * unit, rays], 1)))
        rows, columns = self.config.grid
        x = F.adaptive_avg_pool2d(self.stages(x), (rows, columns)).flatten(1)
        return self.translation(x).float(), self.rotation(x).float() * _ROTATION


def _head(inputs: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 3)
    )
