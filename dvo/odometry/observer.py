"""State of an odometry that can be read of an odometry between two frames."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.odometry.protocol import Odometry


@runtime_checkable
class HasGraph(Protocol):
    """Interface of an odometry whose keyframe graph can be read between two frames."""

    graph: KeyframeGraph


def graph_of(odometry: Odometry) -> KeyframeGraph | None:
    """Keyframe graph of an odometry.

    Args:
        odometry: any.

    Returns:
        The graph; None if it has none.
    """
    if isinstance(odometry, HasGraph) and isinstance(odometry.graph, KeyframeGraph):
        return odometry.graph
    return None
