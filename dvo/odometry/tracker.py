"""Streaming tracker of patch-flow visual odometry over a keyframe graph (DPVO 3.4).

For each frame: extract features and patches; predict the pose; add edges between its patches and recent frames, both
ways; run the network and bundle adjustment on the window; and, a few frames later, keep or drop the frame as a
keyframe. Keyframes that leave the window are archived (:mod:`dvo.graph.keyframe_graph`).
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial

import numpy as np
import torch

from dvo.ba.cold_start import COLD_UPDATES, damping_at
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.graph.archive import ArchiveConfig
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.keyframe_log import FrameRecord
from dvo.graph.window import Keyframe, Window
from dvo.models.patch_vo import PatchVO
from dvo.models.step import StepOptions, recent_depth
from dvo.nets.patchifier import patch_coordinates
from dvo.odometry.config import TrackerConfig
from dvo.odometry.evidence import NO_MATCH, Evidence, missing_content, newest_evidence, window_inliers
from dvo.odometry.frame_sequence import FrameSequence
from dvo.odometry.front_end import View, observe
from dvo.odometry.initial_pose import initial_pose
from dvo.odometry.initialisation import drop_unrelated, initialise, leave_minimum, median_revision, newest_confidence
from dvo.odometry.motion import flow_magnitude, predict_pose
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.odometry.rolling_shutter import Shutter
from dvo.odometry.segments import result_of
from dvo.odometry.self_calibration import adjust_segments
from dvo.odometry.window_alignment import WindowAlignment
from dvo.odometry.window_correlation import WindowCorrelation
from dvo.odometry.window_step import WindowStep
from dvo.odometry.working_image import working_image

_DEPTH_FRAMES = 3  # number of newest frames whose median depth initialises a new frame


class PatchOdometry:
    """Odometry of one sequence with :class:`dvo.models.patch_vo.PatchVO`.

    Args:
        model: the network; moved to ``device`` and used in evaluation mode.
        config: see :class:`TrackerConfig`.
        seed: of the patch centres. The same seed on the same machine gives the same trajectory, bit for bit on the
            CPU with a fixed number of threads.
        device: of all computation.
        name: of the system, in reports.
        archive: bound and content of the archive of keyframes.

    Attributes:
        graph: window, archive and log of frames.

    Example:
        >>> odometry = PatchOdometry(dvo.load_model("small"), TrackerConfig())
        >>> for frame in dvo.open("video.mp4", calib="calib.txt"):
        ...     estimate = odometry.track(frame)
        >>> trajectory = odometry.finish().trajectory
    """

    def __init__(
        self,
        model: PatchVO,
        config: TrackerConfig,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        name: str = "dvo",
        archive: ArchiveConfig | None = None,
    ) -> None:
        self.name, self.config, self.seed = name, config, seed
        self.device = torch.device(device)
        self.model = model.to(self.device).eval()
        c = model.config
        select = self.model.selection(config.selection)
        self._select = partial(select, patches=config.patches, generator=torch.Generator().manual_seed(seed))
        sizes = config.patches, c.patch_size, c.hidden_channels
        self.graph = KeyframeGraph(*sizes, self.device, archive, lambda edges: self._step.finalise(edges))
        self.correlation = WindowCorrelation(self.window, c, self.device)
        align = None if config.align == "none" else WindowAlignment(self.window, config.alignment, self.device)
        self._step = WindowStep(
            self.model, self.window, self.correlation, align, config.align == "final", config.kernel
        )
        self._count = self._tracked = 0  # keyframes, and frames of the segment since its initialisation
        self._initialised = self._finished = False
        self._adjustable: list[int] = []  # segments that were initialised
        self._sequence = FrameSequence(config.max_gap)
        self._waiting: list[View] = []  # frames with content since tracking was lost
        self._joining = ""  # cause of the interruption that the next frame has to be joined across
        self._skipped = False  # the interruption is a gap in time
        self._last: tuple[np.ndarray, Estimate] | None = None  # last image and its estimate
        self._info: dict[str, object] = {}

    @property
    def window(self) -> Window:
        """Active keyframes and edges."""
        return self.graph.window

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        A frame whose image has no content, or whose pose its measurements do not bear out
        (:mod:`dvo.odometry.evidence`), is lost and leaves the graph. The frames after it are joined with the window if
        there is evidence for it; after ``config.patience`` frames with content that could not be joined, these begin
        the next segment.

        Args:
            frame: of the same size as the first, later than the one before, without lens distortion.

        Returns:
            Pose ``T_wc`` of the frame in the world of the first keyframe of its segment, up to scale, and the state of
            the tracker; no pose while the tracker is initialising or lost.

        Raises:
            DvoError: a frame that :func:`dvo.data.frame_checks.checked_frame` refuses, a timestamp that does not
                increase, an image of another size than the first, a camera with distortion, or a call after ``finish``.
        """
        if self._finished:
            raise DvoError("the sequence is finished", field="track()", remedy="build an odometry for each sequence")
        frame = checked_frame(frame)
        image, camera = working_image(frame, self.config.pixels)
        self._shutter = Shutter(camera.readout, camera.height / self.model.config.STRIDE)
        self._sequence.check(frame)
        record = self.graph.log.add(frame.timestamp)
        if self._last is not None and np.array_equal(image, self._last[0]):
            self._sequence.repeat(frame.timestamp)
            return self._repeat(record)
        gap = self._sequence.tick(frame.timestamp)
        problem = missing_content(image)
        if problem:
            estimate = self._lose(record, problem)
        else:
            if gap and self._initialised and not self._joining:
                self._joining, self._skipped = str(gap), not gap.frozen
            seen = observe(self.model, image, camera, self._select, self.device)
            self._info = {"working_size": [*image.shape[1::-1]], "working_intrinsics": seen.image_intrinsics.tolist()}
            estimate = self._take(View([record], seen))
            if len(self._waiting) >= self.config.patience:
                estimate = self._begin_segment()
        self._last = image, estimate
        return estimate

    @torch.inference_mode()
    def finish(self) -> Result:
        """Refine the last window and archive it. Frames are refused afterwards; a second call gives the same result.

        Returns:
            Trajectories ``T_wc`` of all segments and the sparse map of the longest, each in the world of its first
            keyframe, up to scale.
        """
        if not self._finished:
            self._finished = True
            if len(self._waiting) >= self.config.initial_frames:
                self._begin_segment()
            self._close_segment(last=True)
            if self.config.final_adjustment and self._adjustable:
                c = self.config
                self._info |= adjust_segments(
                    self.graph, self._adjustable, self._shutter, c.estimate_readout, c.adjustment
                )
        return self._result({})

    @torch.inference_mode()
    def current(self) -> Result:
        """Result so far, without the final optimisation; tracking goes on.

        Returns:
            As :meth:`finish`; the map has no points of the keyframes in the window.
        """
        poses = self.window.poses_cw.double().cpu().numpy()
        known = {frame.identifier: pose for frame, pose in zip(self.window.frames, poses, strict=True)}
        return self._result(known if self._initialised else {})

    def _result(self, poses: dict[int, np.ndarray]) -> Result:
        info = {
            **self._info, "keyframes": self.graph.log.keyframes, "seed": self.seed,
            "initialised": bool(self._adjustable), "config": asdict(self.config),
        }  # fmt: skip
        return result_of(self.graph, info, poses)

    def _take(self, view: View) -> Estimate:
        """Add a frame with content to the window, and estimate its pose."""
        window, config, record = self.window, self.config, view.records[0]
        keyframe = self._append(view)
        self._step.forget(window.connect_newest(config.lifetime, self.model.config.self_edges))
        if not self._initialised:
            return self._initialise(view, keyframe)
        before = window.snapshot()
        evidence = self._updated(config.search_updates if self._joining else config.updates)
        supported = evidence.supports(config, joining=bool(self._joining))
        if not (supported or self._joining):  # a fast motion may need more updates, but then has to be found for sure
            evidence = self._updated(config.search_updates)
            supported = evidence.supports(config, searched=True)
        if not supported:
            # The frame leaves the graph, so that the next ones are joined with the frames before it.
            window.restore(before)
            self.graph.discard(len(window) - 1)
            self._waiting.append(view)
            return self._lose(record, NO_MATCH)
        self._place(record, keyframe.identifier, self._joining if self._skipped else "")
        self._joining, self._skipped = "", False
        self._waiting.clear()
        self._tracked += 1
        if config.restart:
            leave_minimum(window, self._tracked)
        pose_wc = self._pose_wc(len(window) - 1)
        self._reduce()
        return self._estimate(record, pose_wc, Status.TRACKING, evidence.confidence)

    def _initialise(self, view: View, keyframe: Keyframe) -> Estimate:
        """Add a frame to a window that is not initialised yet, and try to initialise it."""
        window, config, record = self.window, self.config, view.records[0]
        self._joining, confidence = "", 0.0
        if len(window) > 1:
            revision = self._step.revise()
            confidence = newest_confidence(revision, window)
            if confidence >= config.lost_confidence and median_revision(revision, window) < config.initial_motion:
                # Too little motion to initialise: until the final adjustment it shares the pose of the last keyframe.
                self._step.store(revision)
                self.graph.drop(len(window) - 1, still=True)
                self._place(record, keyframe.identifier)
                return self._estimate(record, None, Status.INITIALISING, confidence)
        self._place(record, keyframe.identifier)
        if len(window) >= config.initial_frames:
            enough = initialise(window, self._step, config)
            drop_unrelated(self.graph, self._step, config)
            evidence = newest_evidence(self._step)
            supported = len(window) >= config.initial_frames and evidence.supports(config)
            self._initialised = enough and supported
            self._adjustable += [self.graph.segment] * self._initialised
            confidence = evidence.confidence
        pose_wc = self._pose_wc(len(window) - 1) if self._initialised else None
        self._reduce()
        return self._estimate(record, pose_wc, Status.INITIALISING if pose_wc is None else Status.TRACKING, confidence)

    def _repeat(self, record: FrameRecord) -> Estimate:
        """Give a frame with the image of the frame before it the same pose and state."""
        assert self._last is not None
        past = self.graph.log.frames[-2]
        record.follow(past)
        if self._waiting and self._waiting[-1].records[-1] is past:
            self._waiting[-1].records.append(record)
        self._last = self._last[0], replace(self._last[1], timestamp=record.timestamp)
        return self._last[1]

    def _place(self, record: FrameRecord, anchor: int, reason: str = "") -> None:
        record.anchor, record.lost, record.segment, record.reason = anchor, False, self.graph.segment, reason

    def _lose(self, record: FrameRecord, reason: str) -> Estimate:
        """Mark a frame as lost; the next frame of an initialised segment has to be joined across it."""
        record.anchor, record.lost = None, True
        if self._initialised and not self._joining:
            self._joining = reason
        record.reason = self._joining or reason
        return self._estimate(record, None, Status.LOST, 0.0)

    def _begin_segment(self) -> Estimate:
        """Close the segment, and begin the next one with the frames that could not be joined with it."""
        waiting, self._waiting, reason = self._waiting, [], self._joining
        self._close_segment()
        for view in waiting:
            estimate = self._take(view)
            for repeat in view.records[1:]:
                repeat.follow(view.records[0])
        if not waiting[0].records[0].lost:
            waiting[0].records[0].reason = reason
        return estimate

    def _close_segment(self, last: bool = False) -> None:
        """Refine the window and archive it, and decide if the rows of the segment are kept.

        A segment that was never initialised is kept if its frames agree with each other, and are as many as an
        initialisation needs or the only ones of the sequence.
        """
        window, config = self.window, self.config
        supported = self._initialised
        if len(window) > 1:
            for age in range(config.final_updates if self._initialised else config.initial_updates):
                self._update(COLD_UPDATES if self._initialised else age)
            if not self._initialised:
                drop_unrelated(self.graph, self._step, config)
        if not supported and len(window):
            records = self.graph.log.frames
            rows = sum(not r.lost and r.segment == self.graph.segment for r in records)
            only = last and self.graph.segment == 0 and not any(r.reason == NO_MATCH for r in records)
            agree = len(window) == 1 or window_inliers(self._step) >= config.min_inliers
            supported = agree and (only or rows >= config.initial_frames)
        while len(window):
            self.graph.archive_oldest()
        self.graph.begin_segment(self._count, supported, "too few frames with content")
        self._initialised, self._joining, self._skipped, self._tracked = False, "", False, 0

    def _append(self, view: View) -> Keyframe:
        """Add a frame to the window, with predicted pose and the median depth of the frames before it."""
        config, window, seen = self.config, self.window, view.seen
        slot = window.free_map_slot()
        self._step.keep_frame(slot, seen)
        keyframe = Keyframe(self._count, view.records[0].timestamp, slot, seen.matching, seen.context, seen.colors,
                            seen.intrinsics, seen.image, seen.fine)  # fmt: skip
        self._count += 1
        depth = torch.ones(1, config.patches, device=self.device)
        if self._initialised:
            depth *= recent_depth(window.patches[None], config.patches, _DEPTH_FRAMES)
        pose = predict_pose(
            window.poses_cw, [f.timestamp for f in window.frames], keyframe.timestamp, config.motion_damping
        )
        if self._initialised:
            pose = initial_pose(window, seen, pose, config.initial_pose)
        window.append(keyframe, pose, patch_coordinates(seen.centres, depth, self.model.config.patch_size)[0])
        return keyframe

    def _update(self, age: int = COLD_UPDATES) -> None:
        """Take a step on the window; ``age``, the number of earlier steps, sets the damping of bundle adjustment."""
        fixed = max(1, len(self.window) - self.config.optimisation) if self._initialised else 1
        self._step(StepOptions(fixed=fixed, damping=damping_at(age)), align=self._initialised)

    def _updated(self, count: int) -> Evidence:
        for _ in range(count):
            self._update()
        return newest_evidence(self._step)

    def _reduce(self) -> None:
        """Drop a redundant keyframe, and archive edges and keyframes beyond the maximum age."""
        window, config = self.window, self.config
        n, back = len(window), config.keyframe_index
        if self._initialised and n > back + 1:
            i, j = n - back - 1, n - back + 1
            if (flow_magnitude(window, i, j) + flow_magnitude(window, j, i)) / 2 < config.keyframe_motion:
                self.graph.drop(n - back)
        self.graph.keep_edges(window.ii >= len(window) - config.removal)
        limit = config.removal + config.lifetime if self._initialised else config.initial_frames + 4
        while len(window) > limit:
            self.graph.archive_oldest()

    def _estimate(self, record: FrameRecord, pose_wc: np.ndarray | None, status: Status, confidence: float) -> Estimate:
        reason = record.reason if status is Status.LOST else ""
        return Estimate(record.timestamp, pose_wc, status, confidence, self.graph.segment, reason)

    def _pose_wc(self, position: int) -> np.ndarray:
        return se3.inverse(self.window.poses_cw[position]).double().cpu().numpy()
