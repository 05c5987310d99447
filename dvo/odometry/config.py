"""Settings of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from dvo.errors import DvoError


@dataclass(frozen=True)
class TrackerConfig:
    """How :class:`dvo.odometry.tracker.PatchOdometry` runs.

    Attributes:
        pixels: pixel budget of the working image; the aspect is kept (0: the image as it is).
        patches: patches drawn from a frame.
        lifetime: a patch meets the frames up to this far before and after its own.
        removal: edges of patches from frames older than this are dropped.
        optimisation: poses of this many newest frames are optimised.
        initial_frames: keyframes before the first joint optimisation.
        initial_updates, final_updates: updates at initialisation and in ``finish``.
        updates: updates a frame.
        initial_motion: revision of the flow, in feature pixels, that makes a frame worth a keyframe before
            initialisation.
        initial_parallax: median parallax, in feature pixels and freed of rotation, above which the tracker says
            ``tracking``.
        keyframe_motion: a keyframe is dropped again if the mean flow between its neighbours, in feature pixels, is
            below this.
        keyframe_index: how many keyframes back that test looks.
        motion_damping: share of the last motion expected to go on.
        patience: so many lost frames in a row stay out of the graph, so that the first good one after them joins those
            before them; after more it is given up to find them again, and lost frames stay in the graph.
        search_updates: recurrent updates of a frame after a lost one, to find the way again.
        lost_confidence: below this mean confidence of the newest frame's edges the tracker says ``lost``.
    """

    pixels: int = 320 * 240
    patches: int = 24
    lifetime: int = 7
    removal: int = 9
    optimisation: int = 8
    initial_frames: int = 5
    initial_updates: int = 16
    final_updates: int = 8
    updates: int = 1
    initial_motion: float = 0.5
    initial_parallax: float = 1.0
    keyframe_motion: float = 5.0
    keyframe_index: int = 4
    motion_damping: float = 0.5
    lost_confidence: float = 0.01
    patience: int = 15
    search_updates: int = 8

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrackerConfig:
        """Raises DvoError for a key that is no attribute."""
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            raise DvoError("unknown tracker setting", field=", ".join(unknown), remedy="see TrackerConfig")
        return cls(**values)


TRACKER_PRESETS: dict[str, TrackerConfig] = {
    "small": TrackerConfig(),
    "tiny": TrackerConfig(pixels=160 * 120, patches=16),
    # DPVO's "fast" setting.
    "full": TrackerConfig(
        pixels=0,
        patches=48,
        lifetime=11,
        removal=16,
        optimisation=7,
        initial_frames=8,
        initial_updates=12,
        initial_motion=2.0,
        keyframe_motion=15.0,
    ),  # fmt: skip
}
