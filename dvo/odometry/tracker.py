"""Streaming tracker of patch-flow visual odometry over a keyframe graph (DPVO 3.4).

For each frame: extract features and patches; predict the pose; add edges between its patches and recent frames, both
ways; run the network and bundle adjustment on the window; and, a few frames later, keep or drop the frame as a
keyframe. Keyframes that leave the window are archived (:mod:`dvo.graph.keyframe_graph`).
"""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import torch

from dvo.ba.cold_start import COLD_UPDATES, damping_at
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.graph.archive import ArchiveConfig
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.window import Keyframe, Window
from dvo.models.patch_vo import PatchVO
from dvo.models.step import StepOptions, recent_depth
from dvo.nets.patchifier import patch_coordinates
from dvo.odometry.config import TrackerConfig
from dvo.odometry.front_end import observe
from dvo.odometry.initialisation import initialise, median_revision
from dvo.odometry.motion import flow_magnitude, predict_pose
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status
from dvo.odometry.window_correlation import WindowCorrelation
from dvo.odometry.window_step import WindowStep

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
        self.name = name
        self.config = config
        self.device = torch.device(device)
        self.model = model.to(self.device).eval()
        self.seed = seed
        self._generator = torch.Generator().manual_seed(seed)
        c = model.config
        self.graph = KeyframeGraph(config.patches, c.patch_size, c.hidden_channels, self.device, archive)
        self.correlation = WindowCorrelation(self.window, c, self.device)
        self._step = WindowStep(self.model, self.window, self.correlation)
        self._count = 0
        self._initialised = False
        self._lost_in_a_row = 0
        self._size: tuple[int, int] | None = None
        self._info: dict[str, object] = {}

    @property
    def window(self) -> Window:
        """Active keyframes and edges."""
        return self.graph.window

    # -- streaming -----------------------------------------------------------------------------------------------

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        Args:
            frame: of the same size as the first, later than the one before, without lens distortion.

        Returns:
            Pose ``T_wc`` of the frame in the world of the first keyframe, up to scale, and the state of the tracker.

        Raises:
            DvoError: a timestamp that does not increase, an image of another size than the first, or a camera with
                distortion.
        """
        frame = checked_frame(frame)
        self._check(frame)
        window, config = self.window, self.config
        keyframe = self._append(frame)
        self._connect()
        if not self._initialised and len(window) > 1 and self._is_still():
            return self._skip(frame)
        record = self.graph.log.add(frame.timestamp, keyframe.identifier)
        before = window.snapshot()
        if self._initialised:
            searching = 0 < self._lost_in_a_row <= config.patience
            for _ in range(config.search_updates if searching else config.updates):
                self._update()
        elif len(window) >= config.initial_frames:
            self._initialised = initialise(window, self._step, config)
        confidence = self._confidence()
        record.lost = lost = self._initialised and confidence < config.lost_confidence
        pose_wc = self._pose_wc(len(window) - 1)
        self._lost_in_a_row = self._lost_in_a_row + 1 if lost else 0
        if 0 < self._lost_in_a_row <= config.patience:
            # The pose of a lost frame is unreliable: without it, the next frames are joined with those before it.
            window.restore(before)
            self.graph.discard(len(window) - 1)
            record.anchor = window.frames[-1].identifier
        else:
            self._reduce()
        status = Status.LOST if lost else Status.TRACKING if self._initialised else Status.INITIALISING
        return Estimate(frame.timestamp, pose_wc, status, confidence)

    @torch.inference_mode()
    def finish(self) -> Result:
        """Refine the last window and archive it.

        Returns:
            Trajectory ``T_wc`` of all tracked frames and sparse map, in the world of the first keyframe, up to scale.
        """
        window, config, log = self.window, self.config, self.graph.log
        if len(window) > 1:
            for age in range(config.final_updates if self._initialised else config.initial_updates):
                self._update(COLD_UPDATES if self._initialised else age)
        while len(window):
            self.graph.archive_oldest()
        trajectory, read = log.trajectory(), len(log.frames)
        info = {
            **self._info, "keyframes": log.keyframes, "seed": self.seed, "initialised": self._initialised,
            "config": asdict(config),
        }  # fmt: skip
        return Result(trajectory, SparseMap(*self.graph.points()), read, read - len(trajectory), info)

    # -- parts of a frame ----------------------------------------------------------------------------------------

    def _check(self, frame: Frame) -> None:
        past = self.graph.log.frames
        if past and frame.timestamp <= past[-1].timestamp:
            raise DvoError(
                f"time {frame.timestamp} does not come after {past[-1].timestamp}",
                field=f"frame {frame.index}",
                remedy="give frames in order of time",
            )
        size = (frame.image.shape[1], frame.image.shape[0])
        if self._size is not None and self._size != size:
            raise DvoError(
                f"is {size[0]}x{size[1]}, the frames before are {self._size[0]}x{self._size[1]}",
                field=f"frame {frame.index}",
                remedy="give frames of one size",
            )
        self._size = size

    def _append(self, frame: Frame) -> Keyframe:
        """Add a frame to the window, with predicted pose and the median depth of the frames before it."""
        config, window, net = self.config, self.window, self.model.config
        seen = observe(self.model, frame, config.pixels, config.patches, self._generator, self.device)
        height, width = seen.image.shape[:2]
        self._info = {"working_size": [width, height], "working_intrinsics": seen.image_intrinsics.tolist()}
        self._step.bounds = seen.bounds
        slot = window.free_map_slot()
        self.correlation.keep_maps(slot, seen.maps)
        keyframe = Keyframe(self._count, frame.timestamp, slot, seen.matching, seen.context, seen.colors,
                            seen.intrinsics, seen.image)  # fmt: skip
        self._count += 1
        depth = torch.ones(1, config.patches, device=self.device)
        if self._initialised:
            depth *= recent_depth(window.patches[None], config.patches, _DEPTH_FRAMES)
        times = [f.timestamp for f in window.frames]
        pose = predict_pose(window.poses_cw, times, frame.timestamp, config.motion_damping)
        window.append(keyframe, pose, patch_coordinates(seen.centres, depth, net.patch_size)[0])
        return keyframe

    def _connect(self) -> None:
        """Join recent patches with the newest frame, and its patches with recent frames."""
        m, n = self.config.patches, len(self.window)
        first = max(0, n - 1 - self.config.lifetime)
        device = self.device
        old = torch.arange(first * m, (n - 1) * m, device=device)
        slots = [self.window.connect(old, torch.full_like(old, n - 1))]
        new = torch.arange((n - 1) * m, n * m, device=device)
        targets = torch.arange(first, n if self.model.config.self_edges else n - 1, device=device)
        slots.append(self.window.connect(new.repeat_interleave(len(targets)), targets.repeat(m)))
        self.correlation.forget(torch.cat(slots))

    def _update(self, age: int = COLD_UPDATES) -> None:
        """Take a step on the window; ``age``, the number of earlier steps, sets the damping of bundle adjustment."""
        fixed = max(1, len(self.window) - self.config.optimisation) if self._initialised else 1
        self._step(StepOptions(fixed=fixed, damping=damping_at(age)))

    def _is_still(self) -> bool:
        """True if the motion from the last keyframe to the newest frame is too small for initialisation."""
        return median_revision(self._step.revise(), self.window) < self.config.initial_motion

    def _skip(self, frame: Frame) -> Estimate:
        """Discard a frame with too little motion for initialisation; it shares the pose of the keyframe before it."""
        self.graph.discard(len(self.window) - 1)
        self.graph.log.add(frame.timestamp, self.window.frames[-1].identifier)
        return Estimate(frame.timestamp, self._pose_wc(len(self.window) - 1), Status.INITIALISING)

    def _reduce(self) -> None:
        """Drop a redundant keyframe, and archive edges and keyframes beyond the maximum age."""
        window, config = self.window, self.config
        n = len(window)
        back = config.keyframe_index
        if self._initialised and n > back + 1:
            i, j = n - back - 1, n - back + 1
            if (flow_magnitude(window, i, j) + flow_magnitude(window, j, i)) / 2 < config.keyframe_motion:
                self.graph.drop(n - back)
        self.graph.keep_edges(window.ii >= len(window) - config.removal)
        limit = config.removal + config.lifetime if self._initialised else config.initial_frames + 4
        while len(window) > limit:
            self.graph.archive_oldest()

    def _confidence(self) -> float:
        """Mean confidence of the edges into the newest frame."""
        newest = self.window.weights[self.window.jj == len(self.window) - 1]
        return float(newest.mean()) if len(newest) else 0.0

    def _pose_wc(self, position: int) -> np.ndarray:
        return se3.inverse(self.window.poses_cw[position]).double().cpu().numpy()
