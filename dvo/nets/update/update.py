"""Gated recurrent update operator (DPVO 3.2): correlation to flow revision and confidence, with a state for each edge.

A module with the signature of :class:`UpdateOperator` can replace it: the ``update_operator`` of a model's
configuration is a name in :data:`UPDATE_OPERATORS`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dvo.core.kernels import is_transformed, use_kernels
from dvo.core.registry import Registry
from dvo.map.edges import Groups, PatchGraph
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.patch.config import ModelConfig
from dvo.nets.update.int8 import Int8Linear, has_kernels

UPDATE_OPERATORS = Registry(
    "update operator",
    "dvo.update_operators",
    {"gated": "dvo.nets.update.update:Update", "mamba": "dvo.nets.update.mamba:MambaUpdate"},
)
"""Names to ``"module:Class"`` of an :class:`UpdateOperator` whose constructor takes a :class:`ModelConfig`."""


class UpdateOperator(Protocol):
    """Interface of an update operator."""

    def __call__(
        self, hidden: Tensor, context: Tensor, correlation: Correlation, graph: PatchGraph
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Revise the flow of every edge.

        Args:
            hidden: ``(B, E, D)`` state, zero for a new edge.
            context: ``(B, E, D)`` context features of the patch of each edge.
            correlation: see :class:`dvo.nets.correlation.correlation.Correlation`.
            graph: the edges and their neighbourhoods.

        Returns:
            New state ``(B, E, D)``, flow revision ``(B, E, 2)`` in feature pixels, confidence ``(B, E, 2)`` in (0, 1).
        """
        ...


class _ClampGradient(torch.autograd.Function):
    """Identity whose gradient is clamped, with NaN replaced by 0, so that one bad edge cannot dominate the others."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, limit: float) -> Tensor:
        ctx.limit = limit
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return torch.nan_to_num(grads[0], nan=0.0).clamp(-ctx.limit, ctx.limit), None


class GradientClamp(nn.Module):
    """Identity whose gradient is clamped elementwise to ``+-0.01 / batch``.

    The limit of a batch of one is 0.01; it is scaled because the loss is a mean over clips.
    """

    def forward(self, x: Float[Tensor, "B E c"]) -> Tensor:
        """Return the input unchanged.

        Args:
            x: any values.

        Returns:
            The same values.
        """
        return _ClampGradient.apply(x, 0.01 / x.shape[0])


class GatedResidual(nn.Module):
    """Residual block whose residual is multiplied by a learned gate (DPVO 3.2).

    Args:
        channels: of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gate = nn.Sequential(nn.Linear(channels, channels), nn.Sigmoid())
        self.res = nn.Sequential(nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block.

        Args:
            x: ``(..., channels)``.

        Returns:
            ``(..., channels)``.
        """
        return torch.addcmul(x, self.gate(x), self.res(x))


class SoftAggregation(nn.Module):
    """Per-channel softmax-weighted sum over each group of edges, returned to every member of the group (DPVO 3.2).

    Args:
        channels: of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.f = nn.Linear(channels, channels)
        self.g = nn.Linear(channels, channels)
        self.h = nn.Linear(channels, channels)

    def forward(self, x: Float[Tensor, "B E c"], groups: Groups) -> Tensor:
        """Aggregate over groups.

        Args:
            x: features of the edges.
            groups: partition of the ``E`` edges.

        Returns:
            ``(B, E, c)``, equal for all members of a group.
        """
        shape = (*groups.members.shape, x.shape[-1])
        flat = groups.members.flatten()
        value = self.f(x).index_select(1, flat).unflatten(1, shape[:2])
        score = self.g(x).index_select(1, flat).unflatten(1, shape[:2])
        if not groups.full:
            score = score.masked_fill(~groups.mask, -torch.inf)
        pooled = (value * torch.softmax(score, dim=2)).sum(dim=2)
        return self.h(pooled).index_select(1, groups.group)


def correlation_layers(config: ModelConfig) -> nn.Sequential:
    """Layers from the correlation of an edge to as many features as its state has, for :func:`encode_correlation`.

    Args:
        config: sizes of the network.

    Returns:
        The layers, with random weights.
    """
    dim = config.hidden_channels
    return nn.Sequential(
        nn.Linear(config.correlation_channels, dim),
        nn.ReLU(),
        nn.Linear(dim, dim),
        nn.LayerNorm(dim, eps=1e-3),
        nn.ReLU(),
        nn.Linear(dim, dim),
    )


def first_layer(layer: nn.Linear, correlation: Correlation, taps: int) -> Tensor:
    """Apply the first layer, level by level, because DPVO's weights interleave the levels (level fastest).

    Args:
        layer: of all correlation channels.
        correlation: see :mod:`dvo.nets.correlation.correlation`.
        taps: side of the window of offsets, ``2 radius + 1``.

    Returns:
        ``(B, E, D)``.
    """
    levels = correlation.levels
    if isinstance(layer, Int8Linear):
        ordered = partial(_ordered, layer.weight, len(levels), correlation.order, taps)
        return layer.of_parts(levels, correlation.order, lambda: torch.cat(ordered(), 1))
    weights = _weights_of_levels(layer, correlation, taps)
    learn = correlation.learn
    plain = learn is None or is_transformed() or torch.is_autocast_enabled(learn.device.type)
    linear = functional.linear if plain else partial(_Learnt.apply, learn)
    out: Tensor = linear(levels[0].to(layer.weight.dtype), weights[0], layer.bias)
    for level, weight in zip(levels[1:], weights[1:], strict=True):
        out = out + linear(level.to(layer.weight.dtype), weight, None)
    return out


_ORDERED: WeakKeyDictionary[nn.Linear, tuple[tuple[int | str, ...], Tensor, tuple[Tensor, ...]]] = WeakKeyDictionary()
"""Weights of first layers in the order of a correlation, with what they were made from (a change by ``weight.data``
counts as no version): copying them in each step of a tracker takes as long as multiplying by them."""


def _weights_of_levels(layer: nn.Linear, correlation: Correlation, taps: int) -> tuple[Tensor, ...]:
    """Weights of a first layer for each level."""
    weight, count = layer.weight, len(correlation.levels)
    records = torch.is_grad_enabled() and weight.requires_grad
    if records or weight.is_inference() or is_transformed() or torch.jit.is_tracing():  # or has no version
        return _ordered(weight, count, correlation.order, taps)
    made_of = weight.data_ptr(), weight._version, count, correlation.order
    found = _ORDERED.get(layer)
    on_cpu = weight.device.type == "cpu"  # elsewhere a comparison would wait for the device
    if found is None or found[0] != made_of or on_cpu and not torch.equal(found[1], weight):
        ordered = tuple(x.contiguous() for x in _ordered(weight, count, correlation.order, taps))
        found = _ORDERED[layer] = made_of, weight.detach().clone(), ordered
    return found[2]


def _ordered(weight: Tensor, levels: int, order: str, taps: int) -> tuple[Tensor, ...]:
    table = weight.unflatten(1, (-1, levels))
    if order == "pixels_first":
        table = table.unflatten(1, (taps, taps, -1)).permute(0, 3, 2, 1, 4).flatten(1, 3)
    return table.unbind(-1)


class _Learnt(torch.autograd.Function):
    """A linear layer whose input receives a gradient in the rows ``learn`` alone, and zeros elsewhere."""

    @staticmethod
    def forward(ctx: Any, learn: Tensor, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(x, weight, learn)
        return functional.linear(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, learn = ctx.saved_tensors
        grad, by_x, by_weight, by_bias = grads[0].flatten(0, 1), None, None, None
        if ctx.needs_input_grad[1]:
            by_x = torch.zeros_like(x).flatten(0, 1).index_add_(0, learn, grad[learn] @ weight).view(x.shape)
        if ctx.needs_input_grad[2]:
            by_weight = grad.mT @ x.flatten(0, 1)
        if ctx.needs_input_grad[3]:
            by_bias = grad.sum(0)
        return None, by_x, by_weight, by_bias


def encode_correlation(layers: nn.Sequential, correlation: Correlation, taps: int) -> Tensor:
    """Encode the correlation of every edge.

    Args:
        layers: see :func:`correlation_layers`.
        correlation: see :mod:`dvo.nets.correlation.correlation`.
        taps: see :func:`first_layer`.

    Returns:
        ``(B, E, D)``.
    """
    first = layers[0]
    assert isinstance(first, nn.Linear)
    return layers[1:](first_layer(first, correlation, taps))


def revision_head(channels: int) -> nn.Sequential:
    """Layers from the features of an edge to its flow revision, feature pixels.

    Args:
        channels: of the features.
    """
    return nn.Sequential(nn.ReLU(), nn.Linear(channels, 2), GradientClamp())


def confidence_head(channels: int) -> nn.Sequential:
    """Layers from the features of an edge to its confidence, in (0, 1).

    Args:
        channels: of the features.
    """
    return nn.Sequential(nn.ReLU(), nn.Linear(channels, 2), GradientClamp(), nn.Sigmoid())


class Update(nn.Module):
    """Update operator of DPVO; submodules have the names of DPVO's checkpoint.

    Args:
        config: sizes of the network.

    Example:
        >>> config = preset("tiny")
        >>> update = Update(config)
        >>> graph = full_graph(frames=2, patches=3, self_edges=False)
        >>> hidden = context = torch.zeros(1, len(graph), config.hidden_channels)
        >>> channels = config.correlation_channels // len(config.pyramid)
        >>> correlation = Correlation([torch.zeros(1, len(graph), channels) for _ in config.pyramid])
        >>> hidden, delta, weights = update(hidden, context, correlation, graph)
        >>> delta.shape
        torch.Size([1, 6, 2])
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        dim = config.hidden_channels
        self.taps = 2 * config.radius + 1
        self.c1 = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim))
        self.c2 = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim))
        self.norm = nn.LayerNorm(dim, eps=1e-3)
        self.agg_kk = SoftAggregation(dim)
        self.agg_ij = SoftAggregation(dim)
        self.gru = nn.Sequential(
            nn.LayerNorm(dim, eps=1e-3), GatedResidual(dim), nn.LayerNorm(dim, eps=1e-3), GatedResidual(dim)
        )
        self.corr = correlation_layers(config)
        self.d, self.w = revision_head(dim), confidence_head(dim)

    def forward(
        self,
        hidden: Float[Tensor, "B E D"],
        context: Float[Tensor, "B E D"],
        correlation: Correlation,
        graph: PatchGraph,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Revise the flow of every edge.

        Args:
            hidden: state, zero for a new edge.
            context: context features of the edge's patch.
            correlation: see :mod:`dvo.nets.correlation.correlation`.
            graph: the edges and their neighbourhoods.

        Returns:
            New state ``(B, E, D)``, flow revision ``(B, E, 2)`` in feature pixels, confidence ``(B, E, 2)`` in (0, 1).
        """
        dtype = self.norm.weight.dtype
        if len(hidden) == 1 and hidden.shape[1] and self._takes_kernels(hidden, context):
            from dvo.nets.update.fast_update import revise_by_kernels

            first = self.corr[0]
            assert isinstance(first, nn.Linear)
            seen = first_layer(first, correlation, self.taps)
            given = hidden[0].contiguous(), context[0].contiguous(), seen[0], graph
            state, delta, confidence = (x[None].to(hidden.dtype) for x in revise_by_kernels(self, *given))
            return state, delta, confidence
        state, has_previous, has_following = (
            x.to(dtype) for x in (hidden + context, graph.has_previous, graph.has_following)
        )
        net = self.norm(state + encode_correlation(self.corr, correlation, self.taps))
        # The mask multiplies the input, so an edge without a neighbour still receives c(0) (as DPVO's weights expect).
        net = net + self.c1(net.index_select(1, graph.previous) * has_previous)
        net = net + self.c2(net.index_select(1, graph.following) * has_following)
        net = net + self.agg_kk(net, graph.by_patch)
        net = net + self.agg_ij(net, graph.by_pair)
        net = self.gru(net)
        revised = net, self.d(net), self.w(net)
        if dtype == hidden.dtype:  # autocast gives what it computed
            return revised
        state, delta, confidence = (x.to(hidden.dtype) for x in revised)
        return state, delta, confidence

    def _takes_kernels(self, *given: Tensor) -> bool:
        """True where nothing is differentiated, on a CPU (:mod:`dvo.nets.update.fast_update`)."""
        plain = not torch.is_grad_enabled() and not torch.is_autocast_enabled("cpu")
        plain = plain and not (isinstance(self.corr[0], Int8Linear) and not has_kernels())
        return plain and self.norm.weight.dtype in (torch.float32, torch.bfloat16) and use_kernels(*given)
