"""Sizes and encoder of DROID-SLAM's network (Teed and Deng, NeurIPS 2021); layers and names as published."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.nets.patch.encoder import ResidualBlock
from dvo.nets.sizes import Sizes, named_preset

RANGES = {
    "stem_channels": (1, 256),
    "feature_channels": (1, 1024),
    "hidden_channels": (2, 1024),
    "levels": (1, 6),
    "radius": (1, 8),
}
STRIDE = 8
"""Image pixels to a feature pixel; feature ``(u, v)`` is centred on image pixel ``(8u, 8v)``."""
MASK = 9 * STRIDE * STRIDE
"""Channels of the upsampling mask: nine neighbours for each of the 8 by 8 pixels of a cell."""

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, RGB


@dataclass(frozen=True)
class DroidConfig(Sizes):
    """Sizes of :class:`dvo.models.droid.DroidVO`.

    Attributes:
        stem_channels: encoder channels at half of the image resolution; twice and four times as many at 1/4 and 1/8.
        feature_channels: matching features, compared by correlation.
        hidden_channels: state of the update operator, and context features; even.
        levels: of the correlation pyramid, each at half of the resolution of the one before.
        radius: correlation radius in pixels of each level.
        upsample: predict a mask that raises inverse depth maps to the resolution of the image.

    Raises:
        DvoError: a size of another type or out of :data:`RANGES`.
    """

    stem_channels: int = 32
    feature_channels: int = 128
    hidden_channels: int = 128
    levels: int = 4
    radius: int = 3
    upsample: bool = True

    def __post_init__(self) -> None:
        check_settings(self, RANGES)
        if self.hidden_channels % 2:
            raise DvoError(f"is odd: {self.hidden_channels}", field="hidden_channels", remedy="give an even number")

    @property
    def pyramid(self) -> tuple[int, ...]:
        """Down-sampling of each correlation level relative to the features."""
        return tuple(2**level for level in range(self.levels))

    @property
    def correlation_channels(self) -> int:
        """Number of correlation channels of a pixel."""
        return self.levels * (2 * self.radius + 1) ** 2

    @property
    def smallest_side(self) -> int:
        """Smallest height and width of an image, pixels: one pixel of the coarsest level."""
        return STRIDE * 2 ** (self.levels - 1)


PRESETS: dict[str, DroidConfig] = {
    # DROID-SLAM, tensor for tensor.
    "full": DroidConfig(),
    # Sized to track 320x240 video on two CPU cores and to be trained on one.
    "small": DroidConfig(stem_channels=16, feature_channels=64, hidden_channels=48, levels=3, upsample=False),
    # For tests and controlled studies.
    "tiny": DroidConfig(
        stem_channels=8, feature_channels=32, hidden_channels=24, levels=3, radius=2, upsample=False
    ),
}  # fmt: skip


def preset(name: str) -> DroidConfig:
    """Configuration of a preset, a key of :data:`PRESETS`; see :func:`dvo.nets.sizes.named_preset`."""
    return named_preset(PRESETS, name)


def standardise_images(images: Float[Tensor, "*n 3 H W"]) -> Float[Tensor, "*n 3 H W"]:
    """Scale images by the mean and the deviation of ImageNet, as the published weights expect.

    Args:
        images: RGB, uint8 or float in [0, 255].

    Returns:
        float32.
    """
    mean, deviation = (images.new_tensor(x, dtype=torch.float32)[:, None, None] for x in (_MEAN, _DEVIATION))
    return (images.float() / 255.0 - mean) / deviation


class DroidEncoder(nn.Module):
    """Image to features of stride 8; all convolutions are centred.

    Args:
        stem: channels at half of the resolution; twice and four times as many at 1/4 and 1/8.
        outputs: channels of the features.
        norm: ``"instance"`` for instance normalisation, ``"none"``.
    """

    def __init__(self, stem: int, outputs: int, norm: str) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, stem, 7, stride=2, padding=3)
        self.norm1: nn.Module = nn.InstanceNorm2d(stem) if norm == "instance" else nn.Identity()
        self.layer1 = nn.Sequential(ResidualBlock(stem, stem, 1, norm), ResidualBlock(stem, stem, 1, norm))
        self.layer2 = nn.Sequential(ResidualBlock(stem, 2 * stem, 2, norm), ResidualBlock(2 * stem, 2 * stem, 1, norm))
        self.layer3 = nn.Sequential(
            ResidualBlock(2 * stem, 4 * stem, 2, norm), ResidualBlock(4 * stem, 4 * stem, 1, norm)
        )
        self.conv2 = nn.Conv2d(4 * stem, outputs, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n c h w"]:
        """Encode images.

        Args:
            images: output of :func:`standardise_images`.

        Returns:
            Features at an eighth of the resolution, sizes rounded up.
        """
        x = F.relu(self.norm1(self.conv1(images)))
        return self.conv2(self.layer3(self.layer2(self.layer1(x))))
