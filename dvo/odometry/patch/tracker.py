"""Streaming tracker of patch-flow visual odometry over a keyframe graph (DPVO 3.4).

For each frame: extract features and patches; predict the pose; add edges between its patches and recent frames, both
ways; run the network and bundle adjustment on the window; and, a few frames later, keep or drop the frame as a
keyframe. Keyframes that leave the window are archived (:mod:`dvo.map.keyframe_graph`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dvo.core.arguments import checked_arguments
from dvo.core.context import core_left, multiplies_bfloat16
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.inertial import InertialSamples
from dvo.geometry import se3
from dvo.map.archive import ArchiveConfig
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.keyframe_log import FrameRecord
from dvo.map.window import Window
from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.masks import visible_features
from dvo.nets.update.int8 import multiplies_int8
from dvo.nets.update.update import Update
from dvo.odometry.depth.depth_factor import MEASURED_SHARE, measured_share
from dvo.odometry.depth.patch_depth import measure_depth
from dvo.odometry.exclusive import exclusive
from dvo.odometry.frames.content import NO_FIT, NO_MATCH, TOO_FEW, TOO_LITTLE_MOTION
from dvo.odometry.frames.front_end import View, observe
from dvo.odometry.frames.gate import Admitted, Gate, missing_content
from dvo.odometry.global_ba.graph_adjustment import AdjustmentRecord
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.loops.relocalisation import REFRESH_EVERY, hold_to_map, invite
from dvo.odometry.patch.config import Precision, TrackerConfig
from dvo.odometry.patch.finishing import finish_segments, judge_result, run_information
from dvo.odometry.patch.inertial import InertialTracking
from dvo.odometry.patch.initial_pose import first_depth, first_pose
from dvo.odometry.patch.initialisation import (
    NOT_INITIALISED,
    first_motion,
    initialise_related,
    leave_minimum,
    lose_unsupported,
)
from dvo.odometry.patch.kernels import load_in_background
from dvo.odometry.patch.loops import loop_closer
from dvo.odometry.patch.new_recording import begin_in_map
from dvo.odometry.patch.retry import retry_waiting
from dvo.odometry.patch.saving import save_map
from dvo.odometry.patch.state import Phase, TrackerState
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.odometry.quality import without_scale
from dvo.odometry.segments import result_of
from dvo.odometry.uncertainty.uncertainty import LaterUncertainty, WindowMeasurements
from dvo.odometry.window.frame_alignment import FrameAlignment
from dvo.odometry.window.patch_window import PatchWindow
from dvo.odometry.window.pose_validation import flow_magnitude, support_of
from dvo.odometry.window.sensors import WINDOW_SENSORS, WindowSensor

LOOK_EVERY = 3
"""Aligned frames in a row, of which one is looked at for pixels that are fixed to the images."""
JOBS_EVERY = 4
"""Aligned frames in a row after which the jobs beside tracking advance as after a frame that the network measures: they
take about as long."""
BEGINNING, MOST_HELD = 64, 0.02
"""Frames within which a recording begins anew where more than this share of the image is found to be fixed to it: what
was measured there holds poses and scale of the frames before."""
MOST_KEPT = 2**27
"""Bytes of images that are kept for that; of larger images fewer frames are."""


@exclusive
class PatchOdometry:
    """Odometry of one sequence with :class:`dvo.models.patch_vo.PatchVO`; calls from several threads wait in line.

    Args:
        model: the network; moved to ``device`` and used in evaluation mode.
        config: see :class:`TrackerConfig`.
        seed: of the patch centres. The same seed on the same machine gives the same trajectory, bit for bit on the
            CPU with a fixed number of threads.
        device: of all computation.
        name: of the system, in reports.
        archive: bound and content of the archive of keyframes.
        weights: name or file of the network, by which :func:`dvo.load_map` finds it again.

    Attributes:
        model: the network as it was given.
        network: the same in the precision that it tracks with.
        precision: its name.
        gate: that every frame has to pass.
        graph: window, archive and log of frames.
        state: all else that a frame changes.
        patch_window: the window with the network that measures it; what it caches is computed from the other two.

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
        weights: str = "",
    ) -> None:
        self.name, self.config, self.seed, self.weights = name, config, seed, weights
        self.device = torch.device(device)
        self.model = model.to(self.device).eval()
        self.precision = _precision(config.precision, self.model, self.device)
        if self.precision == "int8":
            self.network = self.model.in_int8()
        else:
            self.network = self.model.in_bfloat16() if self.precision == "bfloat16" else self.model
        self.archive = archive
        if self.device.type == "cpu":
            load_in_background()
        self.reset()

    def reset(self) -> None:
        """Begin a new sequence as a new tracker with the same seed would; a map that it was loaded with is left."""
        config, c = self.config, self.model.config
        select = self.model.selection(config.selection)
        self.gate = Gate(config.pixels, config.max_gap, masks=True)
        self.state = TrackerState(torch.Generator().manual_seed(self.seed))
        self.select = partial(select, patches=config.patches, generator=self.state.generator)
        sizes = config.patches, c.patch_size, c.hidden_channels
        self.graph = KeyframeGraph(*sizes, self.device, self.archive, lambda edges: self.patch_window.finalise(edges))
        self.sensors: list[WindowSensor] = [
            WINDOW_SENSORS.resolve(name)(self.network, self.device) for name in config.sensors
        ]
        self.inertial = InertialTracking(
            config.inertial, self.graph, metric=config.scale.source != "none", variance=config.variance,
            optimised=config.optimisation,
        )  # fmt: skip
        self.patch_window = PatchWindow(self.network, self.window, config.measuring, self.device, self.sensors)
        self.aligner: FrameAlignment | None = None
        if config.aligned_motion > 0 and not self.sensors:
            self.aligner = FrameAlignment(
                self.patch_window, config.alignment, config.motion_damping, config.aligned_motion
            )
        self.loops = loop_closer(self.network, config, self.graph, self.device, self.state, self.inertial.corrected)

    @property
    def window(self) -> Window:
        """Active keyframes and edges."""
        return self.graph.window

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        A frame without content, or whose pose is not valid (:mod:`dvo.odometry.window.pose_validation`), is lost and
        leaves the graph. Those after it are joined with the window where their measurements validate it, and may bring
        it back (:mod:`dvo.odometry.patch.retry`); after ``config.patience`` frames with content that could not be
        joined, these begin the next segment. A loop (:mod:`dvo.odometry.loops.closure`) also moves and scales earlier
        frames.

        Args:
            frame: of the same size as the first, later than the one before, without lens distortion.

        Returns:
            Pose ``T_wc`` of the frame in the world of the first keyframe of its segment, up to scale, and the state of
            the tracker; no pose while the tracker is initialising or lost.

        Raises:
            DvoError: a frame that :func:`dvo.data.frame_checks.checked_frame` refuses, a timestamp that does not
                increase, an image of another size than the first, a camera with distortion, or a call after ``finish``.
        """
        state = self.state
        with core_left(self.loops.maintenance.occupies_core), self.gate.admit(frame) as admitted:
            for sensor in self.sensors:
                sensor.observe(admitted.frame)
            if self.config.inertial.use and admitted.frame.inertial is not None:
                self.inertial.add(admitted.frame.inertial)
            if self.inertial.active:
                self.patch_window.sensors = *self.sensors, self.inertial.coupling
            if state.map is not None:
                state.beginning = None
                begin_in_map(self.graph, self.loops.finder, state)
            self._remember(admitted)
            return self._process(admitted)

    def _process(self, admitted: Admitted) -> Estimate:
        """Process a frame that has passed the gate."""
        state = self.state
        record = self.graph.log.add(admitted.timestamp)
        camera = admitted.camera
        if not (admitted.repeated or admitted.problem):
            admitted = self.inertial.read_at_once(admitted)
        turns = self.inertial.turns() if camera.readout > 0 else None
        state.shutter = Shutter(camera.readout, camera.height / self.model.config.STRIDE, turns)
        if admitted.repeated:
            estimate = self._repeat(record)
        else:
            estimate = self._lose(record, admitted.problem) if admitted.problem else self._measure(record, admitted)
        self.state.last = estimate
        if not self.inertial.active:
            return estimate
        moved = not admitted.repeated and (self.aligner is None or self.aligner.age == 0)
        expressed = self.inertial.express(record, estimate, moved=moved)
        self.loops.maintenance.awaited &= state.initialised
        if moved and state.initialised and self.config.final_adjustment:
            self.inertial.adjust(self.loops.maintenance, self.config.adjustment, state.shutter)
        return expressed

    def _remember(self, admitted: Admitted) -> None:
        """Keep a frame at the beginning of a recording; with other sensors, and in real time, none begins anew."""
        beginning, scale = self.state.beginning, self.config.scale
        others = self.sensors or self.inertial.active or scale.depth or scale.stereo
        full = beginning is not None and len(beginning) >= min(BEGINNING, MOST_KEPT // max(admitted.image.nbytes, 1))
        if beginning is None or others or self.config.real_time or full:
            self.state.beginning = None
            return
        image, mask = admitted.image.copy(), None if admitted.mask is None else admitted.mask.copy()  # may be buffers
        frame = Frame(admitted.frame.index, admitted.timestamp, image, admitted.camera)
        beginning.append(replace(admitted, frame=frame, image=image, mask=mask))

    def _begin_anew(self) -> Estimate:
        """Process the frames so far again, now that it is known what is fixed to the images."""
        frames, gate, fixed = self.state.beginning or [], self.gate, self.state.fixed
        self.reset()
        self.gate, self.state.fixed, self.state.beginning = gate, fixed, None
        for admitted in frames:
            estimate = self._process(admitted)
        return estimate

    def _measure(self, record: FrameRecord, admitted: Admitted) -> Estimate:
        """Process a frame with content."""
        state, image = self.state, admitted.image
        if admitted.gap:
            state.interrupt(str(admitted.gap), is_gap=not admitted.gap.frozen)
        mask = self._without_fixed(image, admitted.mask)
        if state.beginning is not None and state.hidden > MOST_HELD:
            return self._begin_anew()
        if estimate := self._align(record, admitted, mask):
            return estimate
        if self.aligner is not None:
            self.aligner.age = 0
        seen = observe(self.network, image, admitted.camera, self.select, self.device, mask=mask)
        if self.config.scale.depth or self.config.scale.stereo:
            seen = measure_depth(self.network, seen, admitted.frame, self.config.scale, self.config.measuring)
        state.info = {
            "working_size": [*image.shape[1::-1]], "working_intrinsics": seen.image_intrinsics.tolist(),
            "precision": self.precision,
        }  # fmt: skip
        state.checks.see(len(self.graph.log.frames) - 1, image, seen.image_intrinsics, mask)
        estimate = self._take(View([record], seen))
        return self._begin_segment() if len(state.waiting) >= self.config.patience else estimate

    def _align(self, record: FrameRecord, admitted: Admitted, mask: np.ndarray | None) -> Estimate | None:
        """Align a frame that has moved little; None if the network has to measure it."""
        state, window, config = self.state, self.window, self.config
        state.guess = None
        if self.aligner is None or state.phase is not Phase.TRACKING or window.guests or admitted.gap:
            return None
        if self.aligner.age and self.aligner.age % JOBS_EVERY == 0:
            self.loops.advance(state.adjustable)  # may correct the window
        image, camera = admitted.image, admitted.camera.intrinsics
        found = self.aligner.align(image, camera, mask, record.timestamp)
        if found is None:
            return None
        if not (found.sure and found.slow):
            state.guess = found.pose_cw if found.sure else None
            return None
        state.checks.see(len(self.graph.log.frames) - 1, image, camera, mask)
        identifier, state.keyframes = state.keyframes, state.keyframes + 1
        weights = found.confidence * config.align_gain
        self.graph.attach(identifier, record.timestamp, found.pose_cw, found.kk, found.targets, weights)
        self.aligner.keep(found, record.timestamp)
        record.place(identifier, self.graph.segment)
        measured = found.pose_cw, found.kk, found.targets, found.confidence
        seen = WindowMeasurements.of(self.patch_window).with_frame(record.timestamp, *measured)
        pose_wc = se3.inverse(torch.from_numpy(found.pose_cw)).numpy()
        return self._estimate(record, pose_wc, Status.TRACKING, seen)

    @torch.inference_mode()
    def finish(self) -> Result:
        """Solve for all frames at once, loops included. Frames are refused afterwards; a second call gives the same.

        Returns:
            Trajectories ``T_wc`` of all segments and the sparse map of the longest, each in the world of its first
            keyframe, up to scale. Of a map without a frame of a new recording, the result of the map.
        """
        state = self.state
        if self.gate.finish() and state.map is None:
            if len(state.waiting) >= self.config.initial_frames:
                self._begin_segment()
            self._close_segment()
            self.loops.complete(state.adjustable)
            state.shutter = replace(state.shutter, turns=self.inertial.turns(told=True))
            readout = self.inertial.readout
            config = replace(self.config, estimate_readout=self.config.estimate_readout and readout == 0)
            state.info |= finish_segments(self.graph, state, config, self.loops)
            together = self.config.adjustment if self.config.final_adjustment else None
            found = state.info.get("readout", 0.0)
            rows = replace(state.shutter, readout=readout or (found if isinstance(found, float) else 0.0))
            state.info |= self.inertial.settle(self.loops, together, rows)
            quality = judge_result(self.graph, self._result({}), state, self.config, self.model.config.STRIDE)
            state.quality = without_scale(quality, self.inertial.doubt)
            if readout > 0:
                state.info |= {"readout": readout, "readout_from": "gyroscope"}
        return replace(self._result({}), quality=state.quality)

    @torch.inference_mode()
    def current(self) -> Result:
        """Result so far, without the final optimisation; tracking goes on.

        Returns:
            As :meth:`finish`; the map has no points of the keyframes in the window.
        """
        poses = self.window.poses_cw.double().cpu().numpy()
        known = {frame.identifier: pose for frame, pose in zip(self.window.frames, poses, strict=True)}
        return self.inertial.expressed(self._result(known if self.state.initialised else {}))

    def add_inertial(self, samples: InertialSamples) -> None:
        """Give inertial samples that do not come with the frames, for live use: late ones too, and from any thread.

        Args:
            samples: on the clock of the frames; the first with an extrinsic calibration and noise decide these.

        Raises:
            DvoError: times that do not increase or are those of another clock, or values that are not finite.

        Example:
            >>> odometry = dvo.load("small")
            >>> odometry.add_inertial(InertialSamples(times, gyro, accel, T_camera_imu))
            >>> estimate = odometry.track(frame)
        """
        self.inertial.add_apart(samples)

    @checked_arguments
    def save(self, file: str | Path) -> None:
        """Write the map to a file, for other recordings of the place (:func:`dvo.load_map`) or other programs.

        Between two frames it is the map so far: in the file, the window is closed with its present poses, without the
        final optimisation. Tracking goes on as if nothing had been saved.

        Args:
            file: to write, by convention ``*.dvo``; replaced as a whole.

        Raises:
            DvoError: the file cannot be written.
        """
        save_map(file, self)

    @torch.inference_mode()
    def adjust(self) -> tuple[AdjustmentRecord, ...]:
        """Adjust everything that has left the window, before, or between, any two frames of the sequence.

        All worlds of the recording are adjusted one after the other, by the measurements of archived keyframes and
        loops (:mod:`dvo.odometry.global_ba.graph_adjustment`); the window moves along. A solution that does not lower
        the robust cost is not taken. Work in progress for loops is waited for. With the setting ``real_time`` nothing
        is waited for: the adjustments are done beside tracking, within bounds, and applied when they are there. Poses
        and depths may change, and the scale.

        Returns:
            One record for each world, with the cost before and after; none for a world with fewer than three archived
            keyframes. Empty with ``real_time``; run.json lists the adjustments later.

        Raises:
            DvoError: the sequence is finished. ``finish`` has adjusted it.

        Example:
            >>> odometry = dvo.load("small")
            >>> for number, frame in enumerate(dvo.open("video.mp4", calib="calib.txt"), 1):
            ...     estimate = odometry.track(frame)
            ...     if number % 500 == 0:
            ...         for record in odometry.adjust():
            ...             print(record.keyframes, record.cost_before, record.cost)
        """
        if self.gate.finished:
            raise DvoError("the sequence is finished and adjusted", field="adjust()", remedy="adjust before finish()")
        if self.state.map is not None:  # which stays as it is
            return ()
        return tuple(self.loops.adjust(self.state.adjustable, wait=not self.config.real_time))

    def _result(self, poses: dict[int, np.ndarray]) -> Result:
        return result_of(self.graph, run_information(self.graph, self.state, self.config, self.loops, self.seed), poses)

    def _take(self, view: View) -> Estimate:
        """Add a frame with content to the window, and estimate its pose."""
        window, config, state, record = self.window, self.config, self.state, view.records[0]
        if not state.initialised and (estimate := self._relocalise(view)):
            return estimate
        if not state.initialised:
            return self._initialise(view)
        identifier, (pose, depth) = self._name(view), self._begin(view)
        policy = config.policies["retry" if state.phase is Phase.INTERRUPTED else "continuous"]
        if not self.patch_window.try_insert(view, len(window), identifier, pose, depth, policy).accepted:
            if estimate := self._relocalise(view):
                return estimate
            state.waiting.append(view)
            return self._lose(record, NO_MATCH)
        record.place(identifier, self.graph.segment, state.resume())
        state.tracked += 1
        if config.restart and state.restart_due and not window.guests:
            state.ambiguous = leave_minimum(self.patch_window, config, self.loops.maintenance.helper)
        if state.waiting:
            retry_waiting(self.graph, self.patch_window, state, config, record)
        if self.graph.located is not None and state.tracked % REFRESH_EVERY == 0:
            hold_to_map(self.graph, self.patch_window, self.loops.finder)
        self._reduce()  # may correct the window
        return self._estimate(record, self._pose_wc(len(window) - 1), Status.TRACKING)

    def _relocalise(self, view: View) -> Estimate | None:
        """Begin a segment with a frame that shows a known place, in its world and scale; None if it shows none."""
        graph, state, record = self.graph, self.state, view.records[0]
        found = self.loops.locate(view, state.keyframes)
        if found is None:
            return None
        reason = record.reason if state.interruption is None else state.interruption.reason
        self._close_segment()
        state.waiting = []
        state.initialise(graph.segment)
        graph.join(graph.segment, graph.segment_of(found.loop.old))
        invite(self.patch_window, found.guests)
        graph.located = found.loop.old
        self.loops.relocalised(found.loop)
        identifier, policy = self._name(view), self.config.policies["located"]
        pose, depth = found.pose_cw.to(self.device, torch.float32), found.depths[None].to(self.device)
        self.patch_window.try_insert(view, len(self.window), identifier, pose, depth, policy)
        record.place(identifier, graph.segment, reason)
        return self._estimate(record, self._pose_wc(len(self.window) - 1), Status.TRACKING)

    def _initialise(self, view: View) -> Estimate:
        """Add a frame to a window that is not initialised yet, and try to initialise it."""
        window, config, state, record = self.window, self.config, self.state, view.records[0]
        identifier, (pose, depth) = self._name(view), self._begin(view)
        self.patch_window.add(view, len(window), identifier, pose, depth)
        self.patch_window.connect(len(window) - 1, range(1, config.lifetime + 1))  # in few frames all tell
        state.waited += 1
        if len(window) > 1:
            revision = self.patch_window.revise()
            if not first_motion(revision, window, config, state.waited):
                # Too little motion to initialise: until the final adjustment it shares the pose of the last keyframe.
                self.patch_window.store(revision)
                self.graph.drop(len(window) - 1, still=True)
                record.place(identifier, self.graph.segment)
                return self._estimate(record, None, Status.INITIALISING, reason=TOO_LITTLE_MOTION)
        record.place(identifier, self.graph.segment)
        if len(window) >= config.initial_frames:
            beside = self.loops.maintenance.helper
            enough = initialise_related(self.graph, self.patch_window, config, state.waited, beside)
            if enough and support_of(window, len(window) - 1).reaches(config.lost_confidence, config.min_inliers):
                lose_unsupported(self.graph, config)
            support = support_of(window, len(window) - 1)
            enough = enough and len(window) >= config.initial_frames
            if enough and support.reaches(config.lost_confidence, config.min_inliers):
                state.initialise(self.graph.segment)
                if config.restart:
                    state.ambiguous = measured_share(window.measured) < MEASURED_SHARE  # until it is tried
        self._reduce()
        if state.initialised:
            return self._estimate(record, self._pose_wc(len(window) - 1), Status.TRACKING)
        reason = TOO_FEW if len(window) < config.initial_frames else NO_FIT
        return self._estimate(record, None, Status.INITIALISING, reason=reason)

    def _without_fixed(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
        """Mask of a frame without the pixels that are fixed to it, in which measurements of the window end too."""
        fixed = self.state.fixed
        # Where little moves from frame to frame, every third frame tells as much.
        skipped = self.aligner is not None and self.aligner.age % LOOK_EVERY > 0
        if not skipped and fixed.see(image):
            size, unfixed = self.model.config.patch_size, fixed.mask
            self.window.unfixed = None if unfixed is None else visible_features(unfixed, size, self.device)
        left = fixed.mask if mask is None or fixed.mask is None else mask & fixed.mask
        if left is None or missing_content(image, left):  # with too little left of the image, all of it is used
            self.state.hidden, self.window.unfixed = 0.0, None
            return mask
        # Bars were left out from the first frame on: the verdict is about what took part until it was found.
        given = [whole for whole in (mask, fixed.picture) if whole is not None]
        before = int(np.logical_and.reduce(given).sum()) if given else left.size
        self.state.hidden = (before - int(left.sum())) / left.size
        return left

    def _repeat(self, record: FrameRecord) -> Estimate:
        """Give a frame with the image of the frame before it the same pose and state."""
        state, past = self.state, self.graph.log.frames[-2]
        assert state.last is not None
        record.follow(past)
        if state.waiting and state.waiting[-1].records[-1] is past:
            state.waiting[-1].records.append(record)
        return replace(state.last, timestamp=record.timestamp, recovered=False)

    def _lose(self, record: FrameRecord, reason: str) -> Estimate:
        """Mark a frame as lost; the next frame of an initialised segment has to be joined across it."""
        record.anchor, record.lost = None, True
        record.reason = self.state.interrupt(reason)
        return self._estimate(record, None, Status.LOST)

    def _begin_segment(self) -> Estimate:
        """Close the segment, and begin the next one with the frames that could not be joined with it."""
        waiting, self.state.waiting, interruption = self.state.waiting, [], self.state.interruption
        self._close_segment()
        for view in waiting:
            estimate = self._take(view)
            for repeat in view.records[1:]:
                repeat.follow(view.records[0])
        if not waiting[0].records[0].lost:
            waiting[0].records[0].reason = "" if interruption is None else interruption.reason
        return estimate

    def _close_segment(self) -> None:
        """Refine the window and archive it; a segment that was never initialised has no rows."""
        keep = self.state.initialised
        for _ in range(self.config.final_updates if keep and len(self.window) > 1 else 0):
            self.patch_window.update(self.config.optimisation)
        self.graph.begin_segment(self.state.keyframes, keep, NOT_INITIALISED)
        self.state.begin_segment()

    def _name(self, view: View) -> int:
        """Give the keyframe of a view its identifier, by which loops know its image."""
        identifier, self.state.keyframes = self.state.keyframes, self.state.keyframes + 1
        self.loops.see(identifier, view.seen.image, view.seen.maps)
        return identifier

    def _begin(self, view: View) -> tuple[Tensor, Tensor]:
        """Pose and inverse depths that a new frame begins with: predicted, and the median of the frames before it."""
        window, config, seen, initialised = self.window, self.config, view.seen, self.state.initialised
        depth = first_depth(window, config, initialised, seen.measured)
        guess = self.state.guess
        if guess is not None and initialised:
            return torch.from_numpy(guess).to(window.poses_cw), depth
        time = view.records[0].timestamp
        pose = first_pose(window, seen, time, config, initialised)
        return self.inertial.predicted(time, pose) if initialised and self.inertial.active else pose, depth

    def _reduce(self) -> None:
        """Drop a redundant keyframe, and archive edges and keyframes beyond the maximum age."""
        window, config = self.window, self.config
        n, back = len(window), config.keyframe_index
        if self.state.initialised and n > back + max(1, window.guests):
            i, j = n - back - 1, n - back + 1
            if (flow_magnitude(window, i, j) + flow_magnitude(window, j, i)) / 2 < config.keyframe_motion:
                self.graph.drop(n - back)
        newest, guests = len(window) - config.removal, window.guests
        self.graph.keep_edges((window.ii >= newest) | ((window.ii < guests) & (window.jj >= newest)))
        limit = config.removal + config.lifetime if self.state.initialised else config.initial_frames + 4
        while len(window) - window.guests > limit:
            self.graph.archive_oldest()
        self.loops.advance(self.state.adjustable)

    def _estimate(
        self,
        record: FrameRecord,
        pose_wc: np.ndarray | None,
        status: Status,
        seen: WindowMeasurements | None = None,
        reason: str = "",
    ) -> Estimate:
        """Estimate of a frame; ``seen``: measurements that its pose is the newest of, None for those of the window."""
        graph, state, reason = self.graph, self.state, record.reason if status is Status.LOST else reason
        recovered = pose_wc is not None and state.enter(graph.segment, graph.world_of(graph.segment))
        segment = graph.segment - graph.recording.segment
        if pose_wc is None:
            return Estimate(record.timestamp, None, status, 0.0, segment, reason, recovered)
        state.started = record.timestamp if state.started is None else state.started
        seen = seen or WindowMeasurements.of(self.patch_window)
        sure = LaterUncertainty(seen, self.config.variance, state.ambiguous)
        return Estimate(record.timestamp, pose_wc, status, sure.confidence, segment, reason, recovered,
                        sure.covariance, sure.reference)  # fmt: skip

    def _pose_wc(self, position: int) -> np.ndarray:
        return se3.inverse(self.window.poses_cw[position]).double().cpu().numpy()


def _precision(wanted: Precision, model: PatchVO, device: torch.device) -> Precision:
    """Precision that the network tracks in: the wanted one, or the fastest on the device."""
    gated = isinstance(model.update, Update)
    if wanted == "int8" and not (gated and device.type == "cpu"):
        remedy = "use auto, float32 or bfloat16"
        raise DvoError("only the gated update operator on a CPU multiplies in 8 bits", field="precision", remedy=remedy)
    if wanted != "auto":
        return wanted
    if gated and multiplies_int8(device):
        return "int8"
    return "bfloat16" if multiplies_bfloat16(device) else "float32"
