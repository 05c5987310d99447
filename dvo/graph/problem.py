"""Bundle adjustment problem of a keyframe graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from dvo.graph.archive import ArchivedKeyframe
    from dvo.graph.keyframe_graph import KeyframeGraph


@dataclass(frozen=True)
class GraphProblem:
    """Bundle adjustment problem of archived keyframes: arguments of
    :func:`dvo.ba.global_adjust.global_bundle_adjust`.

    Attributes:
        identifiers: ``(N,)`` identifier of the keyframe of each pose.
        poses_cw: ``(N, 7)`` float64 world to camera.
        patches: ``(K, 3, 1, 1)`` float64 x, y (feature-map pixels), inverse depth.
        intrinsics: ``(N, 4)`` float64 of the feature maps.
        targets, weights: ``(E, 2)`` float64 measured positions of the patch centres (feature-map pixels), and their
            confidence.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch of each edge.
        measured: ``(K, 2)`` float64 inverse depths by a depth camera and their weights, 0 for none; None without any.
    """

    identifiers: np.ndarray
    poses_cw: Tensor
    patches: Tensor
    intrinsics: Tensor
    targets: Tensor
    weights: Tensor
    ii: Tensor
    jj: Tensor
    kk: Tensor
    measured: Tensor | None = None


def graph_problem(
    graph: KeyframeGraph, dropped: bool = True, segment: int = 0, first: int = 0, last: int | None = None
) -> GraphProblem:
    """Bundle adjustment problem of the archived keyframes and edges of a segment; see :meth:`KeyframeGraph.problem`."""
    edges = graph.archive.edges(first, last)
    linked = set(np.unique(np.concatenate([edges.source, edges.target])).tolist()) if first > 0 else set()
    frames = [
        frame
        for frame in graph.members(segment)
        if (frame.identifier >= first or frame.identifier in linked)
        and (last is None or frame.identifier <= last)
        and (dropped or frame.anchor is None)
    ]
    m = graph.window.per_frame
    identifiers = np.array([frame.identifier for frame in frames], dtype=np.int64)
    edges = edges.select(np.isin(edges.source, identifiers) & np.isin(edges.target, identifiers))
    ii, jj = np.searchsorted(identifiers, edges.source), np.searchsorted(identifiers, edges.target)
    patches = [np.column_stack([frame.centres, frame.inverse_depth]) for frame in frames]
    return GraphProblem(
        identifiers=identifiers,
        poses_cw=graph.poses_cw(identifiers),
        patches=torch.from_numpy(np.array(patches, dtype=np.float64)).reshape(len(frames) * m, 3, 1, 1),
        intrinsics=torch.from_numpy(np.array([f.intrinsics for f in frames], dtype=np.float64).reshape(-1, 4)),
        targets=torch.from_numpy(edges.position.astype(np.float64)),
        weights=torch.from_numpy(edges.weight.astype(np.float64)),
        ii=torch.from_numpy(ii),
        jj=torch.from_numpy(jj),
        kk=torch.from_numpy(ii * m + edges.patch),
        measured=_measured(frames, m),
    )


def _measured(frames: list[ArchivedKeyframe], per_frame: int) -> Tensor | None:
    """Measured inverse depths of all patches with their weights; None if there are none."""
    if all(frame.measured is None for frame in frames):
        return None
    none = np.zeros((per_frame, 2))
    return torch.from_numpy(np.concatenate([none if f.measured is None else f.measured for f in frames])).double()
