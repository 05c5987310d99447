"""Semi-dense direct odometry in the manner of LSD-SLAM: keyframes with filtered inverse depth, photometric alignment.

Reads like this: :meth:`DirectOdometry.track` aligns the new image to the keyframe (:meth:`_align`), measures the
keyframe's depths in it (:meth:`_measure`), and when the camera has gone far enough carries the depths over to a new
keyframe (:meth:`_next_keyframe`). The first keyframe comes from two views (:mod:`dvo.odometry.classical.direct.start`).
Keyframes stay where they were put: no pose graph, no joint optimisation.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import cv2
import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.settings import changed
from dvo.data.frame import Frame
from dvo.odometry.classical.direct.align import Alignment, Reference, align
from dvo.odometry.classical.direct.depth import DepthConfig, DepthMap
from dvo.odometry.classical.direct.image import Level, pyramid
from dvo.odometry.classical.direct.start import TwoViewStart, spread
from dvo.odometry.classical.direct.stereo import StereoConfig, search_lines
from dvo.odometry.classical.frame_log import FrameLog, map_of
from dvo.odometry.exclusive import sheltered
from dvo.odometry.frames.gate import Admitted, Gate
from dvo.odometry.protocol import Estimate, Result, Status


@dataclass(frozen=True)
class DirectConfig:
    """Settings; pixels are those of the working image, intensities from 0 to 255.

    Attributes:
        pixels: budget of the working image.
        iterations: of the alignment, per level of the pyramid, finest first.
        noise: standard deviation of an intensity in the alignment (sensor, and what the model leaves out).
        huber: normalised residual from which the loss is linear.
        start_parallax: rotation-compensated parallax of the first two views, as part of the focal length; while the
            camera waits, half of it comes to be enough.
        start_wait: frames after which half is enough.
        keyframe_distance: way from the keyframe, in units of its mean depth, from which another is made.
        keyframe_overlap: part of the keyframe's pixels still seen below which another is made.
        lost_overlap, lost_agreement: parts of pixels seen and of those that fit below which the camera is lost.
        sure_agreement: above it no second prediction is tried.
        gains: brightness relative to the keyframe outside which it is lost.
        views: images since the last keyframe in which the depths of a new one are measured at once.
        patience: lost frames after which a new start is made.
        map_points: points of each keyframe in the map.
    """

    pixels: int = 76800
    iterations: tuple[int, ...] = (8, 12, 16, 20, 20)
    noise: float = 6.0
    huber: float = 1.345
    start_parallax: float = 0.05
    start_wait: int = 15
    keyframe_distance: float = 0.12
    keyframe_overlap: float = 0.75
    lost_overlap: float = 0.3
    lost_agreement: float = 0.6
    sure_agreement: float = 0.9
    gains: tuple[float, float] = (0.4, 2.5)
    views: int = 4
    patience: int = 10
    map_points: int = 400
    depth: DepthConfig = field(default_factory=DepthConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)


@dataclass
class Keyframe:
    """The image that others are aligned to.

    Attributes:
        T_cw: ``(4, 4)`` world to camera.
        depth: of its pixels.
        levels: pyramid, finest first.
        references: what the next image is aligned to; renewed with the depths.
        colors: ``(H, W, 3)`` uint8 RGB.
        seen: images since, with their alignment.
    """

    T_cw: np.ndarray
    depth: DepthMap
    levels: list[Level]
    references: list[Reference]
    colors: np.ndarray
    seen: list[tuple[Level, Alignment]] = field(default_factory=list)


@sheltered
class DirectOdometry:
    """See the module. Deterministic for a seed; poses are up to scale, the first frame is the world."""

    name = "direct"

    @checked_arguments
    def __init__(self, config: DirectConfig | None = None, seed: int = 0, **settings: Any) -> None:
        self.config = changed(config or DirectConfig(), settings)
        self._seed = seed
        self._gate = Gate(self.config.pixels)
        self._log = FrameLog()
        self._intrinsics, self._size = np.ones(4), (0, 0)
        self._key: Keyframe | None = None
        self._start: TwoViewStart | None = None
        self._pending: list[tuple[int, list[Level], np.ndarray]] = []  # frame, pyramid, colours since the start began
        self._last = Alignment(np.eye(4), 1.0, 0.0, 1.0, 1.0, 0.0)  # of the last image to the keyframe
        self._motion = np.eye(4)
        self._speed: float | None = None  # distance per frame, running mean
        self._blind = 0
        self._map: list[tuple[np.ndarray, np.ndarray]] = []
        self._counts = {"maps_started": 0, "keyframes": 0}

    def track(self, frame: Frame) -> Estimate:
        with self._gate.admit(frame) as admitted:
            return self._process(admitted)

    def _process(self, admitted: Admitted) -> Estimate:
        if admitted.repeated and not admitted.problem:
            return self._log.repeat(admitted.timestamp)
        index, image, camera = self._log.begin(admitted.timestamp), admitted.image, admitted.camera
        self._intrinsics, self._size = camera.intrinsics, (camera.width, camera.height)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        levels = pyramid(grey.astype(np.float32), camera.intrinsics, len(self.config.iterations))
        if self._key is None and admitted.problem:
            self._start, self._pending = None, []
            return self._log.lose(index, admitted.problem)
        if self._key is None:
            return self._initialise(grey, levels, image, index)
        found = None if admitted.problem else self._align(self._key, levels)
        if found is None:
            self._blind += 1
            if self._blind >= self.config.patience:
                self._retire(self._key)
                self._key, self._start, self._blind = None, None, 0
                self._initialise(grey, levels, image, index)
            return self._log.lose(index, admitted.problem)
        self._moved(index, self._key, found)
        self._measure(self._key, levels[0], found)
        shift = np.linalg.norm(found.T[:3, 3]) * self._typical(self._key)
        if shift > self.config.keyframe_distance or found.overlap < self.config.keyframe_overlap:
            self._next_keyframe(levels, image, found)
        return self._log.estimate(Status.TRACKING, found.agreement)

    def finish(self) -> Result:
        self._gate.finish()
        if self._key is not None:
            self._retire(self._key)
            self._key = None
        info = {
            "working_size": list(self._size),
            "working_intrinsics": self._intrinsics.tolist(),
            **self._counts,
            "config": asdict(self.config),
        }
        return self._log.result(map_of(self._map), info)

    # --- every frame --------------------------------------------------------------------------------------------------

    def _align(self, key: Keyframe, levels: list[Level]) -> Alignment | None:
        """Pose of an image against the keyframe: from the motion model, and where that is not convincing from the last
        pose, whichever fits better. None if lost."""
        c, last = self.config, self._last
        best: Alignment | None = None
        for T in (self._motion @ last.T, last.T):
            found = align(
                key.references,
                levels,
                T,
                gain=last.gain,
                offset=last.offset,
                noise=c.noise,
                huber=c.huber,
                iterations=c.iterations,
            )
            fits = found.overlap > c.lost_overlap and found.agreement > c.lost_agreement
            fits = fits and c.gains[0] < found.gain < c.gains[1]
            if fits and (best is None or found.residual < best.residual):
                best = found
            if fits and found.agreement > c.sure_agreement:
                break
        return best

    def _moved(self, index: int, key: Keyframe, found: Alignment) -> None:
        """Take a pose and learn the motion."""
        step = found.T @ np.linalg.inv(self._last.T)
        self._log.set_pose(index, found.T @ key.T_cw)
        if self._blind == 0:
            self._motion = step
            length = float(np.linalg.norm(step[:3, 3]))
            self._speed = length if self._speed is None else 0.9 * self._speed + 0.1 * length
        else:
            self._motion = np.eye(4)
        self._last, self._blind = found, 0

    def _measure(self, key: Keyframe, level: Level, found: Alignment) -> None:
        """Stereo of the keyframe with an aligned image."""
        self._observe(key, level, found.T, found.gain, found.offset)
        key.references = key.depth.references(key.levels)
        key.seen.append((level, found))

    def _observe(self, key: Keyframe, level: Level, T: np.ndarray, gain: float, offset: float) -> None:
        uv, at = key.depth.pixels()
        prior = key.depth.mean[at], key.depth.variance[at]
        matches = search_lines(key.levels[0], level, T, uv, *prior, gain, offset, self.config.stereo)
        key.depth.update(at, matches)

    def _typical(self, key: Keyframe) -> float:
        """Mean inverse depth of a keyframe, every pixel weighted the same."""
        d = key.references[0].inverse_depth
        return float(d.mean()) if len(d) else 1.0

    def _next_keyframe(self, levels: list[Level], image: np.ndarray, found: Alignment) -> None:
        """Make the newest image the keyframe: depths are carried over, then measured in the images before."""
        c, old = self.config, self._key
        assert old is not None
        self._retire(old)
        depth = old.depth.carried(found.T, levels[0], found.gain, found.offset)
        new = Keyframe(found.T @ old.T_cw, depth, levels, [], image)
        # The nearest views first: they narrow the search in those further off.
        past = [*old.seen[:-1]]
        before = [(old.levels[0], Alignment(np.eye(4), 1.0, 0.0, 1.0, 1.0, 0.0)), *past]
        rows = np.unique(np.linspace(0, len(before) - 1, min(c.views, len(before))).astype(int))[::-1]
        for level, alignment in (before[row] for row in rows):
            gain = alignment.gain / found.gain
            T = alignment.T @ np.linalg.inv(found.T)
            self._observe(new, level, T, gain, alignment.offset - gain * found.offset)
        new.references = new.depth.references(levels)
        self._key = new
        self._last = Alignment(np.eye(4), 1.0, 0.0, 1.0, 1.0, 0.0)
        self._counts["keyframes"] += 1

    def _retire(self, key: Keyframe) -> None:
        """Put a keyframe's best points into the map."""
        depth = key.depth
        v, u = np.nonzero(depth.valid & (depth.variance < (0.1 * depth.mean) ** 2))
        if len(v):
            rows = np.linspace(0, len(v) - 1, min(self.config.map_points, len(v))).astype(int)
            v, u = v[rows], u[rows]
            fx, fy, cx, cy = key.levels[0].intrinsics
            local = np.column_stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(u))]) / depth.mean[v, u, None]
            self._map.append(((local - key.T_cw[:3, 3]) @ key.T_cw[:3, :3], key.colors[v, u]))

    # --- the start ----------------------------------------------------------------------------------------------------

    def _initialise(self, grey: np.ndarray, levels: list[Level], image: np.ndarray, index: int) -> Estimate:
        turn = None if self._start is None else self._start.follow(grey, self._intrinsics)
        if self._start is None or turn is None:
            if self._start is not None:
                self._log.mark_lost(index)
            self._begin(grey, levels, image, index)
            return self._log.estimate(Status.LOST if self._log.is_lost(index) else Status.INITIALISING)
        self._log.turns[index] = turn
        self._pending.append((index, levels, image))
        waited = min((index - self._start.frame) / self.config.start_wait, 1)
        parallax = (1 - 0.5 * waited) * self.config.start_parallax * float(self._intrinsics[:2].mean())
        solved = self._start.solve(self._intrinsics, parallax, self._seed + index)
        if solved is not None and self._first_keyframe(*solved):
            return self._log.estimate(Status.TRACKING, 0.5)
        if self._start.worn:
            self._begin(grey, levels, image, index)
        return self._log.estimate(Status.INITIALISING)

    def _begin(self, grey: np.ndarray, levels: list[Level], image: np.ndarray, index: int) -> None:
        self._start, self._pending = TwoViewStart(grey, index), [(index, levels, image)]

    def _first_keyframe(self, T: np.ndarray, uv: np.ndarray, inverse_depth: np.ndarray) -> bool:
        """Depths of the first image from the corners and from stereo with the last; then all frames between.

        Returns:
            False, and nothing changed, if the images between do not fit.
        """
        c = self.config
        (first, levels, image), *others = self._pending
        scale = 1.0 if self._speed is None else self._speed * len(others) / max(float(np.linalg.norm(T[:3, 3])), 1e-9)
        T = T.copy()
        T[:3, 3] *= scale
        depth = DepthMap(levels[0], c.depth)
        mean, variance = spread(uv, inverse_depth / scale, levels[0].grey.shape)
        depth.begin(mean, variance)
        before = self._log.last_pose(first + 1)
        key = Keyframe(before, depth, levels, [], image)
        speed, self._last, self._motion = self._speed, Alignment(np.eye(4), 1.0, 0.0, 1.0, 1.0, 0.0), np.eye(4)
        self._observe(key, others[-1][1][0], T, 1.0, 0.0)
        key.references = depth.references(levels)
        found = []
        for index, pyramid_, _ in others:
            alignment = self._align(key, pyramid_)
            if alignment is None:
                self._speed = speed
                return False
            found.append((index, pyramid_[0], alignment))
            self._last = alignment
        self._log.set_pose(first, before)
        self._last = Alignment(np.eye(4), 1.0, 0.0, 1.0, 1.0, 0.0)
        for index, level, alignment in found:
            self._moved(index, key, alignment)
            self._measure(key, level, alignment)
        self._key, self._start, self._pending = key, None, []
        self._counts["maps_started"] += 1
        self._counts["keyframes"] += 1
        return True
