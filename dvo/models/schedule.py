"""Schedule of the edges of a training clip: the graph of each update.

A schedule does not depend on the data: it is built once and shared by all clips.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from dvo.map.edges import Groups, PatchGraph, build_graph


@dataclass(frozen=True)
class Stage:
    """One update of a schedule.

    Attributes:
        graph: the edges.
        frames: frames present, the first ones of the clip.
        carry: ``(E,)`` for each edge its index among the edges of the stage before, -1 for a new one; None if the
            edges are the same.
    """

    graph: PatchGraph
    frames: int
    carry: Tensor | None


def full_graph(frames: int, patches: int, self_edges: bool, reach: int | None = None) -> PatchGraph:
    """Graph that joins every patch with every frame, or with the frames at most ``reach`` away.

    Args:
        frames: number of frames.
        patches: number of patches in each frame.
        self_edges: join patches with their own frame too.
        reach: largest distance in frames; None for all.

    Returns:
        The graph; patch ``k`` belongs to frame ``k // patches``.
    """
    kk = torch.arange(frames * patches).repeat_interleave(frames)
    jj = torch.arange(frames).repeat(frames * patches)
    ii = kk // patches
    keep = torch.ones_like(ii, dtype=torch.bool) if self_edges else ii != jj
    if reach is not None:
        keep &= (ii - jj).abs() <= reach
    return build_graph(ii[keep], jj[keep], kk[keep])


def training_schedule(
    frames: int,
    patches: int,
    updates: int,
    initial: int | None = None,
    settle: int = 4,
    self_edges: bool = True,
    reach: int | None = None,
) -> list[Stage]:
    """Updates on a growing graph, as in tracking.

    Args:
        frames: frames of a clip.
        patches: patches a frame.
        updates: number of updates.
        initial: frames of the first graph (None: all of them, the non-streaming recipe).
        settle: updates on the first graph before one frame is added at every update.
        self_edges: see :class:`dvo.nets.patch.config.ModelConfig`.
        reach: see :func:`full_graph`.

    Returns:
        One stage for each update, on the CPU; consecutive stages of the same frames share their graph.
    """
    initial = frames if initial is None else min(initial, frames)
    stages: list[Stage] = []
    for update in range(updates):
        count = min(frames, initial + max(0, update - settle + 1))
        if stages and stages[-1].frames == count:
            stages.append(replace(stages[-1], carry=None))
            continue
        graph = full_graph(count, patches, self_edges, reach)
        carry = torch.full_like(graph.ii, -1)
        if stages:
            before = stages[-1].graph
            slot = torch.full((count * patches * count,), -1)
            slot[before.kk * count + before.jj] = torch.arange(len(before))
            carry = slot[graph.kk * count + graph.jj]
        stages.append(Stage(graph, count, carry if stages else None))
    return stages


def to_device(stages: list[Stage], device: torch.device | str) -> list[Stage]:
    """Copy of a schedule with its index tensors on another device.

    Args:
        stages: the schedule.
        device: of the copy.

    Returns:
        The copy; stages that share a graph still share it.
    """
    moved: dict[int, PatchGraph] = {}

    def move_groups(groups: Groups) -> Groups:
        return replace(groups, members=groups.members.to(device), mask=groups.mask.to(device),
                       group=groups.group.to(device))  # fmt: skip

    def move(graph: PatchGraph) -> PatchGraph:
        if id(graph) not in moved:
            values: dict[str, Any] = {f.name: getattr(graph, f.name) for f in fields(graph)}
            for name, value in values.items():
                values[name] = move_groups(value) if isinstance(value, Groups) else value.to(device)
            moved[id(graph)] = PatchGraph(**values)
        return moved[id(graph)]

    return [Stage(move(s.graph), s.frames, None if s.carry is None else s.carry.to(device)) for s in stages]
