"""Linear layers in 8 bits, for inference on CPUs with instructions for it.

Each row of the input is rounded to 256 levels between its own bounds, and the weights of each output to 255 levels
around 0. The products are sums of whole numbers, hence exact; what is lost is the rounding, some 0.5 % of a row.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dvo.core.kernels import available, imported, use_kernels

Array = Any


def multiplies_int8(device: torch.device) -> bool:
    """Tell if layers in 8 bits are fastest on a device: a CPU whose vectors multiply bytes (AVX-512 VNNI, AVX-VNNI).

    Units for matrices (AMX) are faster, with bfloat16.

    Args:
        device: any.
    """
    if device.type != "cpu" or not imported():
        return False
    from dvo.core.compiled import prefers_int8

    return prefers_int8()


def has_kernels() -> bool:
    """Tell if kernels are wanted, and compiled for a CPU with instructions for products of bytes."""
    if not available():
        return False
    from dvo.core.compiled import compiles_int8

    return compiles_int8()


def round_rows(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Round rows to 8 bits.

    Args:
        x: ``(..., C)``.

    Returns:
        Levels ``(..., C)``, whole numbers of 0 to 255; and float32 ``scale`` and ``offset (..., 1)``, so that ``x`` is
        about ``scale * levels + offset``. The scale of a row with a number that is not finite is NaN.
    """
    x = x.float()
    low = x.amin(-1, keepdim=True)
    size = x.amax(-1, keepdim=True) - low
    whole = size.isfinite()
    factor = torch.where(size > 1e-30, 255 / size, 0.0)
    levels = torch.where(whole, ((x - low) * factor + 0.5).floor(), 0.0)
    return levels, torch.where(whole, size / 255, torch.nan), torch.where(whole, low, 0.0)


def round_weights(weight: Tensor) -> tuple[Tensor, Tensor]:
    """Round the weights of each output to whole numbers of -127 to 127.

    Args:
        weight: ``(D, C)``.

    Returns:
        The numbers ``(D, C)``, and their ``scale (D, 1)``.
    """
    scale = weight.abs().amax(1, keepdim=True).clamp(min=torch.finfo(torch.float32).tiny) / 127
    return (weight / scale).round(), scale


def multiply_rounded(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Linear layer of rounded rows and weights; the twin of :meth:`Int8Linear.multiply`.

    Args:
        x: ``(..., C)``.
        weight, bias: ``(D, C)`` and ``(D,)`` float32.

    Returns:
        ``(..., D)`` float32.
    """
    levels, scale, offset = round_rows(x)
    whole, size = round_weights(weight)
    exact = torch.float32 if 255 * 127 * x.shape[-1] < 2**24 else torch.float64
    sums = (levels.to(exact) @ whole.to(exact).mT).float()
    return sums * (scale * size[:, 0]) + (offset * (whole * size).sum(1) + bias)


@dataclass(frozen=True)
class Rows:
    """Rows of 8 bits as kernels take them (:func:`dvo.nets.update.int8_kernels.quantise`)."""

    count: int
    levels: Array
    scale: Array
    offset: Array


def array_of(x: Tensor | Array) -> Array:
    """Values of a tensor, or bits of one of bfloat16; an array is what it is."""
    if not isinstance(x, Tensor):
        return x
    return (x.view(torch.uint16) if x.dtype == torch.bfloat16 else x).numpy()


def pack_rows(x: Tensor | Array, further: Tensor | None = None, *, rectified: bool = False) -> Rows:
    """Round rows by a kernel; its twin is :func:`round_rows`.

    Args:
        x: ``(E, A)`` float32 or bfloat16, or the bits of this.
        further: ``(E, B)`` what follows in each row.
        rectified: negative numbers are taken as 0.
    """
    from dvo.nets.update import int8_kernels as kernels

    given = array_of(x)
    more = given[:, :0] if further is None else array_of(further)
    count, channels = (
        -(-size // step) * step
        for size, step in ((len(given), kernels.ROWS), (given.shape[1] + more.shape[1], kernels.LANES))
    )
    levels, (scale, offset) = np.empty((count, channels), np.uint8), np.empty((2, count), np.float32)
    kernels.quantise(given, more, rectified, levels, scale, offset)
    return Rows(len(given), levels, scale, offset)


class Int8Linear(nn.Linear):
    """Linear layer in 8 bits.

    Args:
        layer: whose weights it has; not copied.
        dtype: of what it gives.
    """

    def __init__(self, layer: nn.Linear, dtype: torch.dtype) -> None:
        nn.Module.__init__(self)
        self.in_features, self.out_features, self.gives = layer.in_features, layer.out_features, dtype
        self.weight = nn.Parameter(layer.weight.detach().float(), requires_grad=False)
        given = layer.weight.new_zeros(layer.out_features) if layer.bias is None else layer.bias
        self.bias = nn.Parameter(given.detach().float(), requires_grad=False)
        self._packed: dict[str, tuple[Array, Array]] = {}

    def forward(self, input: Tensor) -> Tensor:
        """Apply the layer.

        Args:
            input: ``(..., C)``.

        Returns:
            ``(..., D)``.
        """
        return self.of_parts([input], "", lambda: self.weight)

    def of_parts(self, parts: Sequence[Tensor], order: str, weight: Callable[[], Tensor]) -> Tensor:
        """Apply the layer with its weights in another order.

        Args:
            parts: ``(..., C_k)`` parts of the input, which follow each other.
            order: name of the order.
            weight: of the layer in this order, ``(D, C)``.

        Returns:
            ``(..., D)``.
        """
        if self._takes_kernels(*parts):
            first, *others = (x.flatten(0, -2).contiguous() for x in parts)
            further = torch.cat(others, 1) if len(others) > 1 else others[0] if others else None
            found = torch.from_numpy(self.multiply(pack_rows(first, further), order, weight))
            return found.view(self.gives).view(*parts[0].shape[:-1], self.out_features)
        return multiply_rounded(torch.cat(list(parts), -1), weight(), self.bias).to(self.gives)

    def multiply(self, rows: Rows, order: str = "", weight: Callable[[], Tensor] | None = None) -> Array:
        """Apply the layer by a kernel; its twin is :func:`multiply_rounded`.

        Args:
            rows: of C channels.
            order, weight: see :meth:`of_parts`.

        Returns:
            ``(E, D)`` float32, or bits of bfloat16.
        """
        from dvo.nets.update import int8_kernels as kernels

        if order not in self._packed:
            self._packed[order] = _pack(self.weight if weight is None else weight(), self.bias, kernels.COLUMNS)
        out = np.empty((rows.count, self.out_features), np.uint16 if self.gives == torch.bfloat16 else np.float32)
        kernels.multiply(rows.levels, rows.scale, rows.offset, *self._packed[order], out)
        return out

    def _takes_kernels(self, *parts: Tensor) -> bool:
        plain = not torch.is_grad_enabled() and self.gives in (torch.float32, torch.bfloat16)
        return plain and parts[0].numel() > 0 and use_kernels(*parts, half=True) and has_kernels()


def _pack(weight: Tensor, bias: Tensor, columns: int) -> tuple[Array, Array]:
    """Weights and numbers of the outputs as :func:`dvo.nets.update.int8_kernels.multiply` takes them."""
    whole, scale = round_weights(weight)
    count, channels = whole.shape
    panels, steps = -(-count // columns), -(-channels // 4)
    padded = torch.zeros(panels * columns, steps * 4, dtype=torch.int8)
    padded[:count, :channels] = whole.to(torch.int8)
    layer = torch.zeros(3, panels * columns)
    layer[:, :count] = torch.stack([scale[:, 0], (whole * scale).sum(1), bias])
    packed = padded.view(panels, columns, steps, 4).transpose(1, 2).contiguous()
    return packed.numpy(), layer.view(3, panels, columns).transpose(0, 1).contiguous().numpy()


def with_int8_layers(module: nn.Module, source: nn.Module, dtype: torch.dtype) -> None:
    """Put layers in 8 bits in the place of the linear ones of a module, but for those of fewer than four outputs.

    Args:
        module: changed in place.
        source: the same in float32, whose weights are rounded.
        dtype: of what the layers give.
    """
    for name, child in source.named_children():
        if not isinstance(child, nn.Linear):
            with_int8_layers(getattr(module, name), child, dtype)
        elif child.out_features >= 4:
            setattr(module, name, Int8Linear(child, dtype))
