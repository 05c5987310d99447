"""Convolutional encoders at a quarter of the image resolution: that of DPVO (3.1; layers and names as its
``BasicEncoder4``), and a light one for tracking on a CPU."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.core.kernels import use_kernels

_NOISE = 1e-4  # variance of an image that is no contrast, in units of normalised images (about a grey level)


def _norm(channels: int, kind: str) -> nn.Module:
    return nn.InstanceNorm2d(channels) if kind == "instance" else nn.Identity()


def normalise(
    x: Float[Tensor, "n c h w"], norm: nn.Module, rectified: bool = True, skip: Tensor | None = None
) -> Float[Tensor, "n c h w"]:
    """Normalise the output of a convolution; add a skip, and rectify the sum.

    Args:
        x: is overwritten where a kernel computes, which takes channels that are last in memory, a multiple of eight.
        norm: :class:`torch.nn.InstanceNorm2d` without parameters, or the identity.
        rectified: with a rectifier behind the normalisation.
        skip: of the same shape; None: none.
    """
    given = (x,) if skip is None else (x, skip)
    if isinstance(norm, nn.InstanceNorm2d) and use_kernels(*given, half=True) and all(map(_suits_kernels, given)):
        from dvo.nets.patch import encoder_kernels

        half = x.dtype == torch.bfloat16
        kernel = encoder_kernels.normalise_bfloat16 if half else encoder_kernels.normalise
        arrays = (one.view(torch.uint16) if half else one for one in given)
        pixels, *beside = (one.permute(0, 2, 3, 1).flatten(1, 2).numpy() for one in arrays)
        kernel(pixels, norm.eps, rectified, beside[0] if beside else pixels[:0])
        return x
    x = norm(x)
    x = F.relu(x) if rectified else x
    return x if skip is None else F.relu(skip + x)


def _suits_kernels(x: Tensor) -> bool:
    return x.shape[1] % 8 == 0 and x.is_contiguous(memory_format=torch.channels_last)


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
        y = normalise(self.conv1(x), self.norm1)
        if isinstance(self.downsample, nn.Sequential):
            convolution, norm = self.downsample
            x = normalise(convolution(x), norm, rectified=False)
        return normalise(self.conv2(y), self.norm2, skip=x)


class _StrideFour(nn.Module):
    """Last layer of an encoder of stride 4, a 1x1 convolution behind :meth:`trunk`."""

    conv2: nn.Conv2d

    def trunk(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n t h w"]:
        """All layers but the last one, which :meth:`head` allows to evaluate at single pixels.

        Args:
            images: normalised images.

        Returns:
            Trunk features at a quarter of the image resolution.
        """
        raise NotImplementedError

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

    def _draw(self, mode: Literal["fan_in", "fan_out"]) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode=mode, nonlinearity="relu")


class Encoder(_StrideFour):
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
        self._draw("fan_out")

    def stem(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n s H2 W2"]:
        """Layers at half of the image resolution.

        Args:
            images: normalised images.

        Returns:
            Stem features, centred on image pixels ``(2u, 2v)``.
        """
        records = torch.is_grad_enabled() and self.conv1.weight.requires_grad
        if use_kernels(images) and not records:
            # Convolutions are faster in this order, and keep it if all strides are those of a copy.
            images = torch.empty_like(images, memory_format=torch.channels_last).copy_(images)
        images = images.to(self.conv1.weight.dtype)
        return self.layer1(normalise(self.conv1(images), self.norm1))

    def trunk(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n t h w"]:
        """See :meth:`_StrideFour.trunk`."""
        return self.layer2(self.stem(images))


def standardise_whole(images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 H W"]:
    """Give each image the mean 0 and the deviation 1, over all of its pixels and colours.

    Args:
        images: normalised images. An image of one value becomes 0; noise below a grey level is not raised to 1.
    """
    mean = images.mean((1, 2, 3), keepdim=True)
    centred = images - mean
    variance = centred.square().mean((1, 2, 3), keepdim=True)
    return centred * torch.rsqrt(variance + _NOISE)


def local_contrast(images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 1 H W"]:
    """Grey values less the mean of their surroundings, over its deviation: faint texture counts beside strong edges.

    Args:
        images: normalised images. The surroundings are about 20 pixels wide; noise below a grey level is not raised.
    """
    grey = images.mean(1, keepdim=True)
    coarse = F.avg_pool2d(torch.cat([grey, grey.square()], 1), 4, ceil_mode=True)
    around = F.avg_pool2d(coarse, 5, stride=1, padding=2, count_include_pad=False)
    around = F.interpolate(around, scale_factor=4.0, mode="bilinear", align_corners=False)
    mean, square = around[..., : images.shape[2], : images.shape[3]].split(1, 1)
    return (grey - mean) * torch.rsqrt((square - mean.square()).clamp(min=0) + _NOISE)


class WideBlock(nn.Module):
    """Depthwise 5x5 convolution, two 1x1 convolutions with twice the channels between them, and a skip (ConvNeXt's
    order; nothing is normalised).

    Args:
        channels: of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.around = nn.Conv2d(channels, channels, 5, padding=2, groups=channels)
        self.widen = nn.Conv2d(channels, 2 * channels, 1)
        self.narrow = nn.Conv2d(2 * channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block.

        Args:
            x: ``(n, channels, h, w)``.

        Returns:
            The same shape.
        """
        return x + self.narrow(F.relu(self.widen(self.around(x))))


class LightEncoder(_StrideFour):
    """Image to features of stride 4 by few layers, most of them at a quarter of the resolution and none normalised.

    Centred as :class:`Encoder`. A feature sees 57 pixels a side of the image, there 51.

    Args:
        stem, trunk: channels at 1/2 and 1/4 of the image resolution.
        outputs: channels of the features.
        norm: ``"instance"`` for images standardised as a whole and beside them their local contrast, anything else for
            images as they are.
    """

    def __init__(self, stem: int, trunk: int, outputs: int, norm: str) -> None:
        super().__init__()
        self.standardised = norm == "instance"
        self.conv1 = nn.Conv2d(3 + self.standardised, stem, 5, stride=2, padding=2)
        self.down = nn.Conv2d(stem, trunk, 3, stride=2, padding=1)
        blocks = [WideBlock(trunk) for _ in range(3)]
        self.blocks = nn.Sequential(*blocks)
        self.conv2 = nn.Conv2d(trunk, outputs, 1)
        self._draw("fan_in")
        for block in blocks:  # nothing is normalised: blocks that begin as the identity keep the scale
            nn.init.zeros_(block.narrow.weight)
            if block.narrow.bias is not None:
                nn.init.zeros_(block.narrow.bias)

    def stem(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n s H2 W2"]:
        """Layer at half of the image resolution, see :meth:`Encoder.stem`."""
        if self.standardised:
            images = torch.cat([standardise_whole(images), local_contrast(images)], 1)
        return F.relu(self.conv1(images.to(self.conv1.weight.dtype)))

    def trunk(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n t h w"]:
        """See :meth:`_StrideFour.trunk`."""
        return self.blocks(F.relu(self.down(self.stem(images))))
