"""PWC-Net with dense connections (Sun et al., CVPR 2018), the matching network of TartanVO as it was published.

Names and shapes of the tensors are those of the published code (github.com/castacks/tartanvo, ``Network/PWC``), so that
its checkpoint fits. It works as :class:`dvo.nets.two_frame.flow_pyramid.MatchingNetwork` does, with six levels, five of
which are correlated, and learned doubling of the flow.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.nets.correlation.local_correlation import local_correlation, warp
from dvo.nets.two_frame.flow_pyramid import Flows, initialise

FLOW_UNIT = 20.0
"""Image pixels to a unit of the decoders' output."""

RADIUS = 4
"""Largest displacement of the correlation, feature pixels of each level."""

_CHANNELS = (16, 32, 64, 96, 128, 196)  # of the levels of stride 2, 4, ... 64
_WIDTHS = (128, 128, 96, 64, 32)  # of the dense layers of each decoder
_CONTEXT = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))  # channels and dilations of the last layers
_FINEST, _COARSEST = 2, 6  # levels that are correlated; level k has the stride 2^k
_INSIDE = 0.9999  # least share of a fetched pixel that lies within the map


class PWCNet(nn.Module):
    """Flow between two images at a quarter of the resolution, in five levels from coarse to fine.

    Sides that are no multiples of 64 pixels are allowed; the published code takes multiples alone.
    """

    def __init__(self) -> None:
        super().__init__()
        for level, (a, b) in enumerate(pairwise((3, *_CHANNELS)), start=1):
            for part, inputs, stride in zip(_parts(level), (a, b, b), (2, 1, 1), strict=True):
                self.add_module(f"conv{level}{part}", _layer(inputs, b, stride=stride))
        correlated = (2 * RADIUS + 1) ** 2
        for level in range(_COARSEST, _FINEST - 1, -1):
            inputs = correlated if level == _COARSEST else correlated + _CHANNELS[level - 1] + 4
            for number, width in enumerate(_WIDTHS):
                self.add_module(f"conv{level}_{number}", _layer(inputs, width))
                inputs += width
            self.add_module(f"predict_flow{level}", nn.Conv2d(inputs, 2, 3, padding=1))
            self.add_module(f"deconv{level}", nn.ConvTranspose2d(2, 2, 4, stride=2, padding=1))
            if level > _FINEST:
                self.add_module(f"upfeat{level}", nn.ConvTranspose2d(inputs, 2, 4, stride=2, padding=1))
        for number, (width, dilation) in enumerate(_CONTEXT, start=1):
            self.add_module(f"dc_conv{number}", _layer(inputs, width, dilation=dilation))
            inputs = width
        self.dc_conv7 = nn.Conv2d(inputs, 2, 3, padding=1)
        # The finest level of the published code has a layer for doubling its flow, which is not used.
        self.get_submodule(f"deconv{_FINEST}").requires_grad_(False)
        initialise(self)

    def normalise(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 H W"]:
        """Scale images to the range of the published code, [0, 1].

        Args:
            images: RGB, uint8 or float in [0, 255].

        Returns:
            Float images.
        """
        return images.float() / 255.0

    def encode(self, images: Float[Tensor, "n 3 H W"]) -> list[Tensor]:
        """Encode images.

        Args:
            images: output of :meth:`normalise`.

        Returns:
            Features ``(n, c, h, w)`` of strides 4, 8, ... 64, from fine to coarse.
        """
        x, found = images, []
        for level in range(1, _COARSEST + 1):
            for part in _parts(level):
                x = self.get_submodule(f"conv{level}{part}")(x)
            found.append(x)
        return found[_FINEST - 1 :]

    def match(self, first: list[Tensor], second: list[Tensor]) -> Flows:
        """Flow between images.

        Args:
            first, second: features of :meth:`encode` of the two images of each pair.

        Returns:
            Flows from the first image to the second.
        """
        levels: list[Tensor] = []
        flow, x = first[-1].new_zeros(0), first[-1].new_zeros(0)
        for level in range(_COARSEST, _FINEST - 1, -1):
            a, b = first[level - _FINEST], second[level - _FINEST]
            extra: list[Tensor] = []
            if level < _COARSEST:
                coarse = flow
                h, w = a.shape[-2:]
                flow = self.get_submodule(f"deconv{level + 1}")(coarse)[..., :h, :w]
                extra = [a, flow, self.get_submodule(f"upfeat{level + 1}")(x)[..., :h, :w]]
                b = warp_inside(b, flow * (FLOW_UNIT / 2**level)).to(a)
            # The published correlation is a mean over the channels.
            correlation = local_correlation(a, b, RADIUS) / a.shape[1] ** 0.5
            x = torch.cat([F.leaky_relu(correlation, 0.1), *extra], 1)
            for number in range(len(_WIDTHS)):
                x = torch.cat([self.get_submodule(f"conv{level}_{number}")(x), x], 1)
            flow = self.get_submodule(f"predict_flow{level}")(x)
            levels.append(flow.float() * (FLOW_UNIT / 2**level))
        for number in range(1, len(_CONTEXT) + 1):
            x = self.get_submodule(f"dc_conv{number}")(x)
        refined = (flow + self.dc_conv7(x)).float() * (FLOW_UNIT / 2**_FINEST)
        return Flows((*levels[:-1], refined), levels[-1])


def warp_inside(features: Float[Tensor, "B C h w"], flow: Float[Tensor, "B 2 h w"]) -> Float[Tensor, "B C h w"]:
    """Fetch features from where a flow points to, zero wherever that is not wholly within the map.

    Args:
        features: of the second image.
        flow: from the first image to the second, feature pixels.

    Returns:
        :func:`dvo.nets.correlation.local_correlation.warp` of the features, without the pixels at the border that it
        fades out.
    """
    inside = warp(torch.ones_like(features[:, :1]), flow.detach()) >= _INSIDE
    return warp(features, flow) * inside


def _parts(level: int) -> tuple[str, str, str]:
    """Names of the three layers of a level of the encoder, in their order, which differs in the coarsest level."""
    return ("aa", "a", "b") if level == _COARSEST else ("a", "aa", "b")


def _layer(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation), nn.LeakyReLU(0.1)
    )
