"""Plot of a tracked clip: one panel for each world that its segments live in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import Alignment, align_trajectory, associate, evaluate, fit_alignment
from dvo.odometry.protocol import Result, Segment
from dvo.viz.plot import Panel, Track, plot_panels

MAX_TRACKS = 6  # segments of one picture; a further one would be too small to see


def draw(path: Path, result: Result, groundtruth: Trajectory | None, *, title: str, subtitle: str, label: str) -> None:
    """Draw the segments of a result, at most the :data:`MAX_TRACKS` longest.

    With a ground truth every segment is aligned with it on its own (Sim(3), in metres SE(3)) and all share a panel; a
    segment that cannot be aligned is left out. Without one, segments with unrelated worlds get panels of their own.

    Args:
        path: image to write.
        result: of the odometry.
        groundtruth: camera to world, metres; None if there is none.
        title, subtitle: texts above the plot.
        label: name of the odometry in the legend.
    """
    chosen = _longest(result)
    panels = _panels_with_truth(result, chosen, groundtruth, label) if groundtruth is not None else []
    panels = panels or _panels(result, chosen, label)
    drawn = sum(len(panel.tracks) for panel in panels)
    if drawn < len(result.segments):
        subtitle += f"; {drawn} of {len(result.segments)} segments drawn"
    plot_panels(path, panels, title=title, subtitle=subtitle)


def _longest(result: Result) -> list[int]:
    """Numbers of the segments to draw, in order of time; the one of the trajectory is among them."""
    by_length = sorted(range(len(result.segments)), key=lambda k: (k != result.longest, -len(result.segments[k]), k))
    return sorted(by_length[:MAX_TRACKS])


def _label(number: int, segment: Segment, alone: bool, label: str) -> str:
    return label if alone else f"segment {number}, {len(segment)} frames"


def _panels_with_truth(result: Result, chosen: list[int], groundtruth: Trajectory, label: str) -> list[Panel]:
    """One panel in the world of the ground truth; none if no segment can be aligned."""
    tracks, spans = [], []
    points = np.zeros((0, 3))  # the map lives in the world of the longest segment
    for colour, number in enumerate(chosen):
        segment = result.segments[number]
        trajectory = segment.trajectory
        if evaluate(trajectory, groundtruth, align="sim3").reason is not None:
            continue
        i, j = associate(trajectory, groundtruth)
        spans += [j.min(), j.max()]
        align: Alignment = "se3" if result.is_metric(number) else "sim3"
        if number == result.longest:
            scale, rotation, shift = fit_alignment(trajectory.positions[i], groundtruth.positions[j], align)
            points = scale * result.map.points @ rotation.T + shift
        aligned = align_trajectory(trajectory, groundtruth, align)
        tracks.append(Track(aligned, _label(number, segment, len(result.segments) == 1, label), colour))
    if not tracks:
        return []
    span = slice(min(spans), max(spans) + 1)  # ground truth may be longer than the clip
    truth = Trajectory(groundtruth.timestamps[span], groundtruth.poses_wc[span])
    return [Panel(tuple(tracks), points, truth, _loops(result, tracks))]


def _panels(result: Result, chosen: list[int], label: str) -> list[Panel]:
    """A panel for each world; segments that were joined share one."""
    worlds: dict[int, list[Track]] = {}
    for colour, number in enumerate(chosen):
        segment = result.segments[number]
        track = Track(segment.trajectory, _label(number, segment, len(result.segments) == 1, label), colour)
        worlds.setdefault(world_root(result, number), []).append(track)
    longest = None if result.longest is None else world_root(result, result.longest)
    none = np.zeros((0, 3))
    panels = [
        Panel(tuple(tracks), result.map.points if world == longest else none, loops=_loops(result, tracks))
        for world, tracks in worlds.items()
    ]
    return panels or [Panel((), result.map.points)]


def _loops(result: Result, tracks: Sequence[Track]) -> np.ndarray:
    """Positions ``(L, 3)`` on the tracks at which loops were found (``loops`` of the metadata)."""
    found = []
    for loop in result.info.get("loops", ()):
        for track in tracks:
            row = np.flatnonzero(np.isclose(track.trajectory.timestamps, loop["from"], rtol=0, atol=1e-6))
            found += [track.trajectory.positions[k] for k in row[:1]]
    return np.array(found).reshape(-1, 3)


def world_root(result: Result, number: int) -> int:
    """Number of the segment whose world a segment shares, its own if none.

    Args:
        result: of a run.
        number: of the segment.
    """
    chain = [number]
    while (joined := result.segments[chain[-1]].joined_to) is not None and joined not in chain:
        chain.append(joined)
    return chain[-1] if joined is None else min(chain)
