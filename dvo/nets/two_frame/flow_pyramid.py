"""Matching network of two-frame odometry: optical flow at a quarter of the resolution, from coarse to fine.

A small relative of PWC-Net (Sun et al., CVPR 2018), which TartanVO uses, with the encoder of RAFT (Teed, Deng, ECCV
2020): at each level the features of the second image are fetched where the flow of the coarser level points to and
correlated with those of the first one over a square of displacements; a decoder then revises the flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.nets.correlation.local_correlation import double, local_correlation, warp
from dvo.nets.patch.encoder import ResidualBlock
from dvo.nets.patch.patchifier import normalise_images

STRIDE = 4
"""Image pixels to a pixel of the finest level; feature ``(u, v)`` is centred on image pixel ``(4u, 4v)``."""


@dataclass(frozen=True)
class Flows:
    """Output of the decoders for pairs of images.

    Attributes:
        levels: flows from the first image to the second, from coarse to fine, each ``(B, 2, h, w)`` in feature pixels
            of its own level; the last one, at a quarter of the resolution, is refined.
        coarse: the flow of the finest level before the refinement.
    """

    levels: tuple[Tensor, ...]
    coarse: Tensor

    @property
    def flow(self) -> Tensor:
        """Flow at a quarter of the resolution, ``(B, 2, h, w)`` feature pixels."""
        return self.levels[-1]


class PyramidEncoder(nn.Module):
    """Image to features of stride 4, 8, 16, ...

    All convolutions are centred: pixel ``u`` of a level lies on pixel ``2 u`` of the finer one.

    Args:
        stem: channels at half of the resolution.
        channels: features of each level, from stride 4 on.
    """

    def __init__(self, stem: int, channels: tuple[int, ...]) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, stem, 7, stride=2, padding=3)
        self.norm1 = nn.InstanceNorm2d(stem)
        sizes = (stem, *channels)
        self.levels = nn.ModuleList(
            ResidualBlock(a, b, 2, "instance" if number == 0 else "none")
            for number, (a, b) in enumerate(zip(sizes, sizes[1:], strict=False))
        )
        self.heads = nn.ModuleList(nn.Conv2d(c, c, 1) for c in channels)
        initialise(self)

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> list[Tensor]:
        """Encode images.

        Args:
            images: normalised images.

        Returns:
            Features ``(n, c, h, w)`` of each level, from fine to coarse; their mean square is one at each pixel, so
            that a correlation tells how alike two pixels are and not how strong they are.
        """
        x = F.relu(self.norm1(self.conv1(images)))
        found = []
        for block, head in zip(self.levels, self.heads, strict=True):
            x = block(x)
            features = head(x)
            found.append(F.normalize(features, dim=1, eps=1e-3) * features.shape[1] ** 0.5)
        return found


class FlowDecoder(nn.Module):
    """Revision of the flow of a level from its correlation and the features of the first image.

    Args:
        inputs: channels of correlation, features and flow together.
        width: channels of the layers.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.conv3 = nn.Conv2d(width, width, 3, padding=1)
        self.flow = nn.Conv2d(width, 2, 3, padding=1)
        initialise(self)
        with torch.no_grad():
            self.flow.weight.mul_(0.1)  # an untrained network answers near zero

    def forward(self, x: Float[Tensor, "B i h w"]) -> tuple[Tensor, Tensor]:
        """Revise a flow.

        Args:
            x: correlation, features and flow.

        Returns:
            Change of the flow ``(B, 2, h, w)``, feature pixels, and hidden features ``(B, width, h, w)``.
        """
        x = F.leaky_relu(self.conv1(x), 0.1)
        x = F.leaky_relu(self.conv2(x), 0.1)
        x = F.leaky_relu(self.conv3(x), 0.1)
        return self.flow(x), x


class FlowRefiner(nn.Module):
    """Change of the finest flow from a wide neighbourhood, by dilated convolutions (PWC-Net's context network).

    Args:
        inputs: channels of hidden features and flow together.
        width: channels of the layers.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        sizes, dilations = (inputs, width, width, width), (1, 2, 4)
        self.layers = nn.ModuleList(
            nn.Conv2d(a, b, 3, padding=d, dilation=d)
            for a, b, d in zip(sizes, sizes[1:], dilations, strict=False)
        )  # fmt: skip
        self.flow = nn.Conv2d(width, 2, 3, padding=1)
        initialise(self)
        with torch.no_grad():
            self.flow.weight.mul_(0.1)  # an untrained network answers near zero

    def forward(self, x: Float[Tensor, "B i h w"]) -> Float[Tensor, "B 2 h w"]:
        """Compute the change of a flow.

        Args:
            x: hidden features and flow.

        Returns:
            Feature pixels.
        """
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.1)
        return self.flow(x)


class MatchingNetwork(nn.Module):
    """Flow between two images from their features, from coarse to fine.

    Args:
        stem: channels at half of the resolution.
        channels: features of each level, from stride 4 on.
        radius: of the correlation, in feature pixels of each level; the coarsest level alone reaches
            ``radius * 4 * 2^(levels - 1)`` image pixels.
        width: channels of the decoders.
    """

    def __init__(self, stem: int, channels: tuple[int, ...], radius: int, width: int) -> None:
        super().__init__()
        self.radius = radius
        self.encoder = PyramidEncoder(stem, channels)
        side = (2 * radius + 1) ** 2
        self.decoders = nn.ModuleList(FlowDecoder(side + c + 2, width) for c in channels)
        self.refiner = FlowRefiner(width + 2, width)

    def normalise(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 H W"]:
        """Images in the range of the encoder, see :func:`dvo.nets.patch.patchifier.normalise_images`."""
        return normalise_images(images)

    def encode(self, images: Float[Tensor, "n 3 H W"]) -> list[Tensor]:
        """Features of normalised images, see :class:`PyramidEncoder`."""
        return self.encoder(images)

    def match(self, first: list[Tensor], second: list[Tensor]) -> Flows:
        """Flow between images.

        Args:
            first, second: features of :meth:`encode` of the two images of each pair, from fine to coarse.

        Returns:
            Flows from the first image to the second.
        """
        flow = torch.zeros_like(first[-1][:, :2], dtype=torch.float32)
        levels: list[Tensor] = []
        hidden = flow
        for number in reversed(range(len(first))):
            a, b = first[number], second[number]
            if levels:
                # Each level is trained by its own loss: no gradient through the places where it looks.
                flow = double(flow, *a.shape[-2:]).detach()
            moved = warp(b, flow) if levels else b
            correlation = local_correlation(a, moved.to(a), self.radius)
            x = torch.cat([F.leaky_relu(correlation, 0.1), a, flow.to(a)], 1)
            change, hidden = self.decoders[number](x)
            flow = flow + change.float()
            levels.append(flow)
        refined = flow + self.refiner(torch.cat([hidden, flow.to(hidden)], 1)).float()
        return Flows((*levels[:-1], refined), flow)


def initialise(module: nn.Module) -> None:
    """Draw the weights of all convolutions and linear layers of a module for rectified activations (He et al., 2015).

    Args:
        module: changed in place; biases become zero.
    """
    for part in module.modules():
        if isinstance(part, nn.Conv2d | nn.Linear):
            nn.init.kaiming_normal_(part.weight, mode="fan_in", nonlinearity="relu")
            if part.bias is not None:
                nn.init.zeros_(part.bias)
