"""Selective state-space recurrence of Mamba (Gu and Dao, arXiv 2312.00752, section 3), as a scan and step by step.

For each channel ``c`` and each of its ``N`` states, with the step ``D``, the rate ``a`` and the vectors ``B`` and ``C``
of position ``t``:

    h_t = exp(-D_t a) h_(t-1) + (1 - exp(-D_t a)) / a * B_t x_t        zero-order hold, equation 4
    y_t = sum over the states of C_t h_t

``D``, ``B`` and ``C`` depend on the input, which is what makes it selective. Mamba's code replaces the factor of the
input by ``D_t``; the hold is kept here because its states are bounded by ``|B x| / a``, however large the step. A step
of zero leaves the state as it is: that is how padding is passed over.

No quotient of cumulative products appears, and factors lie in [0, 1], so nothing overflows on sequences of any length.
All of it runs in full precision under autocast.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from dvo.core.context import full_precision

Method = Literal["parallel", "sequential"]
"""``parallel``: doubling (Hillis and Steele 1986), in ``log2(L)`` passes over the whole sequence; ``sequential``: one
pass, position by position, with the least arithmetic."""


def linear_recurrence(
    decay: Float[Tensor, "*S L N C"], drive: Float[Tensor, "*S L N C"], method: Method | None = None
) -> Float[Tensor, "*S L N C"]:
    """States ``h_t = decay_t * h_(t-1) + drive_t`` from zero on, differentiable any number of times.

    Args:
        decay: factor of the state before, in [0, 1]; that of the first position has no effect.
        drive: what is added.
        method: see :data:`Method`; None for ``sequential`` on the CPU and ``parallel`` elsewhere.

    Returns:
        The state after each position. Methods differ by rounding alone.
    """
    parallel = decay.device.type != "cpu" if method is None else method == "parallel"
    return _Recurrence.apply(decay, drive, parallel)


class _Recurrence(torch.autograd.Function):
    """Recurrence whose adjoint is the same recurrence in the opposite direction; it keeps the states and the decays."""

    @staticmethod
    def forward(ctx: Any, decay: Tensor, drive: Tensor, parallel: bool) -> Tensor:
        states = _by_doubling(decay, drive) if parallel else _by_position(decay, drive)
        ctx.save_for_backward(decay, states)
        ctx.parallel = parallel
        return states

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:
        decay, states = ctx.saved_tensors
        following = _shifted(decay, -1).flip(-3)
        adjoint = _Recurrence.apply(following, grads[0].flip(-3), ctx.parallel).flip(-3)
        return adjoint * _shifted(states, 1), adjoint, None


def _shifted(x: Tensor, positions: int) -> Tensor:
    """Sequence moved by one position to the right (1) or to the left (-1), filled with zeros."""
    if positions > 0:
        return F.pad(x[..., :-1, :, :], (0, 0, 0, 0, 1, 0))
    return F.pad(x[..., 1:, :, :], (0, 0, 0, 0, 0, 1))


def _by_position(decay: Tensor, drive: Tensor) -> Tensor:
    states = torch.empty_like(drive)
    factors, added, found = decay.unbind(-3), drive.unbind(-3), states.unbind(-3)
    for t in range(len(found)):
        if t == 0:
            found[0].copy_(added[0])
        else:
            torch.addcmul(added[t], factors[t], found[t - 1], out=found[t])
    return states


def _by_doubling(decay: Tensor, drive: Tensor) -> Tensor:
    reach, length = 1, drive.shape[-3]
    while reach < length:
        later = decay[..., reach:, :, :]
        summed = torch.addcmul(drive[..., reach:, :, :], later, drive[..., :-reach, :, :])
        drive = torch.cat([drive[..., :reach, :, :], summed], -3)
        decay = torch.cat([decay[..., :reach, :, :], later * decay[..., :-reach, :, :]], -3)
        reach *= 2
    return drive


def _discretise(inputs: Tensor, step: Tensor, rate: Tensor, write: Tensor) -> tuple[Tensor, Tensor]:
    """Decay ``exp(-step rate)`` and drive of every state, ``(..., N, C)``, by zero-order hold."""
    change = torch.expm1(step[..., None, :] * -rate)  # no cancellation for small steps
    return 1 + change, change * (-1 / rate) * (inputs[..., None, :] * write[..., None])


def selective_step(
    inputs: Float[Tensor, "*S C"],
    step: Float[Tensor, "*S C"],
    rate: Tensor,
    write: Float[Tensor, "*S N"],
    read: Float[Tensor, "*S N"],
    state: Float[Tensor, "*S N C"],
) -> tuple[Tensor, Tensor]:
    """One position of the recurrence.

    Args:
        inputs: ``x`` of the position.
        step: ``D >= 0`` of each channel; the state does not change where it is 0.
        rate: ``a > 0`` of each state, ``(..., N, C)``.
        write: ``B``, how an input enters the states.
        read: ``C``, how states enter the output.
        state: before the position.

    Returns:
        Output ``(..., C)``, and the state after the position.
    """
    with full_precision(inputs.device):
        inputs, step, rate, write, read, state = _at_least_single(inputs, step, rate, write, read, state)
        decay, drive = _discretise(inputs, step, rate, write)
        state = torch.addcmul(drive, decay, state)
        return (read[..., None, :] @ state).squeeze(-2), state


def selective_scan(
    inputs: Float[Tensor, "*S L C"],
    step: Float[Tensor, "*S L C"],
    rate: Tensor,
    write: Float[Tensor, "*S L N"],
    read: Float[Tensor, "*S L N"],
    state: Float[Tensor, "*S N C"] | None = None,
    method: Method | None = None,
) -> tuple[Tensor, Tensor]:
    """The recurrence over whole sequences.

    Args:
        inputs, step, write, read: see :func:`selective_step`, for ``L >= 1`` positions.
        rate: ``a > 0``, of a shape that broadcasts to ``(..., L, N, C)``.
        state: before the first position; None for zero.
        method: see :data:`Method`.

    Returns:
        Outputs ``(..., L, C)``, and the state after the last position, ``(..., N, C)``.

    Example:
        >>> x, step = torch.randn(2, 7, 4), torch.rand(2, 7, 4)
        >>> write, read = torch.randn(2, 7, 3), torch.randn(2, 7, 3)
        >>> y, state = selective_scan(x, step, torch.ones(3, 4), write, read)
        >>> y.shape, state.shape
        (torch.Size([2, 7, 4]), torch.Size([2, 3, 4]))
    """
    with full_precision(inputs.device):
        inputs, step, rate, write, read = _at_least_single(inputs, step, rate, write, read)
        decay, drive = _discretise(inputs, step, rate, write)
        if state is not None:
            (state,) = _at_least_single(state)
            first = torch.addcmul(drive[..., :1, :, :], decay[..., :1, :, :], state[..., None, :, :])
            drive = torch.cat([first, drive[..., 1:, :, :]], -3)
        states = linear_recurrence(decay, drive, method)
        return (read[..., None, :] @ states).squeeze(-2), states[..., -1, :, :]


def selective_loop(
    inputs: Float[Tensor, "*S L C"],
    step: Float[Tensor, "*S L C"],
    rate: Float[Tensor, "N C"],
    write: Float[Tensor, "*S L N"],
    read: Float[Tensor, "*S L N"],
    state: Float[Tensor, "*S N C"] | None = None,
) -> tuple[Tensor, Tensor]:
    """:func:`selective_scan` as a loop of :func:`selective_step`, its specification; arguments and result as there."""
    if state is None:
        state = inputs.new_zeros(*inputs.shape[:-2], write.shape[-1], inputs.shape[-1])
    outputs = []
    for t in range(inputs.shape[-2]):
        found, state = selective_step(
            inputs[..., t, :], step[..., t, :], rate, write[..., t, :], read[..., t, :], state
        )
        outputs.append(found)
    return torch.stack(outputs, -2), state


def _at_least_single(*tensors: Tensor) -> list[Tensor]:
    """The tensors with half precision raised to single."""
    return [t.float() if t.dtype in (torch.float16, torch.bfloat16) else t for t in tensors]
