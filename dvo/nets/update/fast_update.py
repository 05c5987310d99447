"""The gated update operator on a CPU, where nothing is differentiated: torch multiplies, and kernels do the rest.

Its twin is :meth:`dvo.nets.update.update.Update.forward`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dvo.map.edges import Groups, PatchGraph
from dvo.nets.update import update_kernels as kernels


def revise_by_kernels(
    update: Any, hidden: Tensor, context: Tensor, first: Tensor, graph: PatchGraph
) -> tuple[Tensor, Tensor, Tensor]:
    """State, flow revision and confidence of the edges of one clip.

    Args:
        update: the :class:`dvo.nets.update.update.Update`, of float32 or bfloat16.
        hidden, context: ``(E, D)`` float32.
        first: ``(E, D)`` output of the first layer of the correlation, of the type of the operator; is overwritten.
        graph: the edges and their neighbourhoods.

    Returns:
        State ``(E, D)`` float32, flow revision ``(E, 2)`` and confidence ``(E, 2)`` of the type of the operator.
    """
    encoder, recurrent = update.corr, update.gru
    seen = encoder[2](functional.relu_(first))
    kernels.normalise(_array(seen), *_norm(encoder[3]), True)
    seen = encoder[5](seen)
    net = torch.empty_like(seen)
    kernels.join(_array(hidden), _array(context), _array(seen), *_norm(update.norm), _array(net))
    beside, added = seen, _array(seen)[:0]
    for layers, index, has in (
        (update.c1, graph.previous, graph.has_previous), (update.c2, graph.following, graph.has_following)
    ):  # fmt: skip
        kernels.neighbours(_array(net), added, index.numpy(), has[:, 0].numpy(), _array(beside))
        found = layers[2](functional.relu_(layers[0](beside)))
        added = _array(found)
    net += found
    _aggregate(update.agg_kk, net, graph.by_patch)
    _aggregate(update.agg_ij, net, graph.by_pair)
    kernels.normalise(_array(net), *_norm(recurrent[0]), False)
    _gated(recurrent[1], net, recurrent[2])
    _gated(recurrent[3], net, None)
    return net.to(hidden.dtype), update.d(net), update.w(net)


def _aggregate(layer: Any, net: Tensor, groups: Groups) -> None:
    """Add the aggregation of its features to ``net``, in place."""
    pooled = net.new_empty(len(groups.members), net.shape[1])
    kernels.pool(
        _array(layer.f(net)), _array(layer.g(net)), groups.members.numpy(), groups.mask[..., 0].numpy(), _array(pooled)
    )
    kernels.spread(_array(net), _array(layer.h(pooled)), groups.group.numpy())


def _gated(layer: Any, net: Tensor, norm: nn.LayerNorm | None) -> None:
    """Apply a gated residual to ``net``, and perhaps a normalisation, in place."""
    residual = layer.res
    further = residual[2](functional.relu_(residual[0](net)))
    empty = _array(net)[0, :0]
    weight, bias, eps = (empty, empty, 0.0) if norm is None else _norm(norm)
    kernels.gate(_array(net), _array(layer.gate[0](net)), _array(further), weight, bias, eps)


def _norm(layer: nn.LayerNorm) -> tuple[Any, Any, float]:
    return _array(layer.weight.detach()), _array(layer.bias.detach()), layer.eps


def _array(x: Tensor) -> Any:
    """Values of a tensor, or bits of one of bfloat16."""
    return (x.view(torch.uint16) if x.dtype == torch.bfloat16 else x).numpy()
