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
from dvo.nets.update.int8 import Array, Int8Linear, Rows, array_of, pack_rows


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
    seen = _linear(encoder[2], first, rectified=True)
    kernels.normalise(array_of(seen), *_norm(encoder[3]), True)
    seen = _linear(encoder[5], seen)
    net = torch.empty_like(first)
    values = array_of(net)
    kernels.join(hidden.numpy(), context.numpy(), array_of(seen), *_norm(update.norm), values)
    found = values[:0]
    for layers, index, has in (
        (update.c1, graph.previous, graph.has_previous), (update.c2, graph.following, graph.has_following)
    ):  # fmt: skip
        beside = torch.empty_like(first)
        kernels.neighbours(values, found, index.numpy(), has[:, 0].numpy(), array_of(beside))
        found = array_of(_linear(layers[2], _linear(layers[0], beside), rectified=True))
    kernels.add(values, found)
    for layer, groups in ((update.agg_kk, graph.by_patch), (update.agg_ij, graph.by_pair)):
        _aggregate(layer, net, values, groups)
    kernels.normalise(values, *_norm(recurrent[0]), False)
    _gated(recurrent[1], net, values, recurrent[2])
    _gated(recurrent[3], net, values, None)
    return net.to(hidden.dtype), update.d(net), update.w(net)


def _aggregate(layer: Any, net: Tensor, values: Array, groups: Groups) -> None:
    """Add the aggregation of its features to ``net``, whose values are ``values``."""
    pooled, given = net.new_empty(len(groups.members), net.shape[1]), _shared(layer.f, net, values)
    value, score = (array_of(_linear(x, given)) for x in (layer.f, layer.g))
    kernels.pool(value, score, groups.members.numpy(), groups.mask[..., 0].numpy(), array_of(pooled))
    kernels.spread(values, array_of(_linear(layer.h, pooled)), groups.group.numpy())


def _gated(layer: Any, net: Tensor, values: Array, norm: nn.LayerNorm | None) -> None:
    """Apply a gated residual to ``net``, whose values are ``values``, and perhaps a normalisation."""
    residual, given = layer.res, _shared(layer.gate[0], net, values)
    further = _linear(residual[2], _linear(residual[0], given), rectified=True)
    empty = values[0, :0]
    weight, bias, eps = (empty, empty, 0.0) if norm is None else _norm(norm)
    kernels.gate(values, array_of(_linear(layer.gate[0], given)), array_of(further), weight, bias, eps)


def _norm(layer: nn.LayerNorm) -> tuple[Any, Any, float]:
    return array_of(layer.weight.detach()), array_of(layer.bias.detach()), layer.eps


def _shared(layer: nn.Linear, x: Tensor, values: Array) -> Tensor | Rows:
    """What this layer and others like it take: ``x``, or its values rounded once for all of them."""
    return pack_rows(values) if isinstance(layer, Int8Linear) else x


def _linear(layer: nn.Linear, given: Tensor | Array | Rows, *, rectified: bool = False) -> Tensor | Array:
    """Apply a layer to numbers, perhaps rectified (in place), or to what :func:`_shared` gives."""
    if isinstance(layer, Int8Linear):
        return layer.multiply(given if isinstance(given, Rows) else pack_rows(given, rectified=rectified))
    assert isinstance(given, Tensor)
    found: Tensor = layer(functional.relu_(given) if rectified else given)
    return found
