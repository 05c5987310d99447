"""Retry of frames that could not be joined with the window, once a later frame has been.

The first frame after an interruption is measured against the frames before the interruption alone. Once a frame after
it is part of the window, the scene on its other side is known too. The view then takes its place in the window, before
that frame, and has to pass the same threshold as in its first try, with the patches of the frames before it alone; the
later frame has to pass it again. A view that does becomes a dropped keyframe (:meth:`KeyframeGraph.drop`): its frames
are relative to the keyframe before it, and its measurements take part in the final adjustment. A view that does not
leaves everything as it was, bit for bit on the CPU.
"""

from __future__ import annotations

from torch import Tensor

from dvo.geometry import se3
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.keyframe_log import FrameRecord
from dvo.map.window import Window
from dvo.odometry.frames.front_end import View
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.initial_pose import first_depth, initial_pose
from dvo.odometry.patch.state import TrackerState
from dvo.odometry.window.patch_window import PatchWindow

MAX_VIEWS = 2
"""Number of waiting views that are tried again, the newest ones."""


def retry_waiting(
    graph: KeyframeGraph, patch_window: PatchWindow, state: TrackerState, config: TrackerConfig, joined: FrameRecord
) -> None:
    """Try the newest waiting views again, up to the first that is not supported; none waits any more afterwards.

    A keyframe takes the identifier of its first try: these precede that of the newest keyframe, one for each view, so
    that identifiers keep the order of time.

    Args:
        graph: the newest keyframe of its window has been joined; changed in place.
        patch_window: the window.
        state: of the tracker.
        config: settings of the tracker.
        joined: record of the newest keyframe. If it has a reason, the one of a break before it, the earliest frame
            that is joined takes that over.
    """
    waiting, state.waiting = state.waiting[-MAX_VIEWS:], []
    newest = graph.window.frames[-1].identifier
    for back, view in enumerate(reversed(waiting), 1):
        if not _join(graph, patch_window, config, view, newest - back):
            return
        record = view.records[0]
        record.place(newest - back, graph.segment, joined.reason)
        joined.reason, joined = "", record
        for repeat in view.records[1:]:
            repeat.follow(record)


def _join(graph: KeyframeGraph, patch_window: PatchWindow, config: TrackerConfig, view: View, identifier: int) -> bool:
    """Measure a view in its place before the newest frame; True if the graph holds it now, as its pose is supported."""
    window, seen = graph.window, view.seen
    depth = first_depth(window, config, True, seen.measured)
    pose = initial_pose(window, seen, _interpolated(window, view.records[0].timestamp), config.initial_pose)
    position = len(window) - 1
    if not patch_window.try_insert(view, position, identifier, pose, depth, config.policies["late"]).accepted:
        return False
    graph.drop(position)
    return True


def _interpolated(window: Window, time: float) -> Tensor:
    """Pose ``(7,)`` between the two newest keyframes, at constant velocity: the start of the search, not a result."""
    before, after = window.frames[-2].timestamp, window.frames[-1].timestamp
    motion = se3.log(se3.relative(window.poses_cw[-2], window.poses_cw[-1]))
    return se3.retract(window.poses_cw[-2], (time - before) / (after - before) * motion)
