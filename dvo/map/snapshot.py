"""Snapshot of the archived part of a keyframe graph, for work beside tracking.

Archived keyframes and measurements are never changed in place, only replaced. A snapshot refers to them, which takes
next to no time; the copy that can be corrected is made where the work is done.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from dvo.map.archive import ArchiveConfig, ArchivedKeyframe
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.measurements import PackedEdges
from dvo.map.recording import Recording

_UNBOUNDED = 2**62  # bytes: a copy of what is within the bound of an archive


@dataclass(frozen=True)
class Snapshot:
    """Archived keyframes and measurements of a graph at one time; see :class:`KeyframeGraph`.

    Attributes:
        per_frame: patches of a keyframe.
        keyframes: in the order in which they were archived.
        parts: measurements, oldest first.
        segment, starts, worlds, loops, recordings: as those of the graph.
    """

    per_frame: int
    keyframes: tuple[ArchivedKeyframe, ...]
    parts: tuple[PackedEdges, ...]
    segment: int
    starts: tuple[tuple[int, int], ...]
    worlds: tuple[tuple[int, int], ...]
    loops: int
    recordings: tuple[Recording, ...]

    @classmethod
    def of(cls, graph: KeyframeGraph) -> Snapshot:
        """Snapshot of a graph, by references.

        Args:
            graph: with any window, which is left out.
        """
        return cls(
            graph.window.per_frame, tuple(graph.archive.keyframes), tuple(graph.archive.parts), graph.segment,
            tuple(graph.starts), tuple(graph.worlds.items()), graph.loops, tuple(graph.recordings),
        )  # fmt: skip

    def graph(self) -> KeyframeGraph:
        """Copy with an empty window and without features, images and a log of frames, to be corrected at will."""
        copy = KeyframeGraph(self.per_frame, 1, 1, torch.device("cpu"), ArchiveConfig(_UNBOUNDED, False, False))
        for keyframe in self.keyframes:
            copy.archive.add(replace(keyframe, matching=None, context=None, jpeg=None))
        for part in self.parts:
            copy.archive.add_part(part)
        copy.segment, copy.starts, copy.worlds = self.segment, list(self.starts), dict(self.worlds)
        copy.loops, copy.recordings = self.loops, list(self.recordings)
        return copy
