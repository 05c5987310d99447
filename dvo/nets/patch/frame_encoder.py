"""Encoder of the patch-flow network as a module of its own: images in, feature maps out."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.nets.patch.patchifier import Patchifier, normalise_images


class FrameEncoder(nn.Module):
    """Feature maps of single images, normalisation included; what :class:`dvo.nets.patch.patchifier.Patchifier`
    computes.

    Args:
        patchify: the encoders, whose parameters are shared.

    Attributes:
        names: of the outputs: ``matching``, ``context``.
    """

    def __init__(self, patchify: Patchifier) -> None:
        super().__init__()
        self.patchify = patchify
        self.names = ("matching", "context")

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> tuple[Tensor, ...]:
        """Encode images.

        Args:
            images: RGB in 0 to 255, uint8 or float; H and W multiples of 4.

        Returns:
            ``matching``, ``(n, C, H / 4, W / 4)``, compared by correlation; ``context``, ``(n, D, H / 4, W / 4)``, read
            at the centres of patches. Pixel ``(u, v)`` is centred on image pixel ``(4u, 4v)``.
        """
        features = self.patchify.encode(normalise_images(images)[None])
        shared, config = self.patchify.config.shared_encoder, self.patchify.config
        encoder = self.patchify.fnet if shared else self.patchify.inet
        weight, bias = encoder.head(slice(config.feature_channels if shared else 0, None))
        context = F.conv2d(features.trunk[0], weight[..., None, None], bias) / 4.0
        return features.matching[0], context
