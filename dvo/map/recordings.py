"""Recordings of a keyframe graph: sequences that were tracked one after the other in the same map.

Each has a clock of its own: times increase within a recording, those of two recordings have nothing to do with each
other. Frames, keyframes and segments are numbered on. The keyframes of earlier recordings are the map of the last one,
which does not move them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dvo.map.archive import ArchivedKeyframe
from dvo.map.map import Map, Recording


def begin_recording(graph: Map) -> Recording:
    """Begin a recording in a graph whose window is empty, with the segment that has been begun last.

    Args:
        graph: all frames so far are those of earlier recordings.

    Returns:
        The recording.
    """
    recording = Recording(len(graph.log.frames), graph.starts[-1][0], graph.segment)
    graph.recordings.append(recording)
    return recording


def increase(times: np.ndarray, first: Sequence[int]) -> bool:
    """Find out if times increase within each recording.

    Args:
        times: ``(N,)`` seconds.
        first: position of the first time of each recording.

    Returns:
        True if they do.
    """
    rising = np.diff(times) > 0
    rising[[at - 1 for at in first if 0 < at < len(times)]] = True
    return bool(rising.all())


def increasing_times(graph: Map, frames: Sequence[ArchivedKeyframe]) -> Tensor:
    """Times of keyframes on one clock, on which recordings follow each other a second apart.

    Args:
        graph: of the keyframes.
        frames: by increasing identifier.

    Returns:
        ``(N,)`` float64 seconds; those of the last recording are its own.
    """
    times = np.array([frame.timestamp for frame in frames], dtype=np.float64)
    identifiers = np.array([frame.identifier for frame in frames], dtype=np.int64)
    for at in reversed(np.searchsorted(identifiers, [recording.keyframe for recording in graph.recordings[1:]])):
        if 0 < at < len(times):
            times[:at] += times[at] - 1.0 - times[at - 1]
    return torch.from_numpy(times)


def count_earlier(graph: Map, identifiers: np.ndarray) -> int:
    """Count the keyframes of earlier recordings.

    Args:
        graph: of the keyframes.
        identifiers: ``(N,)`` increasing.

    Returns:
        Number of those that lie before the last recording.
    """
    return int(np.searchsorted(identifiers, graph.recording.keyframe))
