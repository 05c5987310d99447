"""Learning rates over the steps, as factors of the configured rate."""

from __future__ import annotations

from collections.abc import Callable


def constant_rate(warmup: int, decay_from: int | None = None, decay_steps: int = 1000) -> Callable[[int], float]:
    """Linear warm-up, then constant; from ``decay_from`` on linearly to zero.

    Args:
        warmup: steps of the rise.
        decay_from: first step of the fall; None: none.
        decay_steps: length of the fall.

    Returns:
        factor of the configured rate by step.
    """

    def factor(step: int) -> float:
        value = min(1.0, (step + 1) / max(1, warmup))
        if decay_from is not None:
            value *= min(1.0, max(0.0, 1 - (step - decay_from) / decay_steps))
        return value

    return factor


def one_cycle_rate(
    steps: int, rise: float = 0.01, start: float = 1 / 25, end: float = 1 / 25e4
) -> Callable[[int], float]:
    """One linear rise and one linear fall (DPVO's schedule): the factors of ``torch.optim.lr_scheduler.OneCycleLR``
    with ``anneal_strategy="linear"``, which then stay at the end instead of raising.

    Args:
        steps: length of the cycle.
        rise: share of it until the top.
        start, end: factors at both ends.

    Returns:
        factor of the configured rate by step.
    """
    top, last = max(rise * steps - 1, 1e-9), steps - 1

    def factor(step: int) -> float:
        if step <= top:
            return start + (1 - start) * step / top
        share = min((step - top) / max(last - top, 1e-9), 1.0)
        return 1 + (end - 1) * share

    return factor
