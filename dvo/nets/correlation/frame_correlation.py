"""Correlation of every pixel of a frame with every pixel of another one, looked up around moving positions.

:class:`dvo.nets.correlation.correlation.CorrelationVolume` does this for all pairs of frames of a clip, with gradients.
For tracking, :class:`PairVolume` holds the products of one pair, so that memory grows with the edges and not with the
square of the frames; values equal :func:`dvo.nets.correlation.correlation.correlate_reference`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dvo.nets.correlation.correlation import axis_taps
from dvo.nets.patch.patchifier import pool_levels


class PairVolume:
    """Products of all pixels of two feature maps, by pyramid level.

    A row of a look-up is contiguous in memory. Where it reaches over the border of a map it reads what lies beside it,
    with weight zero; the buffers have a margin for that.

    Args:
        source: features whose pixels are looked up.
        target: features of the other frame.
        pyramid: down-sampling of each level relative to ``target``.
        radius: correlation radius in pixels of each level.

    Example:
        >>> volume = PairVolume(torch.randn(16, 6, 8), torch.randn(16, 6, 8), (1, 2), 3)
        >>> volume(torch.zeros(6, 8, 2)).shape
        torch.Size([98, 6, 8])
    """

    def __init__(
        self,
        source: Float[Tensor, "C h w"],
        target: Float[Tensor, "C h w"],
        pyramid: tuple[int, ...],
        radius: int,
    ) -> None:
        self.radius, self.pyramid = radius, pyramid
        self.height, self.width = source.shape[-2:]
        self._margin = 2 * radius + 2
        rows = source.flatten(1).mT.contiguous()
        self._levels = []
        for level in pool_levels(target[None, None], pyramid):
            h, w = level.shape[-2:]
            buffer = source.new_zeros(len(rows) * h * w + 2 * self._margin)
            torch.mm(rows, level.flatten(3)[0, 0], out=buffer[self._margin : -self._margin].view(len(rows), h * w))
            self._levels.append((buffer, h, w))

    def __call__(self, coords: Float[Tensor, "h w 2"]) -> Float[Tensor, "c h w"]:
        """Correlation channels of every pixel of the source frame.

        Args:
            coords: positions ``x, y`` in the target frame, feature pixels.

        Returns:
            ``c = levels (2r+1)^2`` channels: level slowest, then x offset, then y offset.
        """
        pixels, taps = self.height * self.width, self._margin
        first = torch.arange(pixels, device=coords.device)
        found = []
        for (buffer, h, w), scale in zip(self._levels, self.pyramid, strict=True):
            at = (coords / scale).reshape(pixels, 2)
            _, ax, bx = axis_taps(at[:, 0], w, self.radius)
            iy, ay, by = axis_taps(at[:, 1], h, self.radius)
            # A run that begins farther out than this has no tap in the map.
            left = (at[:, 0].clamp(-2.0 * taps, w + 2.0 * taps).floor().long() - self.radius).clamp(-taps, w)
            start = (first[:, None] * h + iy) * w + left[:, None] + self._margin
            runs = buffer.as_strided((len(buffer) - taps + 1, taps), (1, 1))
            values = runs.index_select(0, start.flatten()).view(pixels, taps * taps)
            values = values.mT.contiguous().view(taps, taps, pixels)  # pixels last: long vectors for what follows
            ax, bx, ay, by = (weight.mT.contiguous() for weight in (ax, bx, ay, by))
            rows = torch.addcmul(values[:-1] * ay[:, None], values[1:], by[:, None])
            out = torch.addcmul(rows[:, :-1] * ax, rows[:, 1:], bx)
            found.append(out.transpose(0, 1).reshape(-1, self.height, self.width))
        return torch.cat(found)
