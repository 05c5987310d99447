"""Late join: another try for frames that could not be joined with the window, once a later frame has been.

The first frame after an interruption is measured against the frames before the interruption alone. Once a frame after
it is part of the window, the scene on its other side is known too. The view then takes its place in the window, before
that frame, and has to pass the same threshold as in its first try, with the patches of the frames before it alone; the
later frame has to pass it again. A view that does becomes a dropped keyframe (:meth:`KeyframeGraph.drop`): its frames
are relative to the keyframe before it, and its measurements take part in the final adjustment. A view that does not
leaves everything as it was, bit for bit on the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.ba.cold_start import COLD_UPDATES, damping_at
from dvo.geometry import se3
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.keyframe_log import FrameRecord
from dvo.map.window import Window, WindowSnapshot
from dvo.models.patch_vo import PatchVO
from dvo.models.step import StepOptions
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.odometry.frames.front_end import View, keyframe_of
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.initial_pose import first_depth, initial_pose
from dvo.odometry.patch.state import TrackerState
from dvo.odometry.window.evidence import evidence_of
from dvo.odometry.window.step import WindowStep

VIEWS = 2
"""Number of waiting views that are tried again, the newest ones."""


def join_waiting(
    graph: KeyframeGraph, step: WindowStep, state: TrackerState, config: TrackerConfig, joined: FrameRecord
) -> None:
    """Try the newest waiting views again, up to the first that is not supported; none waits any more afterwards.

    A keyframe takes the identifier of its first try: these precede that of the newest keyframe, one for each view, so
    that identifiers keep the order of time.

    Args:
        graph: the newest keyframe of its window has been joined; changed in place.
        step: of the model on the window.
        state: of the tracker.
        config: settings of the tracker.
        joined: record of the newest keyframe. If it has a reason, the one of a break before it, the earliest frame
            that is joined takes that over.
    """
    waiting, state.waiting = state.waiting[-VIEWS:], []
    newest = graph.window.frames[-1].identifier
    for back, view in enumerate(reversed(waiting), 1):
        if not _join(graph, step, config, view, newest - back):
            return
        record = view.records[0]
        record.place(newest - back, graph.segment, joined.reason)
        joined.reason, joined = "", record
        for repeat in view.records[1:]:
            repeat.follow(record)


def _join(graph: KeyframeGraph, step: WindowStep, config: TrackerConfig, view: View, identifier: int) -> bool:
    """Measure a view in its place before the newest frame; True if the graph holds it now, as its pose is supported."""
    window, seen, before = graph.window, view.seen, _Before.of(step)
    assert isinstance(step.model, PatchVO)
    position, slot, c = len(window) - 1, window.free_map_slot(), step.model.config
    step.keep_frame(slot, seen.image, seen.maps)
    depth = first_depth(window, config, True, seen.measured)
    keyframe = keyframe_of(view, identifier, slot)
    pose = initial_pose(window, seen, _interpolated(window, keyframe.timestamp), config.initial_pose)
    window.insert(position, keyframe, pose, patch_coordinates(seen.centres, depth, c.patch_size)[0])
    step.forget(window.connect_frame(position, config.lifetime, c.self_edges))
    options = StepOptions(fixed=window.fixed(config.optimisation), damping=damping_at(COLD_UPDATES))
    for _ in range(config.search_updates):
        step(options, align=True)
    if all(evidence_of(step, k).supports(config.thresholds, joining=True) for k in (position, position + 1)):
        graph.drop(position)
        return True
    graph.discard(position)
    before.restore(step)
    return False


def _interpolated(window: Window, time: float) -> Tensor:
    """Pose ``(7,)`` between the two newest keyframes, at constant velocity: the start of the search, not a result."""
    before, after = window.frames[-2].timestamp, window.frames[-1].timestamp
    motion = se3.log(se3.relative(window.poses_cw[-2], window.poses_cw[-1]))
    return se3.retract(window.poses_cw[-2], (time - before) / (after - before) * motion)


@dataclass(frozen=True)
class _Before:
    """All of a window and of what is cached for it that a try changes.

    Attributes:
        window: poses, patches and edge states.
        origins: of the correlations; a value that is interpolated in a cached window depends on them in its last bit.
        images: of the alignment by map slot, None without one; those of free slots take part in rounding.
        aligned: results of an alignment in every step, None without one.
    """

    window: WindowSnapshot
    origins: Tensor
    images: np.ndarray | None
    aligned: tuple[Tensor, Tensor, Tensor] | None

    @classmethod
    def of(cls, step: WindowStep) -> _Before:
        """Record the state of a step and its window."""
        images = None if step.align is None else step.align.images
        aligned = None if step.align is None or step.final else step.align.results()
        return cls(step.window.snapshot(), step.lookup.origins(), images, aligned)

    def restore(self, step: WindowStep) -> None:
        """Restore the state of a step whose window has the same frames and edges again."""
        step.window.restore(self.window)
        if not torch.equal(step.lookup.origins(), self.origins):
            step.lookup.restore(self.origins)
        if step.align is not None and self.images is not None:
            step.align.restore_images(self.images)
        if step.align is not None and self.aligned is not None:
            step.align.restore(*self.aligned)
