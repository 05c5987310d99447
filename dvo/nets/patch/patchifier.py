"""Patches: their matching and context features (DPVO 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.nets.patch.config import ModelConfig
from dvo.nets.patch.encoder import Encoder, LightEncoder

ENCODERS: dict[str, type[Encoder] | type[LightEncoder]] = {"residual": Encoder, "light": LightEncoder}
"""Encoders by their names in :class:`dvo.nets.patch.config.ModelConfig`."""


@dataclass(frozen=True)
class Features:
    """Output of the encoders for a batch of clips.

    Attributes:
        matching: ``(B, N, C, h, w)`` features for correlation.
        trunk: ``(B, N, t, h, w)`` trunk features, from which context features are computed at the patch centres alone.
    """

    matching: Tensor
    trunk: Tensor


def normalise_images(images: Tensor) -> Tensor:
    """Scale images to the input range of the encoders, [-0.5, 1.5], as DPVO does.

    Args:
        images: ``(..., 3, H, W)`` RGB, uint8 or float in [0, 255].

    Returns:
        Float tensor of the same shape.
    """
    return images.float() * (2.0 / 255.0) - 0.5


def crop_patches(
    maps: Float[Tensor, "B N C h w"], centres: Tensor, size: int, spacing: int = 1
) -> Float[Tensor, "B N M C p p"]:
    """Cut square windows out of feature maps.

    Args:
        maps: feature maps.
        centres: ``(B, N, M, 2)`` integer centres ``x, y`` in feature pixels; the windows must lie inside the map.
        size: side ``p`` of a window, odd.
        spacing: of the pixels of a window.

    Returns:
        The windows.
    """
    b, n, c, h, w = maps.shape
    m = centres.shape[2]
    offsets = spacing * (torch.arange(size, device=maps.device) - size // 2)
    x = centres[..., 0, None, None] + offsets
    y = centres[..., 1, None, None] + offsets[:, None]
    index = (y * w + x).reshape(b, n, 1, m * size * size).expand(-1, -1, c, -1)
    patches = maps.reshape(b, n, c, h * w).gather(3, index)
    return patches.reshape(b, n, c, m, size, size).permute(0, 1, 3, 2, 4, 5)


class Patchifier(nn.Module):
    """Encoders and the extraction of patches.

    Args:
        config: sizes of the network.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        extra = config.hidden_channels if config.shared_encoder else 0
        encoder = ENCODERS[config.encoder]
        sizes = (config.stem_channels, config.trunk_channels)
        self.fnet = encoder(*sizes, config.feature_channels + extra, "instance")
        if not config.shared_encoder:
            self.inet = encoder(*sizes, config.hidden_channels, "none")

    def encode(self, images: Float[Tensor, "B N 3 H W"]) -> Features:
        """Encode normalised images; matching features are divided by 4 as in DPVO.

        Args:
            images: output of :func:`normalise_images`.

        Returns:
            Matching and trunk features at a quarter of the image resolution.
        """
        b, n = images.shape[:2]
        flat = images.flatten(0, 1)
        trunk = self.fnet.trunk(flat)
        weight, bias = self.fnet.head(slice(self.config.feature_channels))
        matching = torch.matmul(weight / 4.0, trunk.flatten(2)) + (bias / 4.0)[:, None]
        matching = matching.unflatten(2, trunk.shape[-2:]).to(images.dtype)
        if not self.config.shared_encoder:
            trunk = self.inet.trunk(flat)
        return Features(matching.unflatten(0, (b, n)), trunk.unflatten(0, (b, n)))

    def cut(self, features: Features, centres: Tensor) -> tuple[Tensor, Tensor]:
        """Matching and context features of patches.

        Args:
            features: output of :meth:`encode`.
            centres: ``(B, N, M, 2)`` see :mod:`dvo.nets.patch.selection`.

        Returns:
            ``(B, N*M, C, p, p)`` matching features and ``(B, N*M, D)`` context at the patch centres, divided by 4.
        """
        matching = crop_patches(features.matching, centres, self.config.patch_size).flatten(1, 2)
        trunk = crop_patches(features.trunk, centres, 1).flatten(1, 2).flatten(2)
        if self.config.shared_encoder:
            weight, bias = self.fnet.head(slice(self.config.feature_channels, None))
        else:
            weight, bias = self.inet.head(slice(None))
        return matching, F.linear(trunk, weight, bias).to(matching.dtype) / 4.0


def patch_coordinates(centres: Tensor, inverse_depth: Tensor, size: int) -> Float[Tensor, "B K 3 p p"]:
    """Patch tensors ``x, y, d`` of constant inverse depth.

    Args:
        centres: ``(B, N, M, 2)`` integer centres ``x, y`` in feature pixels.
        inverse_depth: ``(B, N*M)``.
        size: side ``p`` of a patch, odd.

    Returns:
        Pixel coordinates and inverse depth of each patch pixel, ``K = N*M`` patches.
    """
    centres = centres.flatten(1, 2).to(inverse_depth.dtype)
    offsets = torch.arange(size, device=centres.device, dtype=centres.dtype) - size // 2
    x = (centres[..., 0, None, None] + offsets).expand(-1, -1, size, size)
    y = (centres[..., 1, None, None] + offsets[:, None]).expand(-1, -1, size, size)
    return torch.stack([x, y, inverse_depth[..., None, None].expand_as(x)], dim=2)


def pool_levels(matching: Tensor, pyramid: tuple[int, ...]) -> list[Tensor]:
    """Average-pooled feature pyramid.

    Args:
        matching: ``(B, N, C, h, w)`` matching features.
        pyramid: down-sampling ``s`` of each level.

    Returns:
        One tensor ``(B, N, C, h / s, w / s)`` for each level; that of ``s = 1`` is the input itself.
    """
    b, n = matching.shape[:2]
    flat = matching.flatten(0, 1)
    return [matching if s == 1 else F.avg_pool2d(flat, s, s).unflatten(0, (b, n)) for s in pyramid]
