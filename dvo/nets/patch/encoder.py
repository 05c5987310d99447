"""Convolutional encoder at a quarter of the image resolution (DPVO 3.1; layers and names as its ``BasicEncoder4``)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


def _norm(channels: int, kind: str) -> nn.Module:
    return nn.InstanceNorm2d(channels) if kind == "instance" else nn.Identity()


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a skip; the skip is a strided 1x1 convolution where the shape changes.

    Args:
        inputs, outputs: number of channels.
        stride: of the first convolution.
        norm: ``"instance"`` for instance normalisation, anything else for none.
    """

    def __init__(self, inputs: int, outputs: int, stride: int, norm: str) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.norm1 = _norm(outputs, norm)
        self.norm2 = _norm(outputs, norm)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride=stride), _norm(outputs, norm))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block.

        Args:
            x: ``(n, inputs, h, w)``.

        Returns:
            ``(n, outputs, h / stride, w / stride)``.
        """
        y = F.relu(self.norm1(self.conv1(x)))
        y = F.relu(self.norm2(self.conv2(y)))
        return F.relu(self.downsample(x) + y)


class Encoder(nn.Module):
    """Image to features of stride 4.

    All convolutions are centred, so feature ``(u, v)`` is centred on image pixel ``(4u, 4v)`` and the intrinsics of
    the feature map are exactly those of the image divided by 4.

    Args:
        stem, trunk: channels at 1/2 and 1/4 of the image resolution.
        outputs: channels of the features.
        norm: see :class:`ResidualBlock`.
    """

    def __init__(self, stem: int, trunk: int, outputs: int, norm: str) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, stem, 7, stride=2, padding=3)
        self.norm1 = _norm(stem, norm)
        self.layer1 = nn.Sequential(ResidualBlock(stem, stem, 1, norm), ResidualBlock(stem, stem, 1, norm))
        self.layer2 = nn.Sequential(ResidualBlock(stem, trunk, 2, norm), ResidualBlock(trunk, trunk, 1, norm))
        self.conv2 = nn.Conv2d(trunk, outputs, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def stem(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n s H2 W2"]:
        """Layers at half of the image resolution.

        Args:
            images: normalised images.

        Returns:
            Stem features, centred on image pixels ``(2u, 2v)``.
        """
        return self.layer1(F.relu(self.norm1(self.conv1(images))))

    def trunk(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n t h w"]:
        """All layers but the last one, a 1x1 convolution that :meth:`head` allows to evaluate at single pixels.

        Args:
            images: normalised images.

        Returns:
            Trunk features at a quarter of the image resolution.
        """
        return self.layer2(self.stem(images))

    def head(self, outputs: slice) -> tuple[Tensor, Tensor]:
        """Parameters of some output channels of the last layer.

        Args:
            outputs: slice of the output channels.

        Returns:
            Weight ``(c, t)`` and bias ``(c,)``.
        """
        assert self.conv2.bias is not None
        return self.conv2.weight[outputs, :, 0, 0], self.conv2.bias[outputs]

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n c h w"]:
        """Encode images.

        Args:
            images: normalised images.

        Returns:
            Features at a quarter of the image resolution.
        """
        return self.conv2(self.trunk(images))
