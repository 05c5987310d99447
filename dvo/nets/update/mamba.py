"""State-space update operator: selective scans in place of gated units and soft aggregation.

MambaVO (Wang et al., arXiv 2412.20082) refines the matches of a point over the frames of a window by Mamba blocks (Gu
and Dao, arXiv 2312.00752) and keeps a history of each point. Here the blocks work on the edges of a patch graph:

- :class:`GroupScan` over the edges of a patch by target frame, and over the edges of a frame pair by patch: what DPVO's
  neighbour layers and soft aggregations do. Half of the channels are scanned forwards, half backwards, so that every
  edge sees the whole group;
- :class:`History` over the updates of an edge: the state of the operator is the state of this recurrence, kept from
  update to update. It takes the place of the gated units.

Differences from MambaVO, as far as a reproduction by others (mohamyt/MambaVO-RRR) shows it: an edge, and not a point,
has the history; the history is a state-space recurrence too, in place of cross attention and a gated unit; the
zero-order hold is exact (:mod:`dvo.nets.update.selective_scan`). Matching of a new frame with the nearest keyframe is a
setting of the tracker (``initial_pose``), since it needs no state of the operator.

Chosen by ``update_operator: mamba`` in :class:`dvo.nets.patch.config.ModelConfig`.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.core.errors import DvoError
from dvo.map.edges import Groups, PatchGraph, ordered
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.patch.config import ModelConfig
from dvo.nets.update.selective_scan import selective_scan, selective_step
from dvo.nets.update.update import confidence_head, correlation_layers, encode_correlation, revision_head

GROUP_STATES = 4
"""States of a channel in a scan over a group; sequences are short (the lifetime of a patch, the patches of a frame)."""
HISTORY_STATES = 2
"""States of a channel in the history of an edge: ``hidden_channels`` numbers are this many of half as many channels."""
STEPS = (0.05, 0.5)
"""Steps at the start of training: with rates of 1 to 4, memories of half a position to 20 positions."""
LOG_RATES = (-8.0, 8.0)
"""Range of the logarithm of the rates, which keeps rates and their reciprocals finite."""


def initial_step_bias(channels: int) -> Tensor:
    """Biases whose softplus is spread evenly, on a logarithmic scale, over :data:`STEPS`; Mamba draws them at random.

    Args:
        channels: number of biases.

    Returns:
        ``(channels,)``.
    """
    steps = torch.linspace(math.log(STEPS[0]), math.log(STEPS[1]), channels).exp()
    return steps.expm1().log()  # the inverse of the softplus


class Selection(nn.Module):
    """Input-dependent parts of a selective state-space layer: steps and vectors, and its constant rates.

    Args:
        channels: of the layer, a multiple of the directions.
        states: of each channel.
        directions: number of pairs of vectors; each is for as many channels, with the same steps at the start.
    """

    def __init__(self, channels: int, states: int, directions: int = 1) -> None:
        super().__init__()
        self.sizes = [max(1, math.ceil(channels / 16)), *[states] * (2 * directions)]
        self.project = nn.Linear(channels, sum(self.sizes))
        self.step = nn.Linear(self.sizes[0], channels)
        self.log_rate = nn.Parameter(torch.arange(1.0, states + 1).log()[:, None].repeat(1, channels))
        self.skip = nn.Parameter(torch.ones(channels))
        with torch.no_grad():
            self.step.bias.copy_(initial_step_bias(channels // directions).repeat(directions))

    @property
    def rate(self) -> Tensor:
        """``(states, channels)`` positive rates."""
        return self.log_rate.clamp(*LOG_RATES).exp()

    def forward(self, x: Float[Tensor, "B E C"]) -> tuple[Tensor, list[Tensor]]:
        """Select.

        Args:
            x: inputs of the recurrence.

        Returns:
            Steps ``(B, E, C)``, and the vectors ``(B, E, N)``: how the inputs are written, of each direction, then how
            the states are read.
        """
        low, *vectors = self.project(x).split(self.sizes, dim=-1)
        return F.softplus(self.step(low)), vectors


class GroupScan(nn.Module):
    """Residual Mamba block over groups of edges, in both directions.

    As in Mamba: projection to inputs and gates, short convolution along the sequence, selective recurrence, gate,
    projection. Half of the channels are scanned in the order of the ranks, half in the opposite one.

    Args:
        channels: of input and output, even.
        convolution: mix the inputs of an edge with those of its neighbours in time (a depthwise convolution of width 3
            over the edges of a patch) before the scan.
    """

    def __init__(self, channels: int, convolution: bool) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels, eps=1e-3)
        self.enter = nn.Linear(channels, 2 * channels)
        self.select = Selection(channels, GROUP_STATES, directions=2)
        self.leave = nn.Linear(channels, channels)
        self.taps = nn.Parameter(torch.tensor([[0.1], [1.0], [0.1]]).repeat(1, channels)) if convolution else None

    def forward(self, x: Float[Tensor, "B E C"], groups: Groups, rank: Int[Tensor, " E"], graph: PatchGraph) -> Tensor:
        """Apply the block.

        Args:
            x: features of the edges.
            groups: partition of the ``E`` edges.
            rank: by which the edges of a group are ordered; different for all edges of a group.
            graph: neighbours of the edges in time.

        Returns:
            ``(B, E, C)``; the same for an edge in whatever order the edges are given.
        """
        inputs, gate = self.enter(self.norm(x)).chunk(2, dim=-1)
        if self.taps is not None:
            before = inputs.index_select(1, graph.previous) * graph.has_previous
            after = inputs.index_select(1, graph.following) * graph.has_following
            inputs = self.taps[0] * before + self.taps[1] * inputs + self.taps[2] * after
        inputs = F.silu(inputs)
        mixed = self._scan(inputs, ordered(groups, rank)) + self.select.skip * inputs
        return x + self.leave(mixed.to(gate.dtype) * F.silu(gate))

    def _scan(self, inputs: Tensor, groups: Groups) -> Tensor:
        if inputs.shape[1] == 0:
            return inputs
        step, vectors = self.select(inputs)
        members, mask = groups.members, groups.mask

        def padded(*values: Tensor) -> Tensor:
            return torch.cat(values, -1).index_select(1, members.flatten()).unflatten(1, members.shape)

        half = inputs.shape[-1] // 2
        x, steps = padded(inputs), padded(step) * mask  # a step of zero passes the padding over
        forward, backward = padded(vectors[0], vectors[2]), padded(vectors[1], vectors[3])
        write, read = torch.stack([forward, backward.flip(2)]).chunk(2, dim=-1)
        y, _ = selective_scan(
            torch.stack([x[..., :half], x[..., half:].flip(2)]),
            torch.stack([steps[..., :half], steps[..., half:].flip(2)]),
            self.select.rate.unflatten(1, (2, half)).movedim(1, 0)[:, None, None, None],
            write,
            read,
        )
        y = torch.cat([y[0], y[1].flip(2)], -1).flatten(1, 2)
        return y.index_select(1, places(members, mask[..., 0], inputs.shape[1]))


class History(nn.Module):
    """Residual Mamba block over the updates of an edge; its state is what the edge carries from update to update.

    Args:
        channels: of input and output, and numbers in the state.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // HISTORY_STATES
        self.norm = nn.LayerNorm(channels, eps=1e-3)
        self.enter = nn.Linear(channels, 2 * inner)
        self.select = Selection(inner, HISTORY_STATES)
        self.leave = nn.Linear(inner, channels)

    def inputs(self, x: Float[Tensor, "B E D"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Inputs of the recurrence.

        Args:
            x: features of the edges in one update.

        Returns:
            Inputs and steps ``(B, E, C)``, vectors for writing and reading ``(B, E, N)``, gates ``(B, E, C)``.
        """
        inputs, gate = self.enter(self.norm(x)).chunk(2, dim=-1)
        inputs = F.silu(inputs)
        step, (write, read) = self.select(inputs)
        return inputs, step, write, read, gate

    def forward(self, x: Float[Tensor, "B E D"], hidden: Float[Tensor, "B E D"]) -> tuple[Tensor, Tensor]:
        """Take one position of the recurrence.

        Args:
            x: features of the edges.
            hidden: state of each edge, zero for a new one.

        Returns:
            Features ``(B, E, D)``, and the new state ``(B, E, D)``.
        """
        inputs, step, write, read, gate = self.inputs(x)
        state = hidden.unflatten(-1, (HISTORY_STATES, -1))
        y, state = selective_step(inputs, step, self.select.rate, write, read, state)
        mixed = (y + self.select.skip * inputs).to(gate.dtype)
        return x + self.leave(mixed * F.silu(gate)), state.flatten(-2)


class MambaUpdate(nn.Module):
    """Update operator of selective state-space blocks, see :mod:`dvo.nets.update.mamba`.

    Encoder of the correlation and heads are those of :class:`dvo.nets.update.update.Update`. Two edges of a graph must
    not join the same patch with the same frame.

    Args:
        config: sizes of the network.

    Raises:
        DvoError: an odd number of hidden channels.

    Example:
        >>> config = replace(preset("tiny"), update_operator="mamba")
        >>> update = MambaUpdate(config)
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
        if dim % 2:
            message = f"must be even for this update operator, got {dim}"
            raise DvoError(message, field="hidden_channels", remedy="give an even number")
        self.window = 2 * config.radius + 1
        self.corr = correlation_layers(config)
        self.recall = nn.Linear(dim, dim, bias=False)
        self.norm = nn.LayerNorm(dim, eps=1e-3)
        self.patch_scan = GroupScan(dim, convolution=True)
        self.pair_scan = GroupScan(dim, convolution=False)
        self.history = History(dim)
        self.out = nn.LayerNorm(dim, eps=1e-3)
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
            hidden: state of each edge's recurrence over the updates, zero for a new edge.
            context: context features of the edge's patch.
            correlation: see :mod:`dvo.nets.correlation.correlation`.
            graph: the edges and their neighbourhoods, in any order.

        Returns:
            New state ``(B, E, D)``, flow revision ``(B, E, 2)`` in feature pixels, confidence ``(B, E, 2)`` in (0, 1).
        """
        found = encode_correlation(self.corr, correlation, self.window)
        net = self.norm(self.recall(hidden) + context + found)
        net = self.patch_scan(net, graph.by_patch, graph.jj, graph)
        net = self.pair_scan(net, graph.by_pair, graph.kk, graph)
        net, hidden = self.history(net, hidden)
        net = self.out(net)
        return hidden, self.d(net), self.w(net)


def places(members: Int[Tensor, "G M"], mask: Bool[Tensor, "G M"], edges: int) -> Int[Tensor, " E"]:
    """Place of each edge in the padded, flattened groups.

    Args:
        members: edge indices of the groups.
        mask: True where a member is real.
        edges: number of edges; each is a member of one group.

    Returns:
        Indices into ``G * M`` places.
    """
    slots = torch.where(mask, members, edges).flatten()  # padding goes to a place of its own
    found = torch.empty(edges + 1, dtype=torch.long, device=members.device)
    found[slots] = torch.arange(len(slots), device=members.device)
    return found[:edges]
