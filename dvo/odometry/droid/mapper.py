"""Mapping of the dense odometry: keyframes in and out of the window, initialisation, refinement, stored depths."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.geometry import se3
from dvo.map.keyframe_log import KeyframeLog
from dvo.models.droid import DroidVO, damping_of
from dvo.odometry.droid.config import DenseConfig
from dvo.odometry.droid.depth_maps import StoredDepth
from dvo.odometry.droid.edges import neighbours_of, proximity_edges
from dvo.odometry.droid.frame import place_frame
from dvo.odometry.droid.restart import better_solution
from dvo.odometry.droid.window import Agreement, DenseWindow, Keyframe

_RECENT = 3  # keyframes whose depths the one of a new keyframe begins with


@dataclass(frozen=True)
class View:
    """Frame with content.

    Attributes:
        timestamp: seconds.
        pixels: ``(1, 1, 3, H, W)`` uint8 RGB working image; None if it cannot become a keyframe any more.
        matching: ``(C, h, w)`` features; None if they are not kept.
        intrinsics: ``(4,)`` of the feature map.
    """

    timestamp: float
    pixels: Tensor | None
    matching: Tensor | None
    intrinsics: Tensor


class DenseMapper:
    """Window of keyframes with the choice of its edges.

    Args:
        model: the network.
        config: settings.
        log: of frames and keyframes; its keyframe poses are kept up to date.

    Attributes:
        window: the keyframes.
        ready: the window is initialised.
        stored: depths of keyframes that have left the window, the oldest first.
        confidence: of the measurements of the last update.
    """

    def __init__(self, model: DroidVO, config: DenseConfig, log: KeyframeLog) -> None:
        self.model, self.config, self.log = model, config, log
        self.window = DenseWindow(model, max_edges=config.max_edges, max_held=config.max_held, max_age=config.max_age)
        self.ready = False
        self.stored: deque[StoredDepth] = deque(maxlen=config.max_depth_maps)
        self.confidence = 0.0
        self._numbers = 0

    def add(self, view: View, pose_cw: Tensor) -> int:
        """Append a keyframe to the window; its depth begins with the median of the newest ones.

        Args:
            view: the frame.
            pose_cw: ``(7,)`` to start from.

        Returns:
            Number of the keyframe.
        """
        assert view.pixels is not None and view.matching is not None
        hidden, gates = (x[0, 0] for x in self.model.context(view.pixels))
        recent = [frame.inverse_depth for frame in self.window.keyframes[-_RECENT:]]
        level = torch.stack(recent).median() if recent and self.ready else view.matching.new_ones(())
        h, w = view.matching.shape[-2:]
        stride = self.model.STRIDE
        colors = view.pixels[0, 0, :, ::stride, ::stride].permute(1, 2, 0).cpu().numpy()
        number, self._numbers = self._numbers, self._numbers + 1
        self.window.keyframes.append(
            Keyframe(
                number,
                view.timestamp,
                pose_cw,
                level.expand(h, w).clone(),
                view.intrinsics,
                view.matching,
                hidden,
                gates,
                colors,
                view.matching.new_zeros(h, w),
            )  # fmt: skip
        )
        return number

    def initialise(self) -> bool:
        """Solve for poses and depths of the keyframes that there are.

        Returns:
            False if they do not agree with each other. A single keyframe does: its frames show no motion.
        """
        count, config = len(self.window), self.config
        if count > 1:
            near = [edge for k in range(count) for edge in neighbours_of(k, config.radius + 1)]
            self.window.join(near)
            found = self._solve(1, config.initial_updates, cold=True)
            self._add_proximity(1)
            found = self._solve(1, config.initial_updates) or found
            if config.restart and better_solution(self.window, lambda: self._solve(1, 2 * config.initial_updates)):
                found = self._solve(1, 1)
            if found is None or not self.supports(found):
                return False
        self.ready = True
        self._publish()
        return True

    def supports(self, found: Agreement, joining: bool = False) -> bool:
        """Decide if measurements support poses.

        Args:
            found: their agreement.
            joining: the frame follows frames without a pose, or a gap in time, so that more agreement is required.

        Returns:
            True if they do.
        """
        least = self.config.join_inliers if joining else self.config.min_inliers
        return found.confidence >= self.config.lost_confidence and found.inliers >= least

    def _solve(self, fixed: int, updates: int, cold: bool = False) -> Agreement | None:
        found, config = None, self.config
        for update in range(updates):
            if not self.window.edges:  # all are held after ``max_age`` updates
                break
            damping = damping_of(update if cold else updates + 10)
            kernel = Kernel() if cold else config.kernel  # far from the solution, no residual is an outlier
            found = self.window.update(fixed, damping, kernel)
            self.confidence = found.confidence
        return found

    def _add_proximity(self, first: int) -> None:
        config, window = self.config, self.window
        room = config.max_edges - len(window.edges)
        if room < 2 or len(window) <= config.radius + 1:
            return
        distances = window.distances(config.translation_share)
        window.join(
            proximity_edges(
                distances,
                window.pairs(),
                first=first,
                radius=config.radius,
                separation=config.separation,
                threshold=config.proximity_flow,
                limit=room,
            )  # fmt: skip
        )

    def refine(self, segment: int) -> None:
        """Join the newest keyframe with the window, refine, and remove a keyframe that shows too little motion.

        Args:
            segment: number of the segment, for stored depths.
        """
        config, window = self.config, self.window
        while len(window) > config.window:
            self._store(window.remove(0), segment)
        newest = len(window) - 1
        window.join(neighbours_of(newest, config.radius))
        self._add_proximity(max(0, newest - 2))
        fixed = min(2, newest)
        self._solve(fixed, max(1, config.updates - 1))
        if newest >= 3:
            pair = [(newest - 2, newest - 1)]
            if float(window.distances(config.translation_share, pair)[0]) < config.keyframe_flow:
                self._publish()
                gone = window.remove(newest - 1)
                self.log.reanchor(gone.number, window.keyframes[newest - 2].number)
                window.join(neighbours_of(newest - 1, config.radius))
        self._solve(min(2, len(window) - 1), 1)
        self._publish()

    def _publish(self) -> None:
        """Give the log the present poses."""
        for keyframe in self.window.keyframes:
            self.log.set_pose(keyframe.number, keyframe.pose_cw.double().cpu().numpy())

    def place_between(self, frames: Iterable[tuple[int, View]]) -> None:
        """Give frames of the initialisation poses: interpolated between the keyframes, then adjusted to both of them.

        Args:
            frames: positions in the log, and the frames; those without features are interpolated alone.
        """
        keyframes = self.window.keyframes
        times = np.array([keyframe.timestamp for keyframe in keyframes])
        for number, view in frames:
            first = int(np.clip(np.searchsorted(times, view.timestamp, side="right") - 1, 0, len(times) - 1))
            last = min(first + 1, len(times) - 1)
            before, after = keyframes[first], keyframes[last]
            pose = before.pose_cw
            if last > first:
                share = (view.timestamp - times[first]) / (times[last] - times[first])
                pose = se3.retract(pose, float(share) * se3.log(se3.relative(pose, after.pose_cw)))
            if view.matching is not None and len(keyframes) > 1:
                anchors = [before, after] if last > first else [before]
                placed = place_frame(
                    self.model, anchors, view.matching, view.intrinsics, pose, self.config.frame_updates,
                    kernel=self.config.kernel,
                )  # fmt: skip
                pose = placed.pose_cw if self.supports(placed.found) else pose
            self.log.place(number, before.number, pose.double().cpu().numpy())

    # -- depths --------------------------------------------------------------------------------------------------

    def _store(self, keyframe: Keyframe, segment: int) -> None:
        self.stored.append(_stored(keyframe, segment))

    def in_window(self, segment: int) -> list[StoredDepth]:
        """Depths of the keyframes in the window, none before the initialisation.

        Args:
            segment: its number.

        Returns:
            In order of time.
        """
        solved = self.ready and len(self.window) > 1
        return [_stored(keyframe, segment) for keyframe in self.window.keyframes] if solved else []

    def poses(self, stored: list[StoredDepth]) -> dict[int, np.ndarray]:
        """Poses ``T_cw`` of keyframes with a stored depth.

        Args:
            stored: the depths.

        Returns:
            By number of the keyframe.
        """
        return {item.number: self.log.keyframe_pose(item.number) for item in stored}

    def close(self, segment: int) -> None:
        """Store the depths of the window and empty it.

        Args:
            segment: its number.
        """
        self.stored.extend(self.in_window(segment))
        self.discard()

    def discard(self) -> None:
        """Empty the window."""
        self.window.clear()
        self.ready = False


def _stored(keyframe: Keyframe, segment: int) -> StoredDepth:
    intrinsics, inverse_depth, confidence = (
        x.float().cpu().numpy().copy() for x in (keyframe.intrinsics, keyframe.inverse_depth, keyframe.confidence)
    )
    return StoredDepth(
        keyframe.number, segment, keyframe.timestamp, intrinsics, inverse_depth, confidence, keyframe.colors
    )
