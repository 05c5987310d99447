"""Beginning of a recording in a keyframe graph, see :mod:`dvo.map.recordings`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Recording:
    """Beginning of a recording.

    Attributes:
        frame: position of its first frame in the log.
        keyframe: identifier of its first keyframe; those from it on belong to it, or to later recordings.
        segment: number of its first segment.
    """

    frame: int = 0
    keyframe: int = 0
    segment: int = 0
