"""Settings of the dense odometry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from dvo.ba.kernels import Kernel
from dvo.core.errors import DvoError
from dvo.core.settings import check_settings

_RANGES = {
    "pixels": (0, 2**28),
    "filter_flow": (0, 1e4),
    "keyframe_flow": (0, 1e4),
    "proximity_flow": (0, 1e4),
    "warm_up": (2, 64),
    "window": (3, 64),
    "radius": (1, 16),
    "separation": (0, 16),
    "max_edges": (4, 4096),
    "max_held": (0, 4096),
    "max_age": (1, 10_000),
    "initial_updates": (1, 100),
    "updates": (1, 100),
    "robust": (0, 1e4),
    "frame_updates": (1, 100),
    "translation_share": (0, 1),
    "motion_damping": (0, 1),
    "lost_confidence": (0, 1),
    "min_inliers": (0, 1),
    "join_inliers": (0, 1),
    "patience": (1, 10_000),
    "max_gap": (1, math.inf),
    "depth_confidence": (0, 1),
    "depth_tolerance": (0, 1),
    "depth_views": (0, 4),
    "max_depth_maps": (0, 10**6),
}


@dataclass(frozen=True)
class DenseConfig:
    """Settings of :class:`dvo.odometry.droid.droid.DroidOdometry`. Flow is in feature pixels, eight image pixels each.

    Attributes:
        pixels: largest number of pixels of the working image; the aspect is kept (0: full resolution).
        filter_flow: mean flow from the last keyframe above which a frame becomes a keyframe.
        keyframe_flow: mean flow between its neighbours below which a keyframe is removed again.
        proximity_flow: mean flow up to which frames farther apart than ``radius`` are joined.
        warm_up: keyframes of the initialisation.
        window: keyframes that are optimised, and whose features are kept.
        radius: neighbouring keyframes in the order of time that are joined, in both directions.
        separation: distance in the frame graph within which one proximity edge suppresses others.
        max_edges: edges that the network revises; beyond them the oldest are held as they are.
        max_held: held edges that stay in bundle adjustment.
        max_age: updates after which an edge is held.
        initial_updates: updates of the initialisation, before and again after proximity edges are added.
        restart: solve the first keyframes from other motions as well, and keep the better solution
            (:func:`dvo.odometry.droid.restart.better_solution`); DROID-SLAM does not.
        robust: width of the Cauchy kernel of bundle adjustment, feature pixels; 0 for no kernel, as in DROID-SLAM.
        updates: updates for each keyframe.
        frame_updates: updates of the pose of each frame, by two edges from the newest keyframes.
        translation_share: share of the flow of the translation alone in the distance of frames.
        motion_damping: factor of the velocity in the starting pose of a frame.
        lost_confidence: mean confidence of the edges into a frame below which it is lost.
        min_inliers: share of the pixels in view that must be found where bundle adjustment reprojects them.
        join_inliers: the same after frames without a pose, or a gap in time.
        patience: frames with content that cannot be joined before a new segment begins.
        max_gap: time between frames above which they are separated by a gap, in medians of the recent intervals.
        depth_confidence: confidence above which the depth of a pixel counts as reliable.
        depth_tolerance: relative difference up to which depths in two keyframes agree.
        depth_views: number of neighbouring keyframes, of four, that must agree with a reliable depth.
        max_depth_maps: depth maps that are kept; the oldest are dropped first (about 17 kB each at 320x240).

    Raises:
        DvoError: a value of the wrong type or out of range, with the name of the setting.

    Example:
        >>> odometry = dvo.load("droid.safetensors", filter_flow=1.0, window=12)
    """

    pixels: int = 320 * 240
    filter_flow: float = 1.5
    keyframe_flow: float = 2.0
    proximity_flow: float = 10.0
    warm_up: int = 6
    window: int = 8
    radius: int = 2
    separation: int = 1
    max_edges: int = 24
    max_held: int = 48
    max_age: int = 16
    initial_updates: int = 6
    restart: bool = True
    robust: float = 1.0
    updates: int = 3
    frame_updates: int = 3
    translation_share: float = 0.7
    motion_damping: float = 0.5
    lost_confidence: float = 0.02
    min_inliers: float = 0.1
    join_inliers: float = 0.3
    patience: int = 8
    max_gap: float = 4.5
    depth_confidence: float = 0.3
    depth_tolerance: float = 0.05
    depth_views: int = 2
    max_depth_maps: int = 1000

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)
        if self.warm_up > self.window:
            raise DvoError(
                f"{self.warm_up} keyframes do not fit into the window of {self.window}", field="warm_up",
                remedy="give a larger window, or fewer keyframes",
            )  # fmt: skip

    @property
    def kernel(self) -> Kernel:
        """Robust kernel of bundle adjustment."""
        return Kernel("cauchy", self.robust) if self.robust > 0 else Kernel()


PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": {"pixels": 256 * 192, "updates": 2, "frame_updates": 2, "max_edges": 18},
    "accurate": {"pixels": 448 * 336, "updates": 5, "window": 12, "max_edges": 48, "radius": 3},
}
"""Settings that trade accuracy for speed; ``dvo.load("droid.safetensors", preset="fast")``."""
