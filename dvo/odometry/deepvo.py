"""Odometry of a pose-regression network: the trajectory is the product of its steps (DeepVO, ICRA 2017)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.models.deepvo import DeepVO, RecurrentState, step_pose
from dvo.models.weights import LoadedWeights
from dvo.odometry.evidence import missing_content
from dvo.odometry.frame_sequence import FrameSequence
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.odometry.segments import result_of_estimates
from dvo.odometry.working_image import working_image
from dvo.settings import check_names, check_settings

_RANGES = {"pixels": (0, 2**28), "max_gap": (1, math.inf)}


@dataclass(frozen=True)
class RegressionConfig:
    """Settings of :class:`DeepVOOdometry`.

    Attributes:
        pixels: largest number of pixels of the image whose content is judged, and from which the network makes its
            own working image (0: full resolution).
        max_gap: time between two images above which a segment ends, in medians of the recent intervals.

    Raises:
        DvoError: a value of another type or out of range.
    """

    pixels: int = 76_800
    max_gap: float = 4.0

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


class DeepVOOdometry:
    """Odometry of one sequence with :class:`dvo.models.deepvo.DeepVO`.

    Every frame whose image has content has a pose; the first one of a segment is its world. A frame without content is
    lost (:func:`dvo.odometry.evidence.missing_content`). The network has no measurements that could bear out the step
    across frames without a view, or across a gap in time: the frame after it begins the next segment, with a world and
    a scale of its own and an empty recurrent state. For the same reason an image of strong noise passes for a view.
    An image that repeats the one before it has the same pose, and the network does not see it. The intrinsics are not
    used.

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
        self._sequence = FrameSequence(config.max_gap)
        self._estimates: list[Estimate] = []
        self._reasons: dict[float, str] = {}
        self._segment = -1  # number of the newest segment; -1 before the first one
        self._pose_wc = se3.identity(dtype=torch.float64)  # of the newest frame with a pose
        self._before: Tensor | None = None  # image (3, H, W) that the next step begins with; None: a segment begins
        self._state: RecurrentState | None = None
        self._last: np.ndarray | None = None  # last image
        self._finished = False

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        Args:
            frame: of the same size as the first, later than the one before, without lens distortion.

        Returns:
            Pose ``T_wc`` of the frame in the world of the first frame of its segment, in the unit of the network's
            training; or the status ``lost`` with the reason. The confidence is 1 with a pose, otherwise 0: the network
            does not tell how sure it is.

        Raises:
            DvoError: a frame that :func:`dvo.data.frame_checks.checked_frame` refuses, a timestamp that does not
                increase, an image of another size than the first, a camera with distortion, or a call after ``finish``.
        """
        if self._finished:
            raise DvoError("the sequence is finished", field="track()", remedy="build an odometry for each sequence")
        frame = checked_frame(frame)
        image, _ = working_image(frame, self.config.pixels)
        self._sequence.check(frame)
        if self._last is not None and np.array_equal(image, self._last):
            self._sequence.repeat(frame.timestamp)
            last = self._estimates[-1]
            return self._record(frame.timestamp, last.pose_wc is None, last.reason)
        self._last = image
        gap = self._sequence.tick(frame.timestamp)
        problem = missing_content(image)
        if problem:
            self._before = self._state = None
            return self._record(frame.timestamp, True, problem)
        reason = ""
        if gap and not gap.frozen and self._before is not None:
            self._before, reason = None, str(gap)
        self._advance(torch.from_numpy(image).to(self.device).permute(2, 0, 1))
        return self._record(frame.timestamp, False, reason)

    def finish(self) -> Result:
        """End the sequence. Frames are refused afterwards; a second call gives the same result.

        Returns:
            Trajectories ``T_wc`` of all segments, each in the world of its first frame; no map.
        """
        self._finished = True
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

    def _advance(self, image: Tensor) -> None:
        """Move on to an image, or begin a segment with it."""
        if self._before is None:
            self._segment, self._state, self._pose_wc = self._segment + 1, None, se3.identity(dtype=torch.float64)
        else:
            steps, self._state = self.model(torch.stack([self._before, image])[None], self._state)
            self._pose_wc = se3.normalise(se3.compose(self._pose_wc, step_pose(steps[0, 0].cpu().double())))
        self._before = image

    def _record(self, time: float, lost: bool, reason: str) -> Estimate:
        """Note a frame.

        Args:
            time: of the frame, seconds.
            lost: it has no pose.
            reason: cause of a loss, or of a new segment.
        """
        if reason:
            self._reasons[time] = reason
        if lost:
            estimate = Estimate(time, None, Status.LOST, 0.0, max(0, self._segment), reason)
        else:
            estimate = Estimate(time, self._pose_wc.numpy().copy(), Status.TRACKING, 1.0, self._segment)
        self._estimates.append(estimate)
        return estimate


def deepvo_odometry(
    weights: LoadedWeights,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: RegressionConfig | None = None,
    **overrides: Any,
) -> DeepVOOdometry:
    """Build the odometry of a ``deepvo`` network.

    Args:
        weights: the network, a :class:`dvo.models.deepvo.DeepVO`.
        device: of all computation.
        seed: for the record.
        config: settings; None for the defaults.
        overrides: single settings, by the names of :class:`RegressionConfig`.

    Returns:
        The odometry.

    Raises:
        DvoError: an unknown or invalid setting.
    """
    assert isinstance(weights.model, DeepVO), "the registry gave the builder of another architecture"
    check_names(RegressionConfig, overrides)
    config = replace(config or RegressionConfig(), **overrides)
    return DeepVOOdometry(weights.model, config, device=device, name=f"dvo-{weights.name}", seed=seed)
