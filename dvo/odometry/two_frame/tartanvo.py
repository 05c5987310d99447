"""Odometry of the two-frame network: the product of the motions between neighbouring frames (TartanVO).

**Scale.** The network gives the direction of each step and not its length. The length is the one for which the median
depth of what the flow sees is one (``scale="parallax"``): a camera that slows down or stands still takes shorter steps
or none, which steps of constant length (``scale="unit"``, TartanVO without the lengths of a ground truth) cannot say.
Either way the unit of the trajectory is free, and evaluation aligns it by Sim(3); nothing ties the scale of distant
frames together, so a scene whose depth changes along the way changes the scale with it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from dvo.core.arguments import checked_arguments
from dvo.core.settings import check_settings
from dvo.data.frame import Frame
from dvo.geometry import se3
from dvo.models.tartanvo import TartanVO
from dvo.models.weights import LoadedWeights
from dvo.odometry.exclusive import exclusive
from dvo.odometry.frames.content import NO_MATCH, matched_share
from dvo.odometry.frames.gate import Admitted, Gate
from dvo.odometry.patch.config import with_changes
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.odometry.segments import own_copy, result_of_estimates, withdraw
from dvo.odometry.two_frame.epipolar_refinement import refine_motion
from dvo.odometry.two_frame.flow_reliability import flow_weights
from dvo.odometry.two_frame.two_view import parallax_of, returning_share

UNRELATED = "new scene"
"""Reason of a break before a frame that does not show what was seen before an interruption."""

ScaleRule = Literal["parallax", "unit"]
"""Length of a step: such that the median depth is one, or one; see :mod:`dvo.odometry.two_frame.tartanvo`."""

_RANGES = {
    "pixels": (0, 2**28),
    "longest": (0, 1e6),
    "join_share": (0, 1),
    "max_gap": (1, float("inf")),
    "min_matches": (0, 1),
}


@dataclass(frozen=True)
class TwoFrameConfig:
    """Settings of :class:`TartanOdometry`.

    Attributes:
        pixels: largest number of pixels of the working image; the aspect is kept (0: full resolution).
        scale: see :data:`ScaleRule`.
        refine: improve the motion of the pose network by the epipolar residuals of the flow
            (:func:`dvo.odometry.two_frame.epipolar_refinement.refine_motion`), weighted by
            :func:`dvo.odometry.two_frame.flow_reliability.flow_weights`; TartanVO does not.
        longest: limit of the length of a step, in median depths, with ``scale="parallax"``.
        join_share: share of the pixels that flow there and back must bring home for a frame after an interruption
            (frames without content, or a gap in time) to go on in the segment before it; otherwise it begins the next
            one.
        max_gap: time between frames above which they are separated by a gap, in medians of the recent intervals.
        min_matches: share of the corners of an image that are found in the next one
            (:func:`dvo.odometry.frames.content.matched_share`) below which the two do not show the same scene; 0:
            every image is taken for a view.

    Raises:
        DvoError: a value of the wrong type or out of range, with the name of the setting.

    Example:
        >>> odometry = dvo.load("tartanvo.safetensors", scale="unit")
    """

    pixels: int = 320 * 240
    scale: ScaleRule = "parallax"
    refine: bool = False
    longest: float = 2.0
    join_share: float = 0.3
    max_gap: float = 4.5
    min_matches: float = 0.15

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


NETWORK_DEFAULTS: dict[str, TwoFrameConfig] = {
    "small": TwoFrameConfig(refine=True),  # its pose network has 0.4 of the 15 million parameters of the published one
    "full": TwoFrameConfig(pixels=640 * 480),  # it was trained on 640x448
}
"""Settings of a preset of the network; others have those of :class:`TwoFrameConfig`."""

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": {"pixels": 256 * 192},
    "accurate": {"pixels": 448 * 336},
}
"""Settings that trade accuracy for speed; ``dvo.load("tartanvo.safetensors", preset="fast")``."""


@partial(checked_arguments, skip=("preset",))
def tartan_odometry(
    weights: LoadedWeights,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: TwoFrameConfig | None = None,
    preset: str = "default",
    **overrides: Any,
) -> TartanOdometry:
    """Build the odometry of a ``tartanvo`` network.

    Args:
        weights: the network, a :class:`dvo.models.tartanvo.TartanVO`.
        device: of all computation.
        seed: is checked and reported; nothing is drawn at random.
        config: settings; None for those of the network.
        preset: settings on top of these, a name in :data:`PRESETS`.
        overrides: single settings, by the names of :class:`TwoFrameConfig`; they win.

    Returns:
        The odometry.

    Raises:
        DvoError: an unknown or invalid setting.
    """
    assert isinstance(weights.model, TartanVO), "the registry gave the builder of another architecture"
    config = config or NETWORK_DEFAULTS.get(weights.preset, TwoFrameConfig())
    settings = with_changes(config, preset, PRESETS, overrides)
    return TartanOdometry(weights.model, settings, seed=seed, device=device, name=f"dvo-{weights.name}")


@dataclass(frozen=True)
class _View:
    """Last frame with content."""

    features: list[Tensor]
    image: np.ndarray
    pose_wc: Tensor  # (7,) float64
    motion: Tensor | None = None  # (7,) of the frame in the coordinates of the one before it, without a length


@exclusive
class TartanOdometry:
    """Odometry of one sequence with :class:`dvo.models.tartanvo.TartanVO`.

    A frame gets a pose if its image has content and shows the scene of the image before it
    (:func:`dvo.odometry.frames.content.matched_share`); images of noise do not, nor does the first one of another
    scene, which the result gives a pose once the frame after it agrees with it. After such frames, or a gap in time,
    the motion since the last frame with a pose counts if the flow there and the flow back agree; if they do not, the
    frame begins a segment with a world and a scale of its own.

    Args:
        model: the network; moved to ``device`` and used in evaluation mode.
        config: see :class:`TwoFrameConfig`.
        seed: is checked and reported; nothing is drawn at random: the same frames on the same machine give the same
            trajectory, bit for bit on the CPU with a fixed number of threads.
        device: of all computation.
        name: of the system, in reports.

    Example:
        >>> odometry = TartanOdometry(dvo.load_model("tartanvo.safetensors"), TwoFrameConfig())
        >>> for frame in dvo.open("video.mp4", calib="calib.txt"):
        ...     estimate = odometry.track(frame)
        >>> trajectory = odometry.finish().trajectory
    """

    def __init__(
        self,
        model: TartanVO,
        config: TwoFrameConfig,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        name: str = "tartanvo",
    ) -> None:
        self.name, self.config, self.seed = name, config, seed
        self.device = torch.device(device)
        self.model = model.to(self.device).eval()
        self.reset()

    def reset(self) -> None:
        """Begin a new sequence as a new odometry with the same seed would."""
        self._gate = Gate(self.config.pixels, self.config.max_gap)
        self._view: _View | None = None
        self._estimates: list[Estimate] = []
        self._reasons: dict[float, str] = {}  # of losses and breaks, by timestamp
        self._segment = 0
        self._interruption: str | None = None  # cause of that since the last frame with a pose
        self._shown: np.ndarray | None = None  # image of the last frame, if it had content
        self._alone: int | None = None  # position of that frame if it began a segment, or waits to be placed
        self._pending: tuple[float, np.ndarray, np.ndarray] | None = None  # that frame, if it has no pose for it
        self._info: dict[str, Any] = {}

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        Args:
            frame: of the same size as the first, later than the one before, without lens distortion.

        Returns:
            Pose ``T_wc`` of the frame in the world of the first frame of its segment, up to scale; none, with the
            status ``lost``, for an image without content. The confidence is the share of the flow that lies on the
            epipolar lines of the motion.

        Raises:
            DvoError: a frame that :func:`dvo.data.frame_checks.checked_frame` refuses, a timestamp that does not
                increase, an image of another size than the first, a camera with distortion, or a call after ``finish``.
        """
        with self._gate.admit(frame) as admitted:
            repeated = admitted.repeated
            time = admitted.timestamp
            estimate = replace(self._estimates[-1], timestamp=time) if repeated else self._measure(admitted)
        if estimate.status is Status.LOST:
            self._reasons[admitted.timestamp] = estimate.reason
        self._estimates.append(estimate)
        return own_copy(estimate)

    def finish(self) -> Result:
        """Give the result. Frames are refused afterwards; a second call gives the same result.

        Returns:
            Trajectories ``T_wc`` of all segments, each in the world of its first frame, up to scale; no map.
        """
        self._gate.finish()
        return self.current()

    def current(self) -> Result:
        """Result so far; tracking goes on.

        Returns:
            As :meth:`finish`.
        """
        info = {**self._info, "seed": self.seed, "config": asdict(self.config)}
        return result_of_estimates(self._estimates, self._reasons, info)

    def _measure(self, admitted: Admitted) -> Estimate:
        """Estimate of a frame with an image of its own."""
        time, image, gap, camera = admitted.timestamp, admitted.image, admitted.gap, admitted.camera.intrinsics
        if gap is not None:  # the flow decides if the view is that before it
            self._shown = self._alone = self._pending = None
        problem = admitted.problem or self._stranger(time, image, camera)
        if problem:
            self._interruption = self._interruption or problem
            if problem != NO_MATCH:
                self._shown = self._alone = self._pending = None
            return Estimate(time, None, Status.LOST, 0.0, self._segment, problem)
        if gap is not None and self._view is not None and self._interruption is None:
            self._interruption = str(gap)
            if not gap.frozen:
                self._reasons[time] = str(gap)
        self._info = {"working_size": [*image.shape[1::-1]], "working_intrinsics": camera.tolist()}
        if self._pending is not None:  # its scene is confirmed
            self._admit(*self._pending)
        return self._place(time, image, camera)

    def _stranger(self, timestamp: float, image: np.ndarray, intrinsics: np.ndarray) -> str:
        """Find out if a frame with content does not show the scene of the frame before it, and remember it."""
        before, self._shown = self._shown, image
        least = self.config.min_matches
        if before is None or not least or matched_share(before, image) >= least:
            return ""
        if self._alone is not None and self._pending is None:  # the frame before it began a segment
            withdraw(self._estimates, self._reasons, self._alone, NO_MATCH)
            self._view = None
        self._alone, self._pending = len(self._estimates), (timestamp, image, intrinsics)
        return NO_MATCH

    def _admit(self, timestamp: float, image: np.ndarray, intrinsics: np.ndarray) -> None:
        """Give the frame that waits, and those that repeat it, the pose that they lacked."""
        assert self._alone is not None
        waiting = range(self._alone, len(self._estimates))
        for position in waiting:
            self._reasons.pop(self._estimates[position].timestamp, None)
        placed = self._place(timestamp, image, intrinsics)
        for position in waiting:
            self._estimates[position] = replace(placed, timestamp=self._estimates[position].timestamp)
        self._alone = self._pending = None

    def _place(self, timestamp: float, image: np.ndarray, intrinsics: np.ndarray) -> Estimate:
        """Estimate the pose of a frame with content."""
        pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].to(self.device)
        features = self.model.encode(pixels)
        view, interruption, self._interruption = self._view, self._interruption, None
        start = se3.identity(dtype=torch.float64)
        self._alone = len(self._estimates)
        if view is None:
            return self._stand(timestamp, (features, image), start, 1.0)
        camera = torch.as_tensor(intrinsics, dtype=torch.float32, device=self.device)[None]
        motion = self.model.between(view.features, features, camera)
        flow = motion.flows.flow[0].cpu().numpy()
        if interruption is not None:
            back = self.model.matching.match(features, view.features).flow[0].cpu().numpy()
            if returning_share(flow, back) < self.config.join_share:
                self._segment += 1
                self._reasons.setdefault(timestamp, UNRELATED)
                return self._stand(timestamp, (features, image), start, 1.0)
        self._alone = None
        pose_ab = se3.normalise(motion.poses_ab()[0].double().cpu())
        if self.config.refine:
            starts = [pose_ab] if view.motion is None else [pose_ab, view.motion]
            weights = torch.from_numpy(flow_weights(view.image, image, flow))
            camera_ab = torch.from_numpy(intrinsics) / self.model.STRIDE
            pose_ab = refine_motion(torch.from_numpy(flow), starts, camera_ab, weights=weights)
        direction = pose_ab.clone()
        parallax = parallax_of(flow, pose_ab.numpy(), intrinsics / self.model.STRIDE)
        if self.config.scale == "parallax":
            pose_ab[:3] *= parallax.step(self.config.longest)
        pose_wc = se3.normalise(se3.compose(view.pose_wc, pose_ab))
        return self._stand(timestamp, (features, image), pose_wc, parallax.agreement(), direction)

    def _stand(
        self,
        timestamp: float,
        shown: tuple[list[Tensor], np.ndarray],
        pose_wc: Tensor,
        confidence: float,
        motion: Tensor | None = None,
    ) -> Estimate:
        """Keep a frame as the one that the next motion starts from."""
        self._view = _View(*shown, pose_wc, motion)
        return Estimate(timestamp, pose_wc.numpy().copy(), Status.TRACKING, confidence, self._segment)
