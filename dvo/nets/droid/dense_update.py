"""Update operator of DROID-SLAM on whole feature maps (Teed and Deng, 2021, 3.2); submodules have its names.

For each edge, a pair of frames, a convolutional gated unit keeps a state at every pixel of the source frame; heads give
the revision of the flow and its confidence. The states of the edges of a frame are averaged into the damping of its
inverse depths and, for the networks that have one, an upsampling mask.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.nets.droid.droid import MASK, STRIDE, DroidConfig

MOTION_LIMIT = 64.0
"""Limit of the motion features, feature pixels."""
DAMPING_SCALE = 0.01
"""Factor of the predicted damping."""
_FIRST_DAMPING = -3.0  # bias of the damping head of a new network
_GRADIENT_LIMIT = 0.01  # of each element of a head's output, as published


@dataclass(frozen=True)
class DenseRevision:
    """Output of the update operator.

    Attributes:
        hidden: ``(B, E, D, h, w)`` new state.
        delta: ``(B, E, h, w, 2)`` revision of the flow, feature pixels.
        confidence: ``(B, E, h, w, 2)`` in (0, 1).
    """

    hidden: Tensor
    delta: Tensor
    confidence: Tensor


class GradientGate(nn.Module):
    """Identity whose gradient is clamped elementwise, with NaN replaced by 0, so that no pixel dominates the others."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the input unchanged.

        Args:
            x: any values.

        Returns:
            The same values.
        """
        x = x.view_as(x)
        if x.requires_grad:
            x.register_hook(_bounded)
        return x


def _bounded(gradient: Tensor) -> Tensor:
    return torch.nan_to_num(gradient, nan=0.0).clamp(-_GRADIENT_LIMIT, _GRADIENT_LIMIT)


class ConvGRU(nn.Module):
    """Convolutional gated recurrent unit with a global context: the gated mean of the state over the map.

    The context features of a frame are the same for all of its edges and in all updates. Their share of the
    convolutions is computed once a frame (:meth:`context_gates`). :meth:`forward_plain` is the published formula.

    Args:
        hidden: channels of the state, and of the context features.
        inputs: channels of the other inputs, correlation and motion.
    """

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.hidden = hidden
        for gate in "zrq":
            setattr(self, f"conv{gate}", nn.Conv2d(2 * hidden + inputs, hidden, 3, padding=1))
        self.w = nn.Conv2d(hidden, hidden, 1)
        for gate in "zrq":
            setattr(self, f"conv{gate}_glo", nn.Conv2d(hidden, hidden, 1))

    def _weights(self, part: slice, gates: str) -> Tensor:
        return torch.cat([getattr(self, f"conv{gate}").weight[:, part] for gate in gates])

    def context_gates(self, context: Float[Tensor, "n D h w"]) -> Float[Tensor, "n D*3 h w"]:
        """Share of the context features, and of the biases, in the three gates.

        Args:
            context: features of frames.

        Returns:
            Channels of update gate, reset gate and candidate, one after the other.
        """
        bias = torch.cat([getattr(self, f"conv{gate}").bias for gate in "zrq"])
        return F.conv2d(context, self._weights(slice(self.hidden, 2 * self.hidden), "zrq"), bias, padding=1)

    def forward(
        self, hidden: Float[Tensor, "n D h w"], gates: Float[Tensor, "n D*3 h w"], inputs: Float[Tensor, "n C h w"]
    ) -> Float[Tensor, "n D h w"]:
        """Update the state.

        Args:
            hidden: state of each edge.
            gates: of :meth:`context_gates`, of the source frame of each edge.
            inputs: correlation and motion features.

        Returns:
            New state.
        """
        d = self.hidden
        glo = (torch.sigmoid(self.w(hidden)) * hidden).mean((2, 3), keepdim=True)
        glo_gates = torch.cat([getattr(self, f"conv{gate}_glo")(glo) for gate in "zrq"], 1)
        x = gates + F.conv2d(inputs, self._weights(slice(2 * d, None), "zrq"), padding=1) + glo_gates
        of_hidden = F.conv2d(hidden, self._weights(slice(0, d), "zr"), padding=1)
        z, r = torch.sigmoid(x[:, : 2 * d] + of_hidden).split(d, 1)
        q = torch.tanh(x[:, 2 * d :] + F.conv2d(r * hidden, self._weights(slice(0, d), "q"), padding=1))
        return torch.lerp(hidden, q, z)

    def forward_plain(self, hidden: Tensor, context: Tensor, inputs: Tensor) -> Tensor:
        """Compute the same in the published order, the context with every edge and every update.

        Args:
            hidden, inputs: as in :meth:`forward`.
            context: features of the source frame of each edge.

        Returns:
            New state.
        """
        x = torch.cat([hidden, context, inputs], 1)
        glo = (torch.sigmoid(self.w(hidden)) * hidden).mean((2, 3), keepdim=True)

        def gate(name: str, x: Tensor) -> Tensor:
            return getattr(self, f"conv{name}")(x) + getattr(self, f"conv{name}_glo")(glo)

        z, r = torch.sigmoid(gate("z", x)), torch.sigmoid(gate("r", x))
        q = torch.tanh(gate("q", torch.cat([r * hidden, context, inputs], 1)))
        return (1 - z) * hidden + z * q


class GraphAggregation(nn.Module):
    """Mean of the states of all edges of a source frame, to the damping of the frame's inverse depths.

    Args:
        config: sizes of the network.
    """

    def __init__(self, config: DroidConfig) -> None:
        super().__init__()
        d = config.hidden_channels
        self.conv1, self.conv2 = nn.Conv2d(d, d, 3, padding=1), nn.Conv2d(d, d, 3, padding=1)
        first = nn.Conv2d(d, 1, 3, padding=1)
        # Training begins with weak damping: on small maps the one that a bias of zero gives exceeds the curvature of
        # the depths, and even exact flow would move them too little within the updates of a clip.
        nn.init.constant_(first.bias, _FIRST_DAMPING)  # type: ignore[arg-type]
        self.eta = nn.Sequential(first, GradientGate(), nn.Softplus())
        self.upmask: nn.Module | None = nn.Sequential(nn.Conv2d(d, MASK, 1)) if config.upsample else None

    def forward(
        self, hidden: Float[Tensor, "B E D h w"], ii: Int[Tensor, " E"], frames: int
    ) -> tuple[Float[Tensor, "B N h w"], Float[Tensor, "B N 576 h w"] | None]:
        """Aggregate over the edges of each frame.

        Args:
            hidden: state of each edge.
            ii: source frame of each edge.
            frames: number of frames.

        Returns:
            Damping, positive; of a frame without edges it means nothing. Upsampling mask, None without one.
        """
        b = len(hidden)
        x = F.relu(self.conv1(hidden.flatten(0, 1))).unflatten(0, (b, -1))
        count = torch.bincount(ii, minlength=frames).clamp(min=1).to(x.dtype)
        total = x.new_zeros(b, frames, *x.shape[2:]).index_add(1, ii, x)
        mean = F.relu(self.conv2((total / count[:, None, None, None]).flatten(0, 1)))
        damping = DAMPING_SCALE * self.eta(mean)[:, 0].unflatten(0, (b, frames))
        return damping, None if self.upmask is None else self.upmask(mean).unflatten(0, (b, frames))


class DenseUpdate(nn.Module):
    """Update operator; submodules have the names of DROID-SLAM's checkpoint.

    Args:
        config: sizes of the network.
    """

    def __init__(self, config: DroidConfig) -> None:
        super().__init__()
        d = config.hidden_channels
        self.corr_encoder = nn.Sequential(
            nn.Conv2d(config.correlation_channels, d, 1), nn.ReLU(), nn.Conv2d(d, d, 3, padding=1), nn.ReLU()
        )
        self.flow_encoder = nn.Sequential(
            nn.Conv2d(4, d, 7, padding=3), nn.ReLU(), nn.Conv2d(d, d // 2, 3, padding=1), nn.ReLU()
        )
        self.weight = nn.Sequential(*_head(d), nn.Sigmoid())
        self.delta = nn.Sequential(*_head(d))
        self.gru = ConvGRU(d, d + d // 2)
        self.agg = GraphAggregation(config)

    def forward(
        self,
        hidden: Float[Tensor, "B E D h w"],
        gates: Float[Tensor, "B E D*3 h w"],
        correlation: Float[Tensor, "B E c h w"],
        motion: Float[Tensor, "B E 4 h w"],
    ) -> DenseRevision:
        """Revise the flow of every pixel of every edge.

        Args:
            hidden: state.
            gates: of :meth:`ConvGRU.context_gates`, of the source frame of each edge.
            correlation: channels at the present positions.
            motion: flow, and target minus reprojection, feature pixels.

        Returns:
            New state, revision and confidence.
        """
        shape = hidden.shape[:2]
        seen = self.corr_encoder(correlation.flatten(0, 1))
        moved = self.flow_encoder(motion.flatten(0, 1).clamp(-MOTION_LIMIT, MOTION_LIMIT))
        net = self.gru(hidden.flatten(0, 1), gates.flatten(0, 1), torch.cat([seen, moved], 1))
        delta, confidence = (
            head(net).float().permute(0, 2, 3, 1).unflatten(0, shape) for head in (self.delta, self.weight)
        )
        return DenseRevision(net.unflatten(0, shape), delta, confidence)


def _head(channels: int) -> tuple[nn.Module, ...]:
    return (
        nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, 2, 3, padding=1), GradientGate(),
    )  # fmt: skip


def upsample_map(values: Float[Tensor, "n h w"], mask: Float[Tensor, "n 576 h w"]) -> Float[Tensor, "n h*8 w*8"]:
    """Raise maps to eight times the resolution by convex combinations of the nine nearest cells (RAFT 3.3).

    Args:
        values: maps.
        mask: logits; nine neighbours slowest, then row and column within the cell.

    Returns:
        The maps; pixel ``(8u + a, 8v + b)`` belongs to cell ``(u, v)``.
    """
    n, h, w = values.shape
    shares = mask.to(values.dtype).view(n, 9, STRIDE, STRIDE, h, w).softmax(1)
    near = F.unfold(values[:, None], 3, padding=1).view(n, 9, 1, 1, h, w)
    return (shares * near).sum(1).permute(0, 3, 1, 4, 2).reshape(n, STRIDE * h, STRIDE * w)
