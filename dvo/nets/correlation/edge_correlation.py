"""Correlation of the edges of a sliding window.

For tracking, where few edges of many frames are looked up once: no product is kept from one update to the next. Values
equal :func:`dvo.nets.correlation.correlation.correlate_reference`, up to the order of the channels.

Memory is read contiguously: the maps are stored with their channels last and padded with zeros by the width of a
window, so that a row of a window is one contiguous range at every position.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dvo.core.context import multiplies_bfloat16
from dvo.core.kernels import available, use_device_kernels, use_kernels

# Map slots that memory is reserved for at first, on a CPU and on other devices. On a CPU a page takes memory once it is
# written to: there they are as many as a window has, so that no frame waits for a copy of all maps.
FIRST_MAPS, FIRST_ON_DEVICE = 40, 8
_PIECE, _LARGE_PIECE = 32, 1024  # edges processed at once: in the cache of a processor; on other devices
_SPREAD = 4  # pixels between those of a patch, up to which they share one window of the map


class EdgeCorrelation:
    """Correlation of edges at one pyramid level.

    Args:
        scale: down-sampling of the level relative to the features.
        radius: correlation radius in pixels of the level.
        device: of the maps.
        dtype: of the maps, and of the channels; bfloat16 is for a CPU that multiplies it. Features are rounded as the
            maps are, and sums are float32. With uint8, pixels of maps and features are rounded to whole numbers and a
            scale (:func:`round_channels`), for a CPU that multiplies bytes; channels are then float32, or bfloat16
            where it multiplies that too.

    Attributes:
        maps: ``(N, H, W, C)`` features by map slot, each in a border of ``2 radius + 2`` zeros; others are not defined.
            Whole numbers are stored above 128, as ``(N, H, C / 4, W, 4)``.
        scales: ``(N, H, W)`` of the whole numbers, 0 in the border; empty for other types.

    Example:
        >>> level = EdgeCorrelation(scale=1, radius=3, device="cpu")
        >>> level.keep_map(0, torch.randn(32, 30, 40))
        >>> coords = torch.full((2, 3, 3, 2), 12.0)
        >>> kk, frames = torch.tensor([0, 1]), torch.tensor([0, 0])
        >>> level.lookup(coords, torch.randn(2, 9, 32), kk, frames).shape
        torch.Size([2, 441])
    """

    def __init__(
        self, scale: float, radius: int, device: torch.device | str, dtype: torch.dtype = torch.float32
    ) -> None:
        self.scale, self.radius = scale, radius
        self.maps = torch.zeros(0, 0, 0, 0, device=device, dtype=dtype)
        self.scales = torch.zeros(0, 0, 0, device=device)

    def keep_map(self, slot: int, level: Float[Tensor, "C h w"]) -> None:
        """Store the features of a frame; the storage grows with the largest slot, by doubling.

        Args:
            slot: map slot of the frame, assigned by the caller; its content is overwritten.
            level: features of the frame at this level.
        """
        c, h, w = level.shape
        have, border = len(self.maps), 2 * self.radius + 2
        if slot >= have:
            first = FIRST_MAPS if level.device.type == "cpu" else FIRST_ON_DEVICE
            height, width, of_bytes = h + 2 * border, w + 2 * border, self.maps.dtype == torch.uint8
            shape = (height, c // 4, width, 4) if of_bytes else (height, width, c)
            grown = self.maps.new_empty(max(slot + 1, 2 * have, first), *shape)
            if have:
                grown[:have] = self.maps
            self.maps = grown
            if of_bytes:
                more = self.scales.new_zeros(len(grown) - have, height, width)
                self.scales = torch.cat([self.scales, more]) if have else more
        rows, columns, of_level = slice(border, border + h), slice(border, border + w), level.permute(1, 2, 0)
        if self.maps.dtype == torch.uint8:
            fours, self.scales[slot, rows, columns], _ = _round_fours(of_level, above=128)
            self.maps[slot, rows, :, columns] = fours
            return
        self.maps[slot].zero_()
        self.maps[slot, rows, columns] = of_level

    def lookup(
        self,
        coords: Float[Tensor, "E p p 2"],
        features: Float[Tensor, "K q C"],
        kk: Int[Tensor, " E"],
        frames: Int[Tensor, " E"],
        numbers: Float[Tensor, "K q 2"] | None = None,
    ) -> Float[Tensor, "E c"]:
        """Correlation channels of this level.

        Args:
            coords: reprojected patch pixels ``x, y`` in feature pixels (of scale 1).
            features: of the ``q = p^2`` pixels of each patch, channels last.
            kk: patch of each edge.
            frames: map slot of the target frame of each edge.
            numbers: scale and total of features that are rounded already, if they are (:func:`round_channels`).

        Returns:
            ``c = p^2 * (2r+1)^2`` channels, ordered ``pixels_first``: patch row, patch column, y offset, x offset. NaN
            for a pixel whose position is not a number.
        """
        at = (coords.flatten(1, 2) / self.scale).contiguous()
        if self.maps.dtype == torch.uint8:
            return self._lookup_bytes(at, features, kk, frames, numbers).flatten(1)
        if self.maps.dtype == torch.bfloat16:
            return self._lookup_bfloat16(at, features, kk, frames).flatten(1)
        if use_kernels(self.maps, features, at):
            from dvo.nets.correlation.edge_correlation_kernels import correlate

            side = 2 * self.radius + 1
            out = at.new_empty(*at.shape[:2], side, side)
            correlate(
                self.maps.numpy(), features.contiguous().numpy(), at.numpy(), kk.numpy(), frames.numpy(), self.radius,
                out.numpy(),
            )  # fmt: skip
        elif use_device_kernels(self.maps, features, at):
            from dvo.nets.correlation import edge_correlation_triton

            out = edge_correlation_triton.correlate(self.maps, features, at, kk, frames, self.radius)
        else:
            out = correlate_edges(self.maps, features, at, kk, frames, self.radius)
        return out.flatten(1)

    def _lookup_bfloat16(self, at: Tensor, features: Tensor, kk: Tensor, frames: Tensor) -> Tensor:
        """Look-up in maps of bfloat16."""
        rounded = features.bfloat16()
        if use_kernels(rounded, half=True) and use_kernels(at) and multiplies_bfloat16(at.device):
            from dvo.core.compiled import compiles_bfloat16
            from dvo.nets.correlation.edge_correlation_kernels import correlate_bfloat16

            if compiles_bfloat16():
                side = 2 * self.radius + 1
                out = rounded.new_empty(*at.shape[:2], side, side)
                maps, bits, found = (x.contiguous().view(torch.uint16).numpy() for x in (self.maps, rounded, out))
                correlate_bfloat16(maps, bits, at.numpy(), kk.numpy(), frames.numpy(), self.radius, found)
                return out
        return correlate_edges(self.maps, rounded.float(), at, kk, frames, self.radius).bfloat16()

    def _lookup_bytes(self, at: Tensor, features: Tensor, kk: Tensor, frames: Tensor, numbers: Tensor | None) -> Tensor:
        """Look-up in maps of whole numbers."""
        if numbers is None:
            features, scale, total = round_channels(features)
            numbers = torch.stack([scale, total], -1)
        half = multiplies_bfloat16(at.device)
        if use_kernels(at) and fits_bytes(features.shape[-1], self.radius):
            from dvo.nets.correlation.edge_correlation_kernels import correlate_bytes

            side = 2 * self.radius + 1
            out = at.new_empty(*at.shape[:2], side, side, dtype=torch.bfloat16 if half else torch.float32)
            correlate_bytes(
                self.maps.numpy(), self.scales.numpy(), features.numpy(), numbers.numpy(), at.numpy(), kk.numpy(),
                frames.numpy(), self.radius, (out.view(torch.uint16) if half else out).numpy(),
            )  # fmt: skip
            return out
        maps = (self.maps.transpose(2, 3).flatten(3).float() - 128) * self.scales[..., None]
        found = correlate_edges(maps, features.float() * numbers[..., :1], at, kk, frames, self.radius)
        return found.bfloat16() if half else found


def round_channels(x: Float[Tensor, "h w C"], *, above: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Round the channels of pixels to whole numbers of -127 to 127, with a scale for each pixel.

    Args:
        x: the channels.
        above: what is added to the numbers.

    Returns:
        The numbers ``(h, w, C)``, uint8 if something is added and int8 otherwise; float32 ``(h, w)`` scales, NaN where
        a channel is not finite; and float32 ``(h, w)`` 128 times the sums of the numbers, without what is added.
    """
    if use_kernels(x) and x.shape[-1] % 4 == 0:
        fours, scale, total = _round_fours(x, above)
        return fours.transpose(1, 2).flatten(2), scale, total
    scale = x.abs().amax(-1) / 127
    finite = scale.isfinite()
    factor = torch.where(finite & (scale > 1e-30), 1 / scale, 0.0)[..., None]
    levels = torch.where(finite[..., None], (x * factor + 0.5).floor(), 0.0)
    kind = torch.uint8 if above else torch.int8
    return (levels + above).to(kind), torch.where(finite, scale, torch.nan), 128 * levels.sum(-1)


def _round_fours(x: Tensor, above: int) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`round_channels` with the numbers as maps have them, ``(h, C / 4, w, 4)``."""
    if not use_kernels(x):
        whole, scale, total = round_channels(x, above=above)
        return whole.unflatten(2, (-1, 4)).transpose(1, 2), scale, total
    from dvo.nets.correlation.edge_correlation_kernels import round_pixels

    height, width, channels = x.shape
    fours = x.new_empty(height, channels // 4, width, 4, dtype=torch.uint8 if above else torch.int8)
    scale, total = x.new_empty(2, height, width)
    channels_first = x.permute(2, 0, 1).contiguous().numpy()
    round_pixels(channels_first, above, fours.view(torch.uint8).numpy(), scale.numpy(), total.numpy())
    return fours, scale, total


def fits_bytes(channels: int, radius: int) -> bool:
    """Tell if there is a kernel for maps of whole numbers, and this CPU has its instructions.

    Args:
        channels: of the features.
        radius: of the windows.
    """
    if not available():
        return False
    from dvo.core.compiled import compiles_int8

    return compiles_int8() and radius == 3 and channels % 4 == 0


def fits_bfloat16(channels: int) -> bool:
    """Tell if features are looked up faster in bfloat16: channels are multiplied 16 at once.

    Args:
        channels: of the features.
    """
    return channels % 16 == 0


def correlate_edges(
    maps: Float[Tensor, "N H W C"],
    features: Float[Tensor, "K q C"],
    at: Float[Tensor, "E q 2"],
    kk: Int[Tensor, " E"],
    frames: Int[Tensor, " E"],
    radius: int,
) -> Float[Tensor, "E q s s"]:
    """Twin of the kernel: look up edges at one level.

    Args:
        maps: padded, see :class:`EdgeCorrelation`; of any type.
        features, kk, frames: see :meth:`EdgeCorrelation.lookup`.
        at: ``x, y`` in pixels of the level.
        radius: ``r``, pixels of the level.

    Returns:
        Correlation over ``s = 2r + 1`` y offsets and x offsets.
    """
    taps = 2 * radius + 2
    (_, height, width, c), (e, q) = maps.shape, at.shape[:2]
    out = at.new_empty(e, q, taps - 1, taps - 1)
    if not e:
        return out
    # A window beyond the border contains only zeros, at any position.
    limit = _pair(at, width - 2 * taps, height - 2 * taps)
    position = (at - radius).clamp(min=-taps).minimum(limit)
    base = position.floor()
    fx, fy = (position - base)[..., None, None, :].unbind(-1)
    corner = base.nan_to_num(-taps).long() + taps
    low = corner.amin(1)
    spread = (corner - low[:, None]).flatten(1).amax(1)
    side = taps + min(int(spread.max()), _SPREAD)
    # The pixels of a patch share the products with one window of the map, which is moved inwards at the far border.
    origin = low.minimum(_pair(low, width - side, height - side))
    inner = (corner - origin[:, None]).clamp(max=side - taps)
    first = (frames * height + origin[:, 1]) * width + origin[:, 0]
    rows = torch.arange(side, device=at.device)
    pixels, steps = torch.arange(q, device=at.device), rows[:taps] * side
    runs = maps.as_strided((maps.numel() // c - side + 1, side * c), (c, 1))
    piece = _PIECE if at.device.type == "cpu" else _LARGE_PIECE
    for edges in torch.arange(e, device=at.device).split(piece):
        window = runs.index_select(0, (first[edges, None] + rows * width).flatten()).view(-1, side * side, c)
        window = window.to(features.dtype)
        products = torch.bmm(features[kk[edges]], window.mT)
        row = torch.arange(len(edges), device=at.device)[:, None] * q + pixels
        start = (row * side + inner[edges, :, 1]) * side + inner[edges, :, 0]
        lines = products.as_strided((products.numel() - taps + 1, taps), (1, 1))
        values = lines.index_select(0, (start[..., None] + steps).flatten()).view(-1, q, taps, taps)
        blended = torch.lerp(values[..., :-1, :], values[..., 1:, :], fy[edges])
        out[edges] = torch.lerp(blended[..., :-1], blended[..., 1:], fx[edges])
    wide = (spread > _SPREAD).nonzero()[:, 0]
    if q > 1 and len(wide):  # pixels too far from each other are looked up one by one
        single = (kk[wide, None] * q + pixels).flatten()
        alone = at[wide].view(-1, 1, 2)
        found = correlate_edges(
            maps, features.reshape(-1, 1, c), alone, single, frames[wide].repeat_interleave(q), radius
        )
        out[wide] = found.view(-1, q, taps - 1, taps - 1)
    return out


def _pair(like: Tensor, x: int, y: int) -> Tensor:
    """``(2,)`` numbers, filled in on the device: a copy from the CPU would wait for it."""
    return torch.cat((like.new_full((1,), x), like.new_full((1,), y)))
