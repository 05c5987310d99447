"""Functions of tensors that differentiate themselves: derivatives of any order, and ``torch.func``.

A function that reads values (a factorisation that may fail, a number of groups that depends on indices) can neither be
traced by ``torch.func.vmap`` nor be run on the tensors that ``torch.func`` wraps. :func:`composed` runs it on plain
tensors only: a vmap is a loop, a derivative is another such function that runs autograd inside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dvo.ba.layer.schur import sums_up
from dvo.core.kernels import is_transformed

Tensors = tuple[Tensor, ...]
Function = Callable[..., Tensors]


def composed(function: Function, *tensors: Tensor) -> Tensors:
    """Call a function so that it can be differentiated again and transformed.

    Args:
        function: takes and returns plain tensors, and is differentiable by autograd.
        tensors: its arguments.

    Returns:
        What it returns; the gradient of what does not require one is zero.
    """
    found: Tensors = _Composed.apply(function, *tensors)
    return found


def finite(found: Sequence[Tensor | None], grads: Sequence[Tensor]) -> list[Tensor | None]:
    """Of finite gradients ``grads`` come finite ones: what is too large for its type is none. A NaN stays one."""
    given = [x for x in found if x is not None]
    if not is_transformed() and sums_up(*(x.detach() for x in given)):
        return list(found)
    nothing = sum((g * 0).sum() for g in grads if g.is_floating_point())
    return [None if x is None else torch.nan_to_num(x, 0.0, 0.0, 0.0) + nothing for x in found]


class _Composed(torch.autograd.Function):
    @staticmethod
    def forward(function: Function, *tensors: Tensor) -> Tensors:
        # An argument that comes out as it is would be one tensor with two meanings.
        return tuple(x.clone() if any(x is y for y in tensors) else x for x in function(*tensors))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.function, ctx.outputs = inputs[0], len(output)
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])
        ctx.mark_non_differentiable(*(x for x in output if not x.is_floating_point()))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        needed = tuple(i for i in range(len(tensors)) if ctx.needs_input_grad[i + 1])
        back = composed(partial(pulled_back, ctx.function, needed, len(tensors)), *tensors, *grads)
        out: list[Tensor | None] = [None] * (len(tensors) + 1)
        for i, gradient in zip(needed, finite(back, grads), strict=True):
            out[i + 1] = gradient
        return tuple(out)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        moved = tuple(i for i, x in enumerate(tangents) if x is not None and x.is_floating_point())
        push = partial(pushed_forward, ctx.function, moved, len(tensors))
        return composed(push, *tensors, *(x for i, x in enumerate(tangents) if i in moved and x is not None))

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], function: Function, *tensors: Tensor) -> tuple[Any, Any]:
        dims = in_dims[1:]
        each = [
            composed(function, *(x if d is None else x.select(d, i) for x, d in zip(tensors, dims, strict=True)))
            for i in range(info.batch_size)
        ]
        return tuple(torch.stack(x) for x in zip(*each, strict=True)), (0,) * len(each[0])


def pulled_back(function: Function, needed: Sequence[int], count: int, *given: Tensor) -> Tensors:
    """Gradients of a function, differentiable if autograd records.

    Args:
        function: see :func:`composed`.
        needed: positions of the arguments whose gradients are wanted.
        count: number of arguments.
        given: the arguments, then the gradients of the outputs.

    Returns:
        A gradient for each position.
    """
    record = torch.is_grad_enabled()
    with torch.enable_grad():
        inputs = _inputs(given[:count], needed, record)
        pairs = [(x, g) for x, g in zip(function(*inputs), given[count:], strict=True) if x.requires_grad]
        wanted = [inputs[i] for i in needed]
        if not pairs or not wanted:
            return tuple(torch.zeros_like(x) for x in wanted)
        outputs, grads = zip(*pairs, strict=True)
        found = torch.autograd.grad(outputs, wanted, grads, allow_unused=True, create_graph=record)
    return tuple(torch.zeros_like(x) if g is None else g for x, g in zip(wanted, found, strict=True))


def pushed_forward(function: Function, moved: Sequence[int], count: int, *given: Tensor) -> Tensors:
    """Directional derivatives of a function: a gradient is linear in that of the outputs, and this is its transpose.

    Args:
        function: see :func:`composed`.
        moved: positions of the arguments that have a tangent.
        count: number of arguments.
        given: the arguments, then the tangents.

    Returns:
        A tangent for each output.
    """
    record = torch.is_grad_enabled()
    with torch.enable_grad():
        inputs = _inputs(given[:count], moved, record)
        outputs = function(*inputs)
        linear = [torch.zeros_like(x, requires_grad=True) if x.requires_grad else None for x in outputs]
        pairs = [(x, g) for x, g in zip(outputs, linear, strict=True) if g is not None]
        back: list[tuple[Tensor, Tensor]] = []
        if pairs and moved:
            found = torch.autograd.grad(
                [x for x, _ in pairs], [inputs[i] for i in moved], [g for _, g in pairs], allow_unused=True,
                create_graph=True,
            )  # fmt: skip
            back = [(g, t) for g, t in zip(found, given[count:], strict=True) if g is not None and g.requires_grad]
        if not back:
            return tuple(torch.zeros_like(x) for x in outputs)
        tangents = torch.autograd.grad(
            [g for g, _ in back], [g for _, g in pairs], [t for _, t in back], allow_unused=True, create_graph=record
        )
    by_output = iter(tangents)
    each = [None if g is None else next(by_output) for g in linear]
    return tuple(torch.zeros_like(x) if t is None else t for x, t in zip(outputs, each, strict=True))


def _inputs(tensors: Tensors, needed: Sequence[int], record: bool) -> list[Tensor]:
    """Arguments to differentiate by: of a function that is differentiated again, views that keep the graph."""
    return [
        x.view_as(x) if record and x.requires_grad else x.detach().requires_grad_(i in needed)
        for i, x in enumerate(tensors)
    ]
