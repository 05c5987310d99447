"""Odometry of the dense network (DROID-SLAM: Teed and Deng, NeurIPS 2021), its front end without the back end.

Frames that show enough motion become keyframes. A window of them is joined by edges into a frame graph, which the
network and dense bundle adjustment refine together; every other frame is placed against the newest keyframes by
adjustment of its pose alone, and moves with them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.core.arguments import checked_arguments
from dvo.core.settings import check_seed
from dvo.data.frame import Frame
from dvo.geometry import se3
from dvo.map.keyframe_log import KeyframeLog
from dvo.models.droid import DroidVO
from dvo.models.weights import LoadedWeights
from dvo.odometry.droid.config import PRESETS, DenseConfig
from dvo.odometry.droid.depth_maps import depth_maps, fused
from dvo.odometry.droid.frame import place_frame, predicted_pose
from dvo.odometry.droid.mapper import DenseMapper, View
from dvo.odometry.exclusive import exclusive
from dvo.odometry.frames.content import NO_MATCH
from dvo.odometry.frames.gate import Gate
from dvo.odometry.patch.config import with_changes
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.odometry.segments import result_of_log

_WITH_FEATURES = 32  # frames without a pose whose features are kept until the initialisation
_NOT_INITIALISED = "not initialised"  # reason of a loss: the segment ended before its keyframes agreed with each other


@partial(checked_arguments, skip=("preset",))
def droid_odometry(
    weights: LoadedWeights,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: DenseConfig | None = None,
    preset: str = "default",
    **overrides: Any,
) -> DroidOdometry:
    """Build the odometry of a ``droid`` network.

    Args:
        weights: the network, a :class:`dvo.models.droid.DroidVO`.
        device: of all computation.
        seed: is checked and reported; nothing is drawn at random.
        config: settings; None for the defaults.
        preset: settings on top of these, a name in :data:`dvo.odometry.droid.config.PRESETS`.
        overrides: single settings, by the names of :class:`dvo.odometry.droid.config.DenseConfig`; they win.

    Returns:
        The odometry.

    Raises:
        DvoError: an unknown or invalid setting.
    """
    assert isinstance(weights.model, DroidVO), "the registry gave the builder of another architecture"
    settings = with_changes(config or DenseConfig(), preset, PRESETS, overrides)
    return DroidOdometry(weights.model, settings, seed=seed, device=device, name=f"dvo-{weights.name}")


@dataclass(frozen=True)
class _Waiting:
    """Frame without a pose before the initialisation.

    Attributes:
        frame: position in the log.
        view: what is seen; without features for all but the newest of these frames, so that a camera may stand still.
    """

    frame: int
    view: View


@exclusive
class DroidOdometry:
    """Odometry of one sequence with :class:`dvo.models.droid.DroidVO`.

    Until the initialisation frames have the status ``initialising`` and no pose; ``finish`` gives them one. A frame
    whose measurements do not support its pose is lost. After ``patience`` such frames the segment ends and the next
    one begins, with a world and a scale of its own. The same frames on the same machine give the same trajectory, bit
    for bit on the CPU with a fixed number of threads.

    Args:
        model: the network; moved to ``device`` and used in evaluation mode.
        config: see :class:`dvo.odometry.droid.config.DenseConfig`.
        seed: is checked and reported; nothing is drawn at random.
        device: of all computation.
        name: of the system, in reports.

    Raises:
        DvoError: an invalid seed.

    Example:
        >>> odometry = DroidOdometry(dvo.load_model("droid.safetensors"), DenseConfig())
        >>> for frame in dvo.open("video.mp4", calib="calib.txt"):
        ...     estimate = odometry.track(frame)
        >>> depth = odometry.finish().depth[0].depth
    """

    def __init__(
        self,
        model: DroidVO,
        config: DenseConfig,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        name: str = "droid",
    ) -> None:
        check_seed(seed)
        self.name, self.config, self.seed = name, config, seed
        self.device = torch.device(device)
        self.model = model.to(self.device).eval()
        self.reset()

    def reset(self) -> None:
        """Begin a new sequence as a new odometry with the same seed would."""
        self.log = KeyframeLog()
        self.mapper = DenseMapper(self.model, self.config, self.log)
        self._gate = Gate(self.config.pixels, self.config.max_gap)
        self._last: Estimate | None = None  # of the last frame
        self._recent: list[tuple[float, Tensor]] = []  # times and poses of the last two frames
        self._waiting: list[_Waiting] = []
        self._segment, self._failures = 0, 0
        self._interruption: str | None = None  # cause of that since the last frame with a pose
        self._info: dict[str, Any] = {}

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        Args:
            frame: of the same size as the first, later than the one before, without lens distortion.

        Returns:
            Pose ``T_wc`` of the frame in the world of the first frame of its segment, up to scale; none with the status
            ``initialising`` or ``lost``. The confidence is the mean of that of the measurements.

        Raises:
            DvoError: a frame that :func:`dvo.data.frame_checks.checked_frame` refuses, a timestamp that does not
                increase, an image of another size than the first, a camera with distortion, or a call after ``finish``.
        """
        with self._gate.admit(frame) as admitted:
            if admitted.repeated and self._last is not None:
                self._last = self._repeat(admitted.timestamp, self._last)
                return self._last
            record = self.log.add(admitted.timestamp)
            record.segment = self._segment
            if admitted.problem:
                self._last = self._lose(admitted.timestamp, admitted.problem)
                return self._last
            gap, image, camera = admitted.gap, admitted.image, admitted.camera.intrinsics
            if gap is not None and not gap.frozen and self._recent and self._interruption is None:
                self._interruption = record.reason = str(gap)
            self._info = {"working_size": [*image.shape[1::-1]], "working_intrinsics": camera.tolist()}
            self._last = self._place(self._view(admitted.timestamp, image, camera))
            return self._last

    @torch.inference_mode()
    def finish(self) -> Result:
        """End the sequence. Frames are refused afterwards; a second call gives the same result.

        Returns:
            Trajectories ``T_wc`` of all segments, each in the world of its first frame, up to scale; depth maps of the
            keyframes; the map of the longest segment, fused from the reliable depths.
        """
        if self._gate.finish():
            self._close()
        return self.current()

    @torch.inference_mode()
    def current(self) -> Result:
        """Result so far; tracking goes on.

        Returns:
            As :meth:`finish`; frames that wait for the initialisation have no row.
        """
        config, mapper = self.config, self.mapper
        info = {**self._info, "seed": self.seed, "keyframes": self.log.keyframes, "config": asdict(config)}
        result, main = result_of_log(self.log, info)
        stored = [*mapper.stored, *mapper.in_window(self._segment)]
        maps, clouds = depth_maps(
            stored, mapper.poses(stored), confidence=config.depth_confidence, tolerance=config.depth_tolerance,
            views=config.depth_views,
        )  # fmt: skip
        points = fused([cloud for item, cloud in zip(maps, clouds, strict=True) if item.segment == main])
        return replace(result, map=points, depth=tuple(maps))

    # -- frames --------------------------------------------------------------------------------------------------

    def _view(self, timestamp: float, image: np.ndarray, intrinsics: np.ndarray) -> View:
        pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None, None].to(self.device)
        camera = torch.as_tensor(intrinsics, dtype=torch.float32, device=self.device) / self.model.STRIDE
        return View(timestamp, pixels, self.model.match_features(pixels)[0, 0], camera)

    def _repeat(self, timestamp: float, last: Estimate) -> Estimate:
        """Note a frame with the image of the one before it."""
        before = len(self.log.frames) - 1
        record = self.log.add(timestamp)
        record.follow(self.log.frames[before])
        waiting = next((w for w in reversed(self._waiting) if w.frame == before), None)
        if waiting is not None:
            self._wait(replace(waiting, frame=before + 1))
        return replace(last, timestamp=timestamp)

    def _lose(self, time: float, reason: str) -> Estimate:
        record = self.log.frames[-1]
        record.lost, record.reason = True, reason
        self._interruption = self._interruption or reason
        return Estimate(time, None, Status.LOST, 0.0, self._segment, reason)

    def _place(self, view: View) -> Estimate:
        """Estimate the pose of a frame with content."""
        if self.mapper.ready:
            return self._follow(view)
        if self._interruption is not None and len(self.mapper.window):
            self._close()
        return self._warm_up(view)

    def _warm_up(self, view: View) -> Estimate:
        """Collect keyframes until there are enough for the initialisation."""
        mapper, number = self.mapper, len(self.log.frames) - 1
        record = self.log.frames[number]
        record.segment, self._interruption = self._segment, None
        if not len(mapper.window):
            record.anchor = mapper.add(view, se3.identity(device=self.device))
            return self._initialising(view.timestamp)
        last = mapper.window.keyframes[-1]
        assert view.matching is not None
        updates = self.config.frame_updates
        flow = place_frame(self.model, [last], view.matching, view.intrinsics, last.pose_cw, updates, "flow").found
        if flow.confidence < self.config.lost_confidence:
            self._failures += 1
            if self._failures < self.config.patience:
                estimate = self._lose(view.timestamp, NO_MATCH)
                self._interruption = None
                return estimate
            self._close()
            return self._warm_up(view)
        self._failures = 0
        if flow.flow <= self.config.filter_flow:
            self._wait(_Waiting(number, replace(view, pixels=None)))
            return self._initialising(view.timestamp)
        record.anchor = mapper.add(view, last.pose_cw)
        if len(mapper.window) < self.config.warm_up or not self._initialise():
            return self._initialising(view.timestamp)
        pose = mapper.window.keyframes[-1].pose_cw
        self._recent = [(view.timestamp, pose)]
        return self._tracked(view.timestamp, pose, mapper.confidence)

    def _wait(self, waiting: _Waiting) -> None:
        """Remember a frame for the initialisation."""
        self._waiting.append(waiting)
        if len(self._waiting) > _WITH_FEATURES:
            old = self._waiting[-_WITH_FEATURES - 1]
            self._waiting[-_WITH_FEATURES - 1] = replace(old, view=replace(old.view, matching=None))

    def _initialising(self, time: float) -> Estimate:
        return Estimate(time, None, Status.INITIALISING, 0.0, self._segment)

    def _initialise(self) -> bool:
        """Solve for the first keyframes, and give the frames between them a pose."""
        if not self.mapper.initialise():
            self._give_up()
            return False
        self.mapper.place_between([(waiting.frame, waiting.view) for waiting in self._waiting])
        self._waiting = []
        return True

    def _follow(self, view: View) -> Estimate:
        """Place a frame against the newest keyframes; it may become the next one."""
        config, mapper = self.config, self.mapper
        before = self._recent[-2] if len(self._recent) > 1 and self._interruption is None else None
        start = predicted_pose(before, self._recent[-1], view.timestamp, config.motion_damping)
        anchors = mapper.window.keyframes[:-3:-1]
        assert view.matching is not None
        placed = place_frame(
            self.model, anchors, view.matching, view.intrinsics, start, config.frame_updates, kernel=config.kernel
        )
        found = placed.found
        if not mapper.supports(found, joining=self._interruption is not None):
            return self._fail(view)
        self._failures, self._interruption = 0, None
        pose, number = placed.pose_cw, len(self.log.frames) - 1
        if found.flow > config.filter_flow:
            self.log.frames[number].anchor = mapper.add(view, pose)
            mapper.refine(self._segment)
            pose = torch.from_numpy(self._pose_of(number)).to(pose)
        else:
            self.log.place(number, mapper.window.keyframes[-1].number, pose.double().cpu().numpy())
        self._recent = [*self._recent[-1:], (view.timestamp, pose)]
        return self._tracked(view.timestamp, pose, found.confidence)

    def _pose_of(self, number: int) -> np.ndarray:
        pose = self.log.pose(number)
        assert pose is not None
        return pose

    def _fail(self, view: View) -> Estimate:
        """Note a frame that could not be joined; after too many of them the next segment begins."""
        self._failures += 1
        if self._failures < self.config.patience:
            return self._lose(view.timestamp, NO_MATCH)
        self._close()
        return self._warm_up(view)

    def _tracked(self, time: float, pose_cw: Tensor, confidence: float) -> Estimate:
        pose_wc = se3.normalise(se3.inverse(pose_cw.double())).cpu().numpy()
        return Estimate(time, pose_wc, Status.TRACKING, min(1.0, max(0.0, confidence)), self._segment)

    # -- segments ------------------------------------------------------------------------------------------------

    def _close(self) -> None:
        """End the segment: initialise it with what there is, store its depths, and empty the window."""
        mapper = self.mapper
        if len(mapper.window) and not mapper.ready:
            self._initialise()
        used = mapper.ready
        mapper.close(self._segment)
        self._segment += used
        self._recent, self._waiting, self._failures, self._interruption = [], [], 0, None

    def _give_up(self) -> None:
        """Lose the frames of keyframes that do not agree with each other."""
        for keyframe in list(self.mapper.window.keyframes):
            self.log.lose(keyframe.number, _NOT_INITIALISED)
        for waiting in self._waiting:
            record = self.log.frames[waiting.frame]
            record.lost, record.reason = True, _NOT_INITIALISED
        self._waiting = []
        self.mapper.discard()
