"""A device that is none: tensors that say they are on an accelerator, computed on the CPU.

It shows on any machine what a program does with an accelerator: where it mixes tensors of two devices, which raises as
it would there, and where it waits for results. Speed and rounding are those of the CPU.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

import dvo
from dvo.core.errors import DvoError

DEVICE = torch.device("lazy", 0)
"""A kind of device that torch knows and nobody has."""
LIBRARY = Path(dvo.__file__).resolve().parent
_aten = torch.ops.aten
# Operations whose result, or the size of it, the processor has to know before it can go on.
_ASKS = {
    _aten._local_scalar_dense.default: "a number",
    _aten.is_nonzero.default: "a number",
    _aten.equal.default: "a number",
    _aten.nonzero.default: "a number of elements",
    _aten.masked_select.default: "a number of elements",
    _aten._unique2.default: "a number of elements",
    _aten.unique_dim.default: "a number of elements",
    _aten.unique_consecutive.default: "a number of elements",
    _aten.bincount.default: "a number of elements",
}
_INDEXED = {_aten.index.Tensor, _aten.index_put.default, _aten.index_put_.default, _aten._index_put_impl_.default}
_MOVES = {_aten._to_copy.default, _aten.copy_.default}


class _OnDevice(Tensor):
    """A tensor of the device, whose values are those of a tensor on the CPU."""

    on_cpu: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> _OnDevice:
        made = Tensor._make_wrapper_subclass(
            cls, values.shape, strides=values.stride(), storage_offset=values.storage_offset(), dtype=values.dtype,
            device=DEVICE, requires_grad=False,
        )  # fmt: skip
        made.on_cpu = values
        return made

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"on_device({self.on_cpu!r})"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _computed(operation, args, kwargs or {})


def _is_there(x: Any) -> bool:
    return isinstance(x, torch.device) and x.type == DEVICE.type


@torch.inference_mode(False)  # tensors made in it have no versions, which those that see them from outside expect
@torch.no_grad()
def _computed(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Result of an operation of which an argument is on the device, or is the device."""
    given = tree_leaves((args, kwargs))
    placed = kwargs.get("device")
    moved = operation in _MOVES or "pin_memory" in kwargs or placed is not None
    inside = any(isinstance(x, _OnDevice) for x in given)
    strangers = [x for x in given if isinstance(x, Tensor) and not isinstance(x, _OnDevice) and x.dim()]
    index = args[1] if operation in _INDEXED else ()
    strangers = [x for x in strangers if not any(x is one for one in index)]  # indices are moved by torch
    if inside and strangers and not moved:
        raise RuntimeError(f"Expected all tensors to be on the same device: {operation} of {DEVICE} and cpu")
    plain = tree_map(lambda x: x.on_cpu if isinstance(x, _OnDevice) else x, (args, kwargs))
    if placed is not None:
        plain[1]["device"] = torch.device("cpu")
    found = operation(*plain[0], **plain[1])
    if operation is _aten.copy_.default or (args and isinstance(args[0], Tensor) and found is _values(args[0])):
        return args[0]  # changed in place
    out = _is_there(placed) if placed is not None else inside
    if "out" in kwargs:
        return kwargs["out"]
    return tree_map(lambda x: _OnDevice(x) if isinstance(x, Tensor) else x, found) if out else found


def _values(x: Tensor) -> Tensor:
    return x.on_cpu if isinstance(x, _OnDevice) else x


class Waits(TorchDispatchMode):
    """Context in which the stand-in can be used, and in which places are counted at which an accelerator is waited for.

    Attributes:
        places: by kind, file of dvo and line: number of times. Kinds are ``a number``, ``a number of elements`` and
            ``a copy`` (from the device, or to it from memory that is not pinned).
    """

    def __init__(self) -> None:
        super().__init__()
        self.places: Counter[tuple[str, str, int]] = Counter()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        with self:  # into the operations that it consists of, as an accelerator would get them
            parts = operation.decompose(*args, **kwargs)
        if parts is not NotImplemented:
            return parts
        reason = _reason(operation, args, kwargs)
        if reason:
            self.places[(reason, *_place(sys._getframe(1)))] += 1
        given = tree_leaves((args, kwargs))
        if any(isinstance(x, _OnDevice) or _is_there(x) for x in given):
            return _computed(operation, args, kwargs)
        return operation(*args, **kwargs)


def _reason(operation: Any, args: Any, kwargs: dict[str, Any]) -> str:
    """Kind of wait of an operation, empty for none."""
    given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    inside = any(isinstance(x, _OnDevice) for x in given)
    if operation in _MOVES:
        target = args[0] if operation is _aten.copy_.default else kwargs.get("device")
        there = isinstance(target, _OnDevice) or _is_there(target)
        source = isinstance(args[-1], _OnDevice)
        other = target is not None and there != source
        return "a copy" if other and not (kwargs.get("non_blocking") and there) else ""
    if not inside:
        return ""
    if operation is _aten.repeat_interleave.Tensor and kwargs.get("output_size") is None:
        return "a number of elements"
    if operation in _INDEXED and any(isinstance(x, Tensor) and not isinstance(x, _OnDevice) for x in args[1]):
        return "a copy"
    if operation in _INDEXED and any(x is not None and x.dtype in (torch.bool, torch.uint8) for x in args[1]):
        return "a number of elements"
    return _ASKS.get(operation, "")


def _place(frame: FrameType | None) -> tuple[str, int]:
    """File of dvo, relative to the library, and line of the innermost call from there."""
    while frame is not None:
        file = Path(frame.f_code.co_filename)
        if LIBRARY in file.parents:
            return file.relative_to(LIBRARY).as_posix(), frame.f_lineno
        frame = frame.f_back
    return "", 0


_ENABLED = torch.is_autocast_enabled


def _is_autocast_enabled(kind: str | None = None) -> bool:
    """As torch answers, which refuses kinds of devices without autocast."""
    return kind != DEVICE.type and (_ENABLED() if kind is None else _ENABLED(kind))


@contextmanager
def stand_in() -> Iterator[Waits]:
    """Context in which tensors can be made on :data:`DEVICE`; the count of the waits.

    Raises:
        DvoError: torch has no way to do so.
    """
    lifting = getattr(torch._C, "_set_only_lift_cpu_tensors", None)
    swap = torch.__future__
    if lifting is None:
        raise DvoError(f"torch {torch.__version__} cannot", field="stand-in device", remedy="use another version")
    before, swapped = torch._C._only_lift_cpu_tensors(), swap.get_swap_module_params_on_conversion()
    lifting(True)  # torch.tensor(..., device=...) makes a tensor on the CPU first, and moves it
    swap.set_swap_module_params_on_conversion(True)  # modules keep the type of the tensors that they are moved to
    try:
        with mock.patch.object(torch, "is_autocast_enabled", _is_autocast_enabled), Waits() as waits:
            yield waits
    finally:
        lifting(before)
        swap.set_swap_module_params_on_conversion(swapped)
