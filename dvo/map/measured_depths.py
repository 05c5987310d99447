"""Priors of inverse depths that a sensor has measured.

The inverse depth of a patch has the prior ``w (d - d_measured)^2`` with ``w = sigma^2 / var(d_measured)``: weights of
bundle adjustment are confidences, of which 1 stands for the standard deviation ``sigma`` in feature pixels. A Cauchy
kernel takes the influence from depths of another surface, which a rough registration gives near the edges of bodies.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.ba.factors import DepthPrior
from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem

SIGMA = 0.061
"""Standard deviation of a measurement of confidence 1 with the shipped weights, feature pixels (docs/precision.md)."""
KERNEL = Kernel("cauchy", SIGMA)
"""Robust kernel of measured depths: one standard deviation, as errors of depths have long tails."""


def depth_factors(measured: Tensor | None) -> tuple[DepthPrior, ...]:
    """Priors of the patches whose depth was measured.

    Args:
        measured: ``(K, 2)`` inverse depths and weights, 0 for none; None without a depth camera.

    Returns:
        One factor of ``inverse_depths (1, K)``; none without measurements.
    """
    if measured is None:
        return ()
    index = (measured[:, 1] > 0).nonzero()[:, 0]
    if not len(index):
        return ()
    value, weight = measured[index].unbind(1)
    return (DepthPrior(value[None], weight[None], index, KERNEL),)


def measured_depths(problem: PatchProblem) -> Tensor | None:
    """What :func:`depth_factors` has made the priors of a problem of.

    Args:
        problem: one graph.

    Returns:
        ``(K, 2)`` inverse depths and weights, 0 for none; None without such priors.
    """
    found = None
    for prior in problem.factors:
        if isinstance(prior, DepthPrior) and prior.index is not None:
            found = torch.zeros(len(problem.patches), 2).to(prior.value) if found is None else found
            found[prior.index] = torch.stack([prior.value[0], prior.weight[0]], 1)
    return found
