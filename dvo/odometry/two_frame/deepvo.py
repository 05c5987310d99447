"""Odometry of a pose-regression network: the trajectory is the product of its steps (DeepVO, ICRA 2017)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from dvo.core.arguments import checked_arguments
from dvo.core.settings import check_settings
from dvo.data.frame import Frame
from dvo.geometry import se3
from dvo.models.deepvo import DeepVO, RecurrentState, step_pose
from dvo.models.weights import LoadedWeights
from dvo.odometry.exclusive import exclusive
from dvo.odometry.frames.content import NO_MATCH, matched_share
from dvo.odometry.frames.gate import Gate
from dvo.odometry.patch.config import with_changes
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.odometry.segments import own_copy, result_of_estimates, withdraw

_RANGES = {"pixels": (0, 2**28), "max_gap": (1, math.inf), "min_matches": (0, 1)}


@dataclass(frozen=True)
class RegressionConfig:
    """Settings of :class:`DeepVOOdometry`.

    Attributes:
        pixels: largest number of pixels of the image whose content is judged, and from which the network makes its
            own working image (0: full resolution).
        max_gap: time between two images above which a segment ends, in medians of the recent intervals.
        min_matches: share of the corners of an image that are found in the next one
            (:func:`dvo.odometry.frames.content.matched_share`) below which the two do not show the same scene; 0:
            every image follows the one before it.

    Raises:
        DvoError: a value of another type or out of range.
    """

    pixels: int = 76_800
    max_gap: float = 4.0
    min_matches: float = 0.15

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


@exclusive
class DeepVOOdometry:
    """Odometry of one sequence with :class:`dvo.models.deepvo.DeepVO`.

    A frame has a pose if its image has content (:func:`dvo.odometry.frames.gate.missing_content`) and shows the
    scene of the image before it (:func:`dvo.odometry.frames.content.matched_share`, since the network has no
    measurements of its own); the first one of a segment is its world. A frame that does not is lost. For want of
    measurements no step is taken across lost frames or a gap in time: the next segment begins, with a world and a scale
    of its own and an empty recurrent state. After a cut its first frame is the lost one, which the result gives a pose
    once the frame after it shows the same scene; after images of noise there is none. An image that repeats the one
    before it has the same pose, and the network does not see it. The intrinsics are not used.

    Args:
        model: the network; moved to ``device`` and used in evaluation mode.
        config: settings.
        device: of all computation.
        name: of the system, in reports.
        seed: for the record; no random number is drawn. The same frames on the same machine give the same trajectory,
            bit for bit on the CPU with a fixed number of threads.

    Example:
        >>> odometry = DeepVOOdometry(dvo.load_model("deepvo.safetensors"), RegressionConfig())
        >>> for frame in dvo.open("video.mp4", calib="calib.txt"):
        ...     estimate = odometry.track(frame)
        >>> trajectory = odometry.finish().trajectory
    """

    def __init__(
        self,
        model: DeepVO,
        config: RegressionConfig,
        *,
        device: torch.device | str = "cpu",
        name: str = "deepvo",
        seed: int = 0,
    ) -> None:
        self.name, self.config, self.seed = name, config, seed
        self.device = torch.device(device)
        self.model = model.to(self.device).eval()
        self.reset()

    def reset(self) -> None:
        """Begin a new sequence as a new odometry with the same seed would."""
        self._gate = Gate(self.config.pixels, self.config.max_gap)
        self._estimates: list[Estimate] = []
        self._reasons: dict[float, str] = {}
        self._segment = -1  # number of the newest segment; -1 before the first one
        self._pose_wc = se3.identity(dtype=torch.float64)  # of the newest frame with a pose
        self._before: np.ndarray | None = None  # image that the next step begins with; None: a segment begins
        self._alone: int | None = None  # position of the frame with that image while no other shows its scene
        self._state: RecurrentState | None = None

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        Args:
            frame: of the same size as the first, later than the one before, without lens distortion.

        Returns:
            Pose ``T_wc`` of the frame in the world of the first frame of its segment, in the unit of the network's
            training; or the status ``lost`` with the reason. The confidence is the share of the corners of the image
            before that are found, 1 in the first frame of a segment, and 0 without a pose: the network does not tell
            how sure it is.

        Raises:
            DvoError: a frame that :func:`dvo.data.frame_checks.checked_frame` refuses, a timestamp that does not
                increase, an image of another size than the first, a camera with distortion, or a call after ``finish``.
        """
        with self._gate.admit(frame) as admitted:
            if admitted.repeated:
                last = self._estimates[-1]
                return self._record(admitted.timestamp, last.confidence, last.reason)
            if admitted.problem:
                self._before = self._state = self._alone = None
                return self._record(admitted.timestamp, 0.0, admitted.problem)
            gap, reason = admitted.gap, ""
            if gap and not gap.frozen and self._before is not None:
                self._before, self._alone, reason = None, None, str(gap)
            return self._record(admitted.timestamp, self._advance(admitted.image), reason)

    def finish(self) -> Result:
        """End the sequence. Frames are refused afterwards; a second call gives the same result.

        Returns:
            Trajectories ``T_wc`` of all segments, each in the world of its first frame; no map.
        """
        self._gate.finish()
        return self.current()

    def current(self) -> Result:
        """Result so far; tracking goes on.

        Returns:
            As :meth:`finish`.
        """
        info = {
            "working_size": [self.model.config.width, self.model.config.height], "seed": self.seed,
            "config": asdict(self.config),
        }  # fmt: skip
        return result_of_estimates(self._estimates, self._reasons, info)

    def _advance(self, image: np.ndarray) -> float:
        """Move on to an image, or begin a segment with it.

        Args:
            image: with content.

        Returns:
            Confidence; 0 for an image that does not show the scene of the one before it.
        """
        before, self._before = self._before, image
        if before is None:
            self._begin()
            self._alone = len(self._estimates)
            return 1.0
        share = matched_share(before, image) if self.config.min_matches > 0 else 1.0
        if share < self.config.min_matches or share == 0:
            self._withdraw()
            self._alone = len(self._estimates)
            return 0.0
        self._confirm()
        pair = torch.from_numpy(np.stack([before, image])).to(self.device).permute(0, 3, 1, 2)
        steps, self._state = self.model(pair[None], self._state)
        self._pose_wc = se3.normalise(se3.compose(self._pose_wc, step_pose(steps[0, 0].cpu().double())))
        return share

    def _begin(self) -> None:
        self._segment, self._state, self._pose_wc = self._segment + 1, None, se3.identity(dtype=torch.float64)

    def _withdraw(self) -> None:
        """Take the pose from a frame that began a segment and whose scene no other frame shows."""
        if self._alone is not None and self._estimates[self._alone].pose_wc is not None:
            withdraw(self._estimates, self._reasons, self._alone, NO_MATCH)
            self._segment -= 1

    def _confirm(self) -> None:
        """Begin a segment with the frame before, if that was lost because its scene was new."""
        if self._alone is not None and self._estimates[self._alone].pose_wc is None:
            self._begin()
            for position in range(self._alone, len(self._estimates)):
                time = self._estimates[position].timestamp
                self._estimates[position] = self._estimate(time, 1.0, "")
                if position > self._alone:  # it repeats the first one, which has the reason of the break
                    self._reasons.pop(time, None)
        self._alone = None

    def _record(self, time: float, confidence: float, reason: str) -> Estimate:
        """Note a frame.

        Args:
            time: of the frame, seconds.
            confidence: 0 if it has no pose.
            reason: cause of a loss, or of a new segment.
        """
        if not (reason or confidence):
            reason = NO_MATCH
        if reason:
            self._reasons[time] = reason
        self._estimates.append(self._estimate(time, confidence, reason))
        return own_copy(self._estimates[-1])

    def _estimate(self, time: float, confidence: float, reason: str) -> Estimate:
        """Estimate of the newest pose, or of none; arguments as of :meth:`_record`."""
        if not confidence:
            return Estimate(time, None, Status.LOST, 0.0, max(0, self._segment), reason)
        return Estimate(time, self._pose_wc.numpy().copy(), Status.TRACKING, confidence, self._segment)


PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": {"pixels": 160 * 120},
    "accurate": {"pixels": 448 * 336},
}
"""Settings that trade accuracy for speed, by the names of those of the other odometries. The network works at the size
that its weights fix, so that they differ little."""


@partial(checked_arguments, skip=("preset",))
def deepvo_odometry(
    weights: LoadedWeights,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: RegressionConfig | None = None,
    preset: str = "default",
    **overrides: Any,
) -> DeepVOOdometry:
    """Build the odometry of a ``deepvo`` network.

    Args:
        weights: the network, a :class:`dvo.models.deepvo.DeepVO`.
        device: of all computation.
        seed: for the record.
        config: settings; None for the defaults.
        preset: settings on top of these, a name in :data:`PRESETS`.
        overrides: single settings, by the names of :class:`RegressionConfig`; they win.

    Returns:
        The odometry.

    Raises:
        DvoError: an unknown or invalid setting.
    """
    assert isinstance(weights.model, DeepVO), "the registry gave the builder of another architecture"
    settings = with_changes(config or RegressionConfig(), preset, PRESETS, overrides)
    return DeepVOOdometry(weights.model, settings, device=device, name=f"dvo-{weights.name}", seed=seed)
