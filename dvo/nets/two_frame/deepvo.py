"""Layers of the pose-regression network (DeepVO: Wang, Clark, Wen, Trigoni, ICRA 2017), its sizes and presets."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.nets.sizes import Sizes, check_sizes

# Kernel and stride of the nine convolutions (DeepVO, table I; those of FlowNetSimple).
LAYERS = ((7, 2), (5, 2), (5, 2), (3, 1), (3, 2), (3, 1), (3, 2), (3, 1), (3, 2))
STRIDE = 64  # working pixels to a pixel of the last feature map

# Smallest and largest sizes; the largest keep a file from claiming the memory.
RANGES = {"height": (32, 1024), "width": (32, 2048), "hidden_channels": (1, 2048), "layers": (1, 4)}
WIDEST = 2048  # channels of a convolution
INPUTS = 65_536  # features of an image pair that the recurrent layers take


@dataclass(frozen=True)
class DeepVOConfig(Sizes):
    """Sizes of :class:`dvo.models.deepvo.DeepVO`.

    Attributes:
        height, width: of the working image, pixels. Every image is resized to it and the aspect is not kept, so that
            the recurrent layers get the same number of features from every camera.
        channels: output of each of the nine convolutions.
        hidden_channels: state of each recurrent layer.
        layers: number of recurrent layers.

    Raises:
        DvoError: a size of another type or out of :data:`RANGES`, or another number of convolutions.
    """

    height: int = 120
    width: int = 160
    channels: tuple[int, ...] = (16, 32, 48, 48, 64, 64, 96, 96, 96)
    hidden_channels: int = 128
    layers: int = 2

    def __post_init__(self) -> None:
        check_settings(self, RANGES)
        check_sizes(self.channels, "channels", (len(LAYERS), len(LAYERS)), WIDEST)
        if self.pair_features > INPUTS:
            message = f"too many features of an image pair: {self.pair_features:,}, {INPUTS:,} at most"
            raise DvoError(message, field="channels", remedy="give a smaller working image, or fewer channels")

    @property
    def pair_features(self) -> int:
        """Number of features of an image pair: channels x rows x columns of the last feature map."""
        return self.channels[-1] * -(-self.height // STRIDE) * -(-self.width // STRIDE)


PRESETS: dict[str, DeepVOConfig] = {
    # A fiftieth of the paper's convolutions and an eighth of its hidden channels, to be trained on one core.
    "small": DeepVOConfig(),
    # For tests and controlled studies.
    "tiny": DeepVOConfig(
        height=48, width=64, channels=(8, 12, 16, 16, 24, 24, 32, 32, 32), hidden_channels=32, layers=1
    ),
}


def fit_images(images: Float[Tensor, "... 3 H W"], height: int, width: int) -> Float[Tensor, "... 3 h w"]:
    """Resize images to a working size, each axis by its own factor, and scale them to [-1, 1].

    Args:
        images: RGB, uint8 or float in [0, 255].
        height, width: working size, pixels.

    Returns:
        Float images. They are averaged where they shrink (bilinear with antialiasing).
    """
    flat = images.float().reshape(-1, *images.shape[-3:])
    if flat.shape[-2:] != (height, width):
        flat = F.interpolate(flat, (height, width), mode="bilinear", align_corners=False, antialias=True)
    return (flat / 127.5 - 1.0).reshape(*images.shape[:-2], height, width)


class PairEncoder(nn.Module):
    """Convolutions of FlowNetSimple on two stacked images, each but the last followed by a ReLU (DeepVO, table I).

    Args:
        config: sizes of the network.
    """

    def __init__(self, config: DeepVOConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = 6
        for (kernel, stride), channels in zip(LAYERS, config.channels, strict=True):
            convolution = nn.Conv2d(before, channels, kernel, stride, kernel // 2)
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
            nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
            layers += [convolution, nn.ReLU()]
            before = channels
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, images: Float[Tensor, "B N 3 h w"]) -> Float[Tensor, "B N-1 F"]:
        """Features of every two neighbouring images of a clip.

        Args:
            images: output of :func:`fit_images`.

        Returns:
            ``F`` = :attr:`DeepVOConfig.pair_features` numbers a pair: the last feature map, flattened.
        """
        pairs = images.unfold(1, 2, 1).movedim(-1, 2).flatten(2, 3)  # (B, N-1, 6, h, w), the earlier image first
        features = self.layers(pairs.flatten(0, 1)).flatten(1)
        return features.unflatten(0, pairs.shape[:2])
