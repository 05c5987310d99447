"""Snapshot of a map, for work beside tracking.

Archived keyframes and measurements are never changed in place, only replaced. A snapshot refers to them, which takes
next to no time; the copy that can be corrected is made where the work is done.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from dvo.map.archive import ArchiveConfig, ArchivedKeyframe
from dvo.map.map import Map, Recording
from dvo.map.measurements import PackedEdges

_UNBOUNDED = 2**62  # bytes: a copy of what is within the bound of an archive


@dataclass(frozen=True)
class Snapshot:
    """Archived keyframes and measurements of a map at one time; see :class:`dvo.map.map.Map`.

    Attributes:
        per_frame: patches of a keyframe.
        keyframes: in the order in which they were archived.
        parts: measurements, oldest first.
        segment, starts, worlds, loops, recordings: as those of the map.
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
    def of(cls, source: Map) -> Snapshot:
        """Snapshot of a map, by references.

        Args:
            source: the map.
        """
        return cls(
            source.per_frame, tuple(source.archive.keyframes), tuple(source.archive.parts), source.segment,
            tuple(source.starts), tuple(source.worlds.items()), source.loops, tuple(source.recordings),
        )  # fmt: skip

    def map(self) -> Map:
        """Copy without features, images and a log of frames, to be corrected at will."""
        copy = Map(self.per_frame, ArchiveConfig(_UNBOUNDED, False, False))
        for keyframe in self.keyframes:
            copy.archive.add(replace(keyframe, matching=None, context=None, jpeg=None, mask=None))
        for part in self.parts:
            copy.archive.add_part(part)
        copy.segment, copy.starts, copy.worlds = self.segment, list(self.starts), dict(self.worlds)
        copy.loops, copy.recordings = self.loops, list(self.recordings)
        return copy
