"""From tracks and inertial samples to states: start, propagation, clones, updates. No images."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import pose_matrices
from dvo.odometry.classical.msckf.config import MsckfConfig
from dvo.odometry.classical.msckf.features import (
    Views,
    chi_square_bound,
    compressed,
    linearise,
    passing,
    triangulate,
)
from dvo.odometry.classical.msckf.filter import FIXED, Clone, Filter
from dvo.odometry.classical.msckf.motion import Motion, SampleBuffer, propagate, rotation_vector
from dvo.odometry.classical.msckf.start import (
    Device,
    Observed,
    Start,
    start_from_motion,
    start_from_rest,
)

LATE = 0.002  # seconds that the last sample may be before an image
TURN_CHANGE, FORCE_CHANGE = 5.0, 20.0  # rad/s^2 and m/s^3: how fast rate and force change after the last sample
STILL_FLOW, STILL_MEAN = 2.0, 0.3  # median and mean displacement of tracks that stand still, over the noise of a pixel
STILL_TURN, STILL_FORCE = 0.005, 0.06  # rad/s and m/s^2, standard deviations of the samples beside their noise
REST = np.repeat([0.003, 0.001, 0.01], 3)  # m, rad, m/s: what may have moved while standing still
TRY_EVERY = 0.5  # seconds between two tries to start from motion
KEPT = 4.0  # seconds of images and samples before the start


@dataclass(frozen=True)
class State:
    """State of the body at some time.

    Attributes:
        motion: of the body.
        bias: ``(6,)``.
        P: ``(22 + 6 N, 22 + 6 N)`` covariance of the error, see :class:`Filter`.
        clones: N poses of the window.
    """

    motion: Motion
    bias: np.ndarray
    P: np.ndarray
    clones: tuple[Clone, ...]


class Estimator:
    """See the module. Images are given with :meth:`step` when :meth:`is_ready` says that their samples have come.

    Attributes:
        filter: None before the start.
        samples: buffer.
        reason: what the start waits for.
        start: the start, None before.
        updates, rejected, rests: points that were used, points that the gate refused, updates while standing still.
        agreement: part of the points of the last update that the gate let through.
        points, point_ids: ``(M, 3)`` in the world and ``(M,)`` tracks of the last update; to be taken by the caller.
    """

    def __init__(
        self, config: MsckfConfig, T_camera_imu: np.ndarray, noise: ImuNoise, focal: float, seed: int = 0
    ) -> None:
        T_cb = pose_matrices(T_camera_imu)
        R_bc = T_cb[:3, :3].T
        gate = config.pixel / focal
        self.config, self.focal, self.seed = config, focal, seed
        self.device = Device(
            R_bc, -R_bc @ T_cb[:3, 3], noise, gate, config.drift * gate,
            config.offset_sigma, config.position_sigma, config.rotation_sigma,
        )  # fmt: skip
        self.samples = SampleBuffer()
        self.filter: Filter | None = None
        self.start: Start | None = None
        self.reason = "waiting for inertial samples"
        self.updates, self.rejected, self.rests, self.agreement = 0, 0, 0, 0.5
        self.points, self.point_ids = np.zeros((0, 3)), np.zeros(0, np.int64)
        self._early: list[Observed] = []
        self._last: Observed | None = None  # of the last clone
        self._seen: dict[int, list[tuple[int, float, float, float]]] = defaultdict(list)  # clone number, x, y, delay
        self._tries, self._tried = 0, -np.inf

    def add(self, samples: InertialSamples) -> None:
        """Take samples in."""
        self.samples.add(samples)
        self.samples.forget(self.samples.end - KEPT - 1 if self.filter is None else self.filter.time - 0.1)

    @property
    def offset(self) -> float:
        """Seconds that are added to the time of an image for that of the samples."""
        return 0.0 if self.filter is None else self.filter.offset

    def is_ready(self, time: float) -> bool:
        """Return True if the samples reach the time of an image."""
        return self.samples.end + LATE >= time + self.offset

    def step(self, seen: Observed) -> int | None:
        """Take the tracks of the next image in.

        Returns:
            Number of the clone that carries the image: a new one for this image, or the newest; None before the start.
        """
        if self.filter is None:
            self._try_start(seen)
            return None if self.filter is None else self._clone(seen)
        self._propagate(seen.time)
        if self._is_due(seen):
            if self._last is not None and self._stands(self._last, seen):
                self._rest()
            else:
                return self._clone(seen)
        return self.filter.clones[-1].number if self.filter.clones else None

    def advance(self, time: float) -> int | None:
        """Move on to an image that shows nothing.

        Returns:
            As :meth:`step`.
        """
        if self.filter is None:
            return None
        self._propagate(time)
        return self.filter.clones[-1].number

    def earlier(self, time: float) -> Motion | None:
        """State at the time of an image before the start; None before what the start knows."""
        assert self.start is not None
        at = time + self.start.offset
        if self.start.rested and self.start.history[0][0] - self.config.interval <= at:  # the first has no samples
            return self.start.motion
        before = [entry for entry in self.start.history if entry[0] <= at + 1e-9]
        if not before:
            return None
        known, motion = before[-1]
        stretch = self.samples.between(known, max(at, known))
        return propagate(stretch, motion, self.start.bias, self.device.noise)[0]

    # --- the start ----------------------------------------------------------------------------------------------------

    def _try_start(self, seen: Observed) -> None:
        c = self.config
        if self._early and seen.time - self._early[-1].time < 0.999 * c.interval:
            return
        if seen.time < self.samples.start:
            return
        self._early = [frame for frame in self._early if frame.time > seen.time - KEPT + 0.5]
        self._early.append(seen)
        rest = 0
        while rest + 1 < len(self._early) and self._stands(self._early[-2 - rest], self._early[-1 - rest]):
            rest += 1
        begin = self._early[-1 - rest].time
        found: Start | str
        if rest and seen.time - begin >= c.still:
            found = start_from_rest(self.samples.between(begin, seen.time), self.device)
        elif rest:
            found = "standing still"
        else:
            moving = [frame for frame in self._early if frame.time > seen.time - c.moving - 0.5 * c.interval]
            if moving[-1].time - moving[0].time < c.moving - c.interval:
                found = "waiting for more images"
            elif seen.time - self._tried < TRY_EVERY:
                return
            else:
                self._tries, self._tried = self._tries + 1, seen.time
                found = start_from_motion(
                    moving, self.samples, self.device, most=c.start_scale, seed=self.seed + self._tries
                )
        if isinstance(found, str):
            self.reason = found
            return
        self.start, self.reason, self._early = found, "", []
        self.filter = Filter(
            found.time, found.motion, found.bias, found.offset, self.device.R_bc, self.device.p_bc, found.P,
            self.device.noise,
        )  # fmt: skip

    def _flow(self, first: Observed, second: Observed) -> np.ndarray:
        """Displacements ``(M, 2)`` of common tracks, pixels."""
        _, one, two = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
        return (second.xy[two] - first.xy[one]) * self.focal

    def _stands(self, first: Observed, second: Observed) -> bool:
        """Return True if neither the images nor the samples show motion between two images."""
        flow, pixel = self._flow(first, second), self.config.pixel
        if len(flow) < 10:
            return False
        return bool(
            np.median(np.linalg.norm(flow, axis=1)) < STILL_FLOW * pixel
            and np.linalg.norm(np.median(flow, axis=0)) < (STILL_MEAN + 4 / np.sqrt(len(flow))) * pixel
            and self.is_still(first.time, second.time)
        )

    def is_still(self, start: float, end: float) -> bool:
        """Return True if the samples show no motion between the times of two images."""
        stretch, noise = self.samples.between(start + self.offset, end + self.offset), self.device.noise
        count = len(stretch.times) - 2
        if count < 2:
            return False
        rate = count / max(end - start, 1e-3)
        turn, push = stretch.gyro[1:-1].std(0).max(), stretch.accel[1:-1].std(0).max()
        return bool(
            turn < 2 * noise.gyro * np.sqrt(rate) + STILL_TURN and push < 2 * noise.accel * np.sqrt(rate) + STILL_FORCE
        )

    # --- the filter ---------------------------------------------------------------------------------------------------

    def _propagate(self, time: float) -> None:
        assert self.filter is not None
        target = time + self.filter.offset
        if target > self.filter.time:
            self.filter.propagate(self.samples.between(self.filter.time, target))

    def _is_due(self, seen: Observed) -> bool:
        if self._last is None or seen.time - self._last.time >= 0.999 * self.config.interval:
            return True
        flow = self._flow(self._last, seen)
        if len(flow) < max(0.7 * len(self._last.ids), 1):
            return True
        return bool(np.median(np.linalg.norm(flow, axis=1)) > self.config.flow * self.focal)

    def _rest(self) -> None:
        """Standing still: no velocity, and the pose of the newest clone."""
        assert self.filter is not None
        f, at = self.filter, FIXED + 6 * (len(self.filter.clones) - 1)
        clone = f.clones[-1].motion
        H = np.zeros((9, len(f.P)))
        H[:3, :3], H[3:6, 3:6], H[6:, 6:9] = np.eye(3), np.eye(3), np.eye(3)
        H[:3, at : at + 3], H[3:6, at + 3 : at + 6] = -np.eye(3), -np.eye(3)
        turn = rotation_vector(clone.R.T @ f.motion.R)
        r = np.concatenate([clone.p - f.motion.p, -turn, -f.motion.v])
        S = H @ f.P @ H.T + np.diag(REST**2)
        if r @ np.linalg.solve(S, r) < chi_square_bound(9, 3.0):
            f.update(r, H, REST)
            self.rests += 1

    def _clone(self, seen: Observed) -> int:
        f, c = self.filter, self.config
        assert f is not None
        number = f.clone(seen.time, self.samples.rate(f.time)).number
        self._last = seen
        for track, (x, y), delay in zip(seen.ids.tolist(), seen.xy.tolist(), seen.delay.tolist(), strict=True):
            self._seen[track].append((number, x, y, delay))
        full = len(f.clones) >= c.clones
        oldest = f.clones[0].number
        alive = set(seen.ids.tolist())
        chosen = []
        for track, views in self._seen.items():
            # Long tracks end at different lengths, so that each image brings about as many measurements.
            longest = c.clones - (track * 7) % max(c.clones // 2, 1)
            if track not in alive or len(views) >= longest or (full and views[0][0] == oldest):
                chosen.append(track)
        self._update(chosen)
        for track in chosen:  # one that lives on begins anew with the next image
            del self._seen[track]
        if full:
            f.forget([0])
        return number

    def _update(self, tracks: list[int]) -> None:
        f, c = self.filter, self.config
        assert f is not None
        row = {clone.number: k for k, clone in enumerate(f.clones)}
        used = [track for track in sorted(tracks) if len(self._seen[track]) >= c.views]
        if not used:
            return
        flat = [(k, *view) for k, track in enumerate(used) for view in self._seen[track]]
        table = np.array(flat)
        views = Views(table[:, 0].astype(int), np.array([row[int(n)] for n in table[:, 1]]), table[:, 2:4], table[:, 4])
        now, first = f.poses(), f.poses(first=True)
        R, p, _ = now.shifted(views.clone, views.delay)
        points, good = triangulate(views, R @ f.R_bc, p + R @ f.p_bc)
        measured = linearise(views, points, now, first, f.R_bc, f.p_bc, f.layout)
        kept = good & passing(measured, f.P, self.device.gate)
        self.updates, self.rejected = self.updates + int(kept.sum()), self.rejected + int((good & ~kept).sum())
        self.agreement = float(kept.sum() / max(good.sum(), 1))
        self.points, self.point_ids = points[kept], np.array(used, np.int64)[kept]
        if kept.any():
            f.update(*compressed(measured, kept), self.device.sigma)

    # --- what others read ---------------------------------------------------------------------------------------------

    def predict(self, time: float) -> State:
        """State at the time of an image, by the samples that have come, beyond them by the last one."""
        f = self.filter
        assert f is not None
        target = time + f.offset
        if target <= f.time:
            return State(f.motion, f.bias, f.P, tuple(f.clones))
        motion, P = f.predicted(self.samples.between(f.time, target))
        beyond = target - max(self.samples.end, f.time)
        if beyond > LATE:
            turn, push = 0.5 * TURN_CHANGE * beyond**2, 0.5 * FORCE_CHANGE * beyond**2
            P[np.arange(9), np.arange(9)] += np.repeat([push * beyond / 3, turn, push], 3) ** 2
        return State(motion, f.bias, P, tuple(f.clones))
