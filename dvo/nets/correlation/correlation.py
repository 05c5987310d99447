"""Correlation of patches with neighbourhoods of feature maps (DPVO 3.2).

For each edge and each of the ``p * p`` patch pixels, at its reprojected position: dot products of the pixel's feature
with the ``(2r + 2)^2`` nearest map features, bilinearly blended to ``(2r + 1)^2``; zero outside the map.

Three implementations give the same values:

- :func:`correlate_reference`, the specification: bilinear sampling of the features, then dot products.
- :class:`CorrelationVolume`: all products of a clip as one matrix product, then cheap look-ups; or, of large maps on a
  CPU, products with the windows that are looked up, and no others, by a kernel. For training.
- :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation`: products with one window of features an edge. For
  tracking, where the volume would not fit.

An update operator receives them as :class:`Correlation`, which states the order of the channels. Positions receive no
gradient, as in RAFT.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dvo.core.context import full_precision
from dvo.core.errors import DvoError
from dvo.core.kernels import use_kernels
from dvo.map.edges import PatchGraph
from dvo.nets.patch.patchifier import pool_levels

ChannelOrder = Literal["offsets_first", "pixels_first"]
"""``offsets_first``: x offset slowest, then y offset, patch row, patch column, as DPVO's weights expect.
``pixels_first``: patch row slowest, then patch column, y offset, x offset, which is the fastest order to read from
memory."""


@dataclass(frozen=True)
class Correlation:
    """Correlation channels of a set of edges.

    Attributes:
        levels: ``(B, E, (2r+1)^2 * p^2)`` a level of the pyramid. DPVO interleaves the levels (level fastest);
            :class:`dvo.nets.update.update.Update` undoes that on the weights of its first layer rather than on every
            edge.
        order: order of the channels of a level.
        learn: see :meth:`CorrelationVolume.lookup`; the others need no gradient.
    """

    levels: list[Tensor]
    order: ChannelOrder = "offsets_first"
    learn: Tensor | None = None


class CorrelationLookup(Protocol):
    """Interface of a correlation look-up: edges of a graph at given positions to correlation channels.

    The part of a step that differs between the training loop and the tracker.
    """

    def __call__(self, coords: Float[Tensor, "B E p p 2"], graph: PatchGraph) -> Correlation:
        """Look up the correlation.

        Args:
            coords: reprojected patch pixels ``x, y`` in feature pixels.
            graph: the ``E`` edges.

        Returns:
            Channels of every edge, by pyramid level.
        """
        ...


def correlate_reference(
    patches: Float[Tensor, "B K C p p"],
    maps: Float[Tensor, "B N C h w"],
    coords: Float[Tensor, "B E p p 2"],
    kk: Int[Tensor, " E"],
    jj: Int[Tensor, " E"],
    pyramid: tuple[int, ...] = (1, 4),
    radius: int = 3,
) -> list[Tensor]:
    """Reference implementation: plain, slow and with a large memory footprint.

    Args:
        patches: matching features of the patches.
        maps: matching features of the frames.
        coords: reprojected patch pixels ``x, y`` in feature pixels.
        kk, jj: patch and target frame of each edge.
        pyramid: down-sampling of each level relative to ``maps``.
        radius: correlation radius in pixels of each level.

    Returns:
        One tensor ``(B, E, (2r+1)^2 * p^2)`` for each level, channels in the order ``offsets_first``.
    """
    b, e, p = coords.shape[:3]
    steps = torch.arange(-radius, radius + 1, device=coords.device, dtype=coords.dtype)
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1)  # (x_off, y_off, 2)
    levels = []
    for level, scale in zip(pool_levels(maps, pyramid), pyramid, strict=True):
        h, w = level.shape[-2:]
        at = coords.detach()[:, :, None, None] / scale + offsets[:, :, None, None, :]  # b e X Y p p 2
        grid = torch.stack([2 * at[..., 0] / max(w - 1, 1) - 1, 2 * at[..., 1] / max(h - 1, 1) - 1], dim=-1)
        target = level[:, jj].flatten(0, 1)
        sampled = F.grid_sample(target, grid.reshape(b * e, 1, -1, 2), align_corners=True)
        sampled = sampled.reshape(b, e, -1, *at.shape[2:6])
        levels.append(torch.einsum("becxypq,becpq->bexypq", sampled, patches[:, kk]).flatten(2))
    return levels


def axis_taps(position: Tensor, size: int, radius: int) -> tuple[Tensor, Tensor, Tensor]:
    """Indices and bilinear weights of a look-up along one axis.

    Args:
        position: ``(...,)`` sub-pixel position.
        size: number of pixels along the axis.
        radius: correlation radius ``r``.

    Returns:
        ``(..., 2r+2)`` int64 indices clamped to the axis, and the weights ``(..., 2r+1)`` of the lower and the upper
        neighbour of each tap; a neighbour outside ``[0, size)`` has weight 0, so its clamped index does not contribute.
    """
    # Far-away projections would overflow the integers; they are out of the map either way.
    position = position.clamp(-4.0 * radius - 8, size + 4.0 * radius + 8)
    base = position.floor()
    fraction = (position - base)[..., None]
    taps = torch.arange(-radius, radius + 2, device=position.device)
    index = base.long()[..., None] + taps
    inside = ((index >= 0) & (index < size)).to(position.dtype)
    return index.clamp(0, size - 1), (1 - fraction) * inside[..., :-1], fraction * inside[..., 1:]


@dataclass(frozen=True)
class _Taps:
    """Cells of a volume and bilinear weights, ``(edges, x taps, y taps, pixels)`` or of length one along an axis."""

    index: Tensor
    ax: Tensor
    bx: Tensor
    ay: Tensor
    by: Tensor

    @classmethod
    def at(cls, position: Tensor, start: Tensor, size: tuple[int, int], radius: int) -> _Taps:
        """Taps at ``position (edges, pixels, 2)`` in the slices of a volume that begin at ``start (edges, pixels)``."""
        h, w = size
        ix, ax, bx = axis_taps(position[..., 0], w, radius)
        iy, ay, by = axis_taps(position[..., 1], h, radius)
        # (edges, pixels, taps) -> (edges, x taps, y taps, pixels), the order of DPVO's channels
        ix, ax, bx = (t.mT.contiguous()[:, :, None, :] for t in (ix, ax, bx))
        iy, ay, by = (t.mT.contiguous()[:, None, :, :] for t in (iy * w + start[..., None], ay, by))
        return cls(ix + iy, ax, bx, ay, by)

    def add_gradient(self, grad: Tensor, store: dict[str, Tensor], length: int) -> None:
        """Add the gradient of a look-up to that of the volume, which has ``length`` cells."""
        rows = F.pad(grad * self.ax, (0, 0, 0, 0, 0, 1)) + F.pad(grad * self.bx, (0, 0, 0, 0, 1, 0))
        values = F.pad(rows * self.ay, (0, 0, 0, 1)) + F.pad(rows * self.by, (0, 0, 1, 0))
        if "volume" not in store:
            store["volume"] = values.new_zeros(length)
        store["volume"].index_add_(0, self.index.flatten(), values.flatten())


def _as_columns(level: Tensor) -> Tensor:
    """Maps ``(B, N, C, h, w)`` as ``(B, C, N h w)``."""
    return level.permute(0, 2, 1, 3, 4).reshape(level.shape[0], level.shape[2], -1)


class _Source(torch.autograd.Function):
    """What look-ups take their products from: features ``(B, K, q, C)`` of patch pixels and maps ``(B, N, C, h, w)``.

    A dense gradient for every look-up would be as large as the volume. Instead each look-up accumulates its gradient
    in one buffer and returns a scalar token to autograd, which calls this backward after all look-ups.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, level: Tensor, store: dict[str, Tensor]) -> Tensor:
        ctx.save_for_backward(features, level)
        ctx.store = store
        return features.new_zeros(())

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        features, level = ctx.saved_tensors
        store = ctx.store
        by_features, by_level = store.pop("features", None), store.pop("maps", None)
        if by_features is not None and by_level is not None:
            by_features, border = by_features.view(features.shape), (by_level.shape[1] - level.shape[-2]) // 2
            inner = by_level[:, border : border + level.shape[-2], border : border + level.shape[-1]]
            by_level = inner.permute(0, 3, 1, 2).reshape(level.shape)
        grad = store.pop("volume", None)
        if grad is not None:
            rows, columns = features.flatten(1, 2), _as_columns(level)
            grad = grad.view(*rows.shape[:2], columns.shape[-1])
            by_rows, by_columns = torch.matmul(grad, columns.mT), torch.matmul(rows.mT, grad)
            b, n, c, h, w = level.shape
            more = by_rows.view(features.shape), by_columns.view(b, c, n, h, w).transpose(1, 2)
            by_features = more[0] if by_features is None else by_features + more[0]
            by_level = more[1] if by_level is None else by_level + more[1]
        return by_features, by_level, None


@dataclass(frozen=True)
class _Place:
    """Where a look-up reads.

    Attributes:
        position: ``(edges, pixels, 2)`` in pixels of the level.
        start: ``(edges, pixels)`` beginnings of slices of the volume.
        patch, frame: ``(edges,)`` over the batch.
        learn: edges that propagate a gradient, None for all.
    """

    position: Tensor
    start: Tensor
    patch: Tensor
    frame: Tensor
    learn: Tensor | None

    def tensors(self) -> tuple[Tensor | None, ...]:
        """All of them, in this order."""
        return self.position, self.start, self.patch, self.frame, self.learn

    def edges(self) -> Any:
        """``learn`` for kernels."""
        return (torch.arange(len(self.position)) if self.learn is None else self.learn).numpy()


class _Lookup(torch.autograd.Function):
    """Bilinear look-up of windows, see :class:`CorrelationVolume`: ``(edges, x offset, y offset, pixels)``."""

    @staticmethod
    def forward(ctx: Any, token: Tensor, level: _Level, radius: int, *tensors: Tensor | None) -> Tensor:
        place = _Place(*tensors)  # type: ignore[arg-type]
        ctx.level, ctx.radius = level, radius
        ctx.save_for_backward(*tensors)
        volume = level.volume
        if level.kernels:
            return _by_kernel(level, radius, place)
        assert volume is not None
        taps = _Taps.at(place.position, place.start, level.size, radius)
        # several times faster than take
        values = volume.view(-1).index_select(0, taps.index.view(-1)).view(taps.index.shape)
        rows = torch.addcmul(values[:, :, :-1] * taps.ay, values[:, :, 1:], taps.by)
        return torch.addcmul(rows[:, :-1] * taps.ax, rows[:, 1:], taps.bx)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        place, level, grad = _Place(*ctx.saved_tensors), ctx.level, grads[0]
        if level.kernels and not torch.is_grad_enabled():
            _by_adjoint(level, ctx.radius, place, grad)
        else:
            position, start = place.position, place.start
            if place.learn is not None:
                position, start, grad = (x[place.learn] for x in (position, start, grad))
            _Taps.at(position, start, level.size, ctx.radius).add_gradient(grad, level.store, level.length)
        return (grad.new_zeros(()), *[None] * 7)


def _by_kernel(level: _Level, radius: int, place: _Place) -> Tensor:
    import dvo.nets.correlation.edge_correlation_kernels as kernels

    position, side = place.position, 2 * radius + 1
    given: tuple[Any, ...]
    if level.volume is not None:
        out = position.new_empty(len(position), side, side, position.shape[1])
        to = out.permute(0, 3, 2, 1).numpy()
        given = level.volume.view(-1).numpy(), place.start.numpy(), position.numpy(), *level.size, radius, to
        kernels.look_up(*given)
        return out
    found = position.new_empty(*position.shape[:2], side, side)
    arrays: tuple[Any, ...] = (level.maps, level.features, position, place.patch, place.frame)
    given = *(x.numpy() for x in arrays), radius, found.numpy()
    kernels.correlate(*given)
    return found.permute(0, 3, 2, 1).contiguous()


def _by_adjoint(level: _Level, radius: int, place: _Place, grad: Tensor) -> None:
    """Add to the gradients in the store."""
    import dvo.nets.correlation.edge_correlation_kernels as kernels

    store, edges = level.store, place.edges()
    by_out = grad.contiguous().permute(0, 3, 2, 1).numpy()
    given: tuple[Any, ...]
    if level.volume is not None:
        if "volume" not in store:
            store["volume"] = grad.new_zeros(level.length)
        given = place.start.numpy(), place.position.numpy(), *level.size, radius, edges, by_out
        kernels.look_up_adjoint(*given, store["volume"].numpy())
        return
    if "features" not in store:
        for name, x in (("features", level.features), ("maps", level.maps)):
            assert x is not None
            store[name] = torch.zeros_like(x)
    arrays: tuple[Any, ...] = (level.maps, level.features, place.position, place.patch, place.frame)
    sums = store["maps"].numpy(), store["features"].numpy()
    given = *(x.numpy() for x in arrays), radius, edges, by_out, *sums
    kernels.correlate_adjoint(*given)


@dataclass(frozen=True)
class _Level:
    """A level of the pyramid: the whole volume, or where its windows are found.

    Attributes:
        token: of :class:`_Source`.
        store: gradients of the look-ups so far.
        size: height and width of a map.
        length: of the volume.
        kernels: look up by kernels.
        volume: ``(B, K q, N h w)``; None for windows, which kernels alone take.
        features: ``(B K, q, C)``, and maps: ``(B N, H, W, C)`` in a border of zeros; None for a volume.
    """

    token: Tensor
    store: dict[str, Tensor]
    size: tuple[int, int]
    length: int
    kernels: bool
    volume: Tensor | None = None
    features: Tensor | None = None
    maps: Tensor | None = None


FEW_PIXELS = 4
"""A volume is multiplied out for maps of at most this many times the pixels of a window."""


class CorrelationVolume:
    """All correlations of a clip, computed once and looked up at every update.

    Memory is ``B * K * p^2 * N * h * w`` floats, summed over the levels. On the CPU, levels with maps that are much
    larger than a window are not multiplied out, but looked up window by window by a kernel.

    Args:
        patches: ``(B, K, C, p, p)`` matching features of the patches, of any height and width, up to whole frames.
        maps: ``(B, N, C, h, w)`` matching features of the frames.
        pyramid: down-sampling of each level relative to ``maps``.
        radius: correlation radius in pixels of each level.
    """

    def __init__(self, patches: Tensor, maps: Tensor, pyramid: tuple[int, ...] = (1, 4), radius: int = 3) -> None:
        b, k, c, p, q = patches.shape
        self.radius, self.pyramid, self.frames = radius, pyramid, maps.shape[1]
        self.pixels, self.patches = p * q, k
        if patches.dtype in (torch.float16, torch.bfloat16):  # too coarse to place a peak between two pixels
            patches, maps = patches.float(), maps.float()
        features = patches.permute(0, 1, 3, 4, 2).reshape(b, k, p * q, c)
        self.levels = [self._level(features, level) for level in pool_levels(maps, pyramid)]

    def _level(self, features: Tensor, level: Tensor) -> _Level:
        store: dict[str, Tensor] = {}
        size = level.shape[-2], level.shape[-1]
        token: Tensor = _Source.apply(features, level, store)
        (h, w), (b, k, q, _), taps = size, features.shape, 2 * self.radius + 2
        kernels = use_kernels(features, level, adjoint=True)
        common = token, store, size, b * k * q * self.frames * h * w, kernels
        if kernels and h * w > FEW_PIXELS * taps**2:
            maps = F.pad(level.detach().flatten(0, 1).permute(0, 2, 3, 1), (0, 0, *[taps] * 4)).contiguous()
            return _Level(*common, features=features.detach().flatten(0, 1).contiguous(), maps=maps)
        with torch.no_grad(), full_precision(features.device):
            return _Level(*common, volume=torch.matmul(features.flatten(1, 2), _as_columns(level)))

    def lookup(
        self,
        coords: Float[Tensor, "B E p p 2"],
        kk: Int[Tensor, " E"],
        jj: Int[Tensor, " E"],
        learn: Int[Tensor, " L"] | None = None,
    ) -> list[Tensor]:
        """Correlation channels of a set of edges, equal to :func:`correlate_reference`.

        Args:
            coords: reprojected patch pixels ``x, y`` in feature pixels; they receive no gradient.
            kk, jj: patch and target frame of each edge.
            learn: indices into the flattened ``B * E`` edges that propagate a gradient to the features (DPVO uses a
                random fifth), or None for all.

        Returns:
            One tensor ``(B, E, (2r+1)^2 * p^2)`` for each level, channels in the order ``offsets_first``.

        Raises:
            DvoError: an index out of range.
        """
        b, e = coords.shape[:2]
        position = coords.detach().reshape(b * e, self.pixels, 2)
        clip = torch.arange(b, device=kk.device)[:, None]
        patch, frame = (clip * self.patches + kk).flatten(), (clip * self.frames + jj).flatten()
        row = patch[:, None] * self.pixels + torch.arange(self.pixels, device=kk.device)
        slices = row * self.frames + jj.repeat(b)[:, None]
        if any(level.kernels for level in self.levels):
            for index, count in ((kk, self.patches), (jj, self.frames), (learn, b * e)):
                check_range(index, count)
        levels = []
        for level, scale in zip(self.levels, self.pyramid, strict=True):
            at, start = (position / scale).contiguous(), slices * (level.size[0] * level.size[1])
            place = _Place(at, start, patch, frame, learn)
            found: Tensor = _Lookup.apply(level.token, level, self.radius, *place.tensors())
            levels.append(found.reshape(b, e, -1))
        return levels


def check_range(index: Tensor | None, count: int) -> None:
    """Check indices that a kernel would follow out of its arrays.

    Raises:
        DvoError: one that is not in ``0 .. count - 1``.
    """
    if index is not None and len(index) and (int(index.min()) < 0 or int(index.max()) >= count):
        raise DvoError("an index out of range", field="lookup", remedy=f"give 0 to {count - 1}")
