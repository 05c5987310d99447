"""The inertial baseline: MSCKF (Mourikis & Roumeliotis 2007) with first-estimate Jacobians (Li & Mourikis 2013).

Reads like this: :meth:`Msckf.track` takes the samples in, follows the corners into the new image, and hands the tracks
to the estimator (:class:`dvo.odometry.classical.msckf.estimator.Estimator`) when samples reach the time of the image.
The pose of a frame is the state of the filter, moved on by the samples that have come. Poses are in metres, z is up;
the world is where the filter started.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, replace
from typing import Any

import cv2
import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.core.settings import changed
from dvo.data.frame import Frame
from dvo.data.inertial import NOISE_PRESETS, ImuNoise, InertialSamples, checked_samples
from dvo.geometry.poses import poses_from_matrices, skew, so3_exp
from dvo.map.keyframe_log import KeyframeLog
from dvo.odometry.classical.frame_log import map_of
from dvo.odometry.classical.klt import Tracks, detect, follow
from dvo.odometry.classical.msckf.config import MsckfConfig
from dvo.odometry.classical.msckf.estimator import Estimator, State
from dvo.odometry.classical.msckf.filter import EXTRINSICS, FIXED, OFFSET
from dvo.odometry.classical.msckf.motion import Motion
from dvo.odometry.classical.msckf.start import Observed
from dvo.odometry.exclusive import sheltered
from dvo.odometry.frames.gate import Admitted, Gate
from dvo.odometry.protocol import Estimate, InertialEstimate, Result, ScaleState, Status
from dvo.odometry.segments import result_of_log

SILENCE = 1.0  # seconds from the first frame in which a sample has to come
FEWEST = 10  # tracks that an image has to go on with
UNKNOWN_SPEED = 1.0  # m/s, standard deviation of the velocity from which a map is given up
REFINED = 0.01  # relative standard deviation of the scale


@sheltered
class Msckf:
    """See the module. Deterministic for a seed; frames need inertial samples with the place of the camera."""

    name = "msckf"

    @checked_arguments
    def __init__(self, config: MsckfConfig | None = None, seed: int = 0, **settings: Any) -> None:
        self.config = changed(config or MsckfConfig(), settings)
        self.seed = seed
        self._gate = Gate(pixels=None)
        self._log = KeyframeLog()  # its keyframes are the clones of all segments
        self._calibration: tuple[np.ndarray, ImuNoise] | None = None
        self._estimator: Estimator | None = None
        self._waiting: deque[tuple[int, Observed | None]] = deque()  # frames whose samples have not all come
        self._tracks = Tracks()
        self._colors: list[np.ndarray] = []  # of the tracks, by id
        self._grey: np.ndarray | None = None  # the last image in which the tracks were seen
        self._grey_time = 0.0
        self._intrinsics, self._size = np.ones(4), (0, 0)
        self._segment, self._clones, self._starts = 0, 0, 0
        self._refined = False
        self._map: list[tuple[np.ndarray, np.ndarray]] = []
        self._last = Estimate(0.0, None, Status.INITIALISING)

    def track(self, frame: Frame) -> Estimate:
        with self._gate.admit(frame) as admitted:
            self._last = self._process(admitted)
            return self._last

    def _process(self, admitted: Admitted) -> Estimate:
        frame = admitted.frame
        samples = self._samples(frame)
        if frame.interruption:
            self._give_up(frame.interruption)
        self._intrinsics, self._size = frame.camera.intrinsics, (frame.camera.width, frame.camera.height)
        index = len(self._log.frames)
        record = self._log.add(frame.timestamp)
        record.segment = self._segment
        if self._estimator is None and self._calibration is not None:
            focal, seed = float(self._intrinsics[:2].mean()), self.seed + 1000 * self._starts
            self._estimator = Estimator(self.config, *self._calibration, focal, seed)
        if self._estimator is not None and samples is not None:
            self._estimator.add(samples)
        problem, first = admitted.problem, not self._started
        frozen = admitted.repeated and not (first or self._is_still(frame))  # the image is older than its time
        if problem or frozen:
            self._waiting.append((index, None))
        else:
            grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
            if not self._follow(grey, frame) and self._started:
                problem = "too few tracks"
            self._refill(grey, frame)
            self._waiting.append((index, self._observed(frame)))
        if problem and first:
            record.lost, record.reason = True, problem
        elif problem:
            record.inertial = True
        self._take_in()
        if first and admitted.repeated and not self._started:
            record.follow(self._log.frames[index - 1])
            return replace(self._last, timestamp=frame.timestamp)
        return self._estimate(index, problem)

    @property
    def _started(self) -> bool:
        return self._estimator is not None and self._estimator.filter is not None

    def _is_still(self, frame: Frame) -> bool:
        """Return True if the samples show no motion since the image before."""
        return self._estimator is not None and self._estimator.is_still(self._last.timestamp, frame.timestamp)

    def finish(self) -> Result:
        if self._gate.finish():
            self._take_in(everything=True)
            self._settle()
            for record in self._log.frames:
                record.lost = record.lost or record.anchor is None
        info: dict[str, Any] = {
            "working_size": list(self._size),
            "working_intrinsics": self._intrinsics.tolist(),
            "maps_started": self._starts,
            "config": asdict(self.config),
        }
        info["inertial"] = self._facts()
        result, _ = result_of_log(self._log, info)
        if result.segments:
            sigma = self._last.inertial.scale_sigma if self._last.inertial else None
            entries = [
                {"segment": number, "source": "inertial", "deviation": sigma} for number in range(len(result.segments))
            ]
            info["scale"] = {"source": "inertial", "unit": "metres", "segments": entries}
        return replace(result, map=map_of(self._map))

    def _facts(self) -> dict[str, Any]:
        """What the filter knows of scale and sensors at the end."""
        e, last = self._estimator, self._last
        facts: dict[str, Any] = {"state": last.scale_state.value}
        if e is None or e.filter is None or last.inertial is None:
            return facts | ({"reason": e.reason} if e is not None and e.reason else {})
        sigma = float(np.sqrt(e.filter.P[OFFSET, OFFSET]))
        return facts | {
            "scale_sigma": last.inertial.scale_sigma, "time_offset": e.filter.offset, "time_offset_sigma": sigma,
            "gyro_bias": e.filter.bias[:3].tolist(), "accel_bias": e.filter.bias[3:].tolist(),
            "points_used": e.updates, "points_rejected": e.rejected, "rests": e.rests,
        }  # fmt: skip

    # --- samples ------------------------------------------------------------------------------------------------------

    def _samples(self, frame: Frame) -> InertialSamples | None:
        """Samples of a frame; a source without any is refused."""
        samples, frames = frame.inertial, self._log.frames
        if samples is not None:
            checked_samples(samples)
        awaited = bool(frames) and self._calibration is None
        silent = awaited and frame.timestamp - frames[0].timestamp > SILENCE
        if (awaited and samples is None) or (silent and len(samples or ()) == 0):
            raise DvoError(
                "there are no inertial samples, which msckf needs",
                field=f"frame {frame.index}",
                remedy="give a source that has them, such as an EuRoC folder or a bag, or use another system",
            )
        if samples is None or len(samples) == 0:
            return None
        if samples.T_camera_imu is None:
            raise DvoError(
                "the pose of the inertial sensor in the camera is not known, which msckf needs",
                field=f"frame {frame.index}",
                remedy="give the calibration of camera and inertial sensor",
            )
        if self._calibration is None:
            self._calibration = samples.T_camera_imu, samples.noise or NOISE_PRESETS["phone"]
        return samples

    # --- tracks -------------------------------------------------------------------------------------------------------

    def _follow(self, grey: np.ndarray, frame: Frame) -> bool:
        """Carry the tracks into the new image, from where the gyroscope expects them; True if enough hold."""
        c, tracks = self.config, self._tracks
        if self._grey is None or len(tracks) == 0:
            self._grey, self._grey_time = grey, frame.timestamp
            return False
        guess = self._turned(tracks.uv, frame.timestamp)
        uv, held = follow(
            self._grey, grey, tracks.uv, window=c.window, levels=c.levels, tolerance=c.closed, guess=guess
        )
        tracks.keep(held)
        tracks.last_uv, tracks.uv = tracks.uv, uv[held]
        self._grey, self._grey_time = grey, frame.timestamp
        if held.sum() < FEWEST:
            tracks.keep(np.zeros(len(tracks), bool))
        return len(tracks) > 0

    def _turned(self, uv: np.ndarray, time: float) -> np.ndarray | None:
        """Pixels ``(N, 2)`` after the rotation of the gyroscope since the last image."""
        e = self._estimator
        if e is None or e.samples.end < time - 0.05 or e.samples.start > self._grey_time:
            return None
        bias = np.zeros(3) if e.filter is None else e.filter.bias[:3]
        stretch = e.samples.between(self._grey_time + e.offset, time + e.offset)
        turn = np.eye(3)
        for gyro, dt in zip(0.5 * (stretch.gyro[1:] + stretch.gyro[:-1]), np.diff(stretch.times), strict=True):
            turn = turn @ so3_exp((gyro - bias) * dt)
        R_bc = e.device.R_bc if e.filter is None else e.filter.R_bc
        rays = np.column_stack([(uv - self._intrinsics[2:]) / self._intrinsics[:2], np.ones(len(uv))])
        rays = rays @ (R_bc.T @ turn @ R_bc)
        if (rays[:, 2] < 0.1).any():
            return None
        guess = rays[:, :2] / rays[:, 2:] * self._intrinsics[:2] + self._intrinsics[2:]
        return np.ascontiguousarray(np.clip(guess, 0, np.array(self._size) - 1), np.float32)

    def _refill(self, grey: np.ndarray, frame: Frame) -> None:
        c, tracks = self.config, self._tracks
        if len(tracks) < c.refill * c.corners:
            spacing = 0.5 * float(np.sqrt(grey.size / c.corners))
            corners = detect(grey, tracks.uv, c.corners - len(tracks), quality=c.quality, spacing=spacing)
            before = len(tracks)
            tracks.add(corners, len(self._log.frames) - 1, frame.image)
            self._colors.extend(tracks.colors[before:])

    def _observed(self, frame: Frame) -> Observed:
        """The tracks in this image."""
        tracks, focal = self._tracks, self._intrinsics[:2]
        delay = ((tracks.uv[:, 1] + 0.5) / self._size[1] - 0.5) * frame.camera.readout
        xy = (tracks.uv.astype(np.float64) - self._intrinsics[2:]) / focal
        return Observed(frame.timestamp, tracks.ids.copy(), xy, delay.astype(np.float64))

    # --- states -------------------------------------------------------------------------------------------------------

    def _take_in(self, *, everything: bool = False) -> None:
        """Give the estimator the frames whose samples have come, or all."""
        e = self._estimator
        while e is not None and self._waiting:
            index, seen = self._waiting[0]
            record = self._log.frames[index]
            if not everything and not e.is_ready(record.timestamp):
                break
            self._waiting.popleft()
            before = e.filter is None
            number = e.step(seen) if seen is not None else e.advance(record.timestamp)
            if number is None:
                continue
            assert e.filter is not None
            if before:
                self._begin(e)
            self._move_clones(e)
            if not record.lost:
                self._log.place(index, self._clones + number, self._T_cw(e.filter.motion, e))
            self._collect(e)
            if not everything and (not e.filter.is_sound() or speed_sigma(e.filter.P) > UNKNOWN_SPEED):
                self._give_up("the filter has diverged")
                break

    def _begin(self, e: Estimator) -> None:
        """Frames before the start, by the states that it brings."""
        assert e.start is not None
        self._starts += 1
        self._move_clones(e)
        for index, record in enumerate(self._log.frames):
            if record.segment == self._segment and record.anchor is None and not record.lost:
                motion = e.earlier(record.timestamp)
                if motion is not None:
                    self._log.place(index, self._clones, self._T_cw(motion, e))

    def _move_clones(self, e: Estimator) -> None:
        """Write the poses of the clones into the log."""
        assert e.filter is not None
        for clone in e.filter.clones:
            self._log.set_pose(self._clones + clone.number, self._T_cw(clone.motion, e))

    def _T_cw(self, motion: Motion, e: Estimator) -> np.ndarray:
        """World to camera ``(4, 4)`` of a state of the body."""
        assert e.filter is not None
        T_wc = np.eye(4)
        T_wc[:3, :3] = motion.R @ e.filter.R_bc
        T_wc[:3, 3] = motion.p + motion.R @ e.filter.p_bc
        return np.linalg.inv(T_wc)

    def _collect(self, e: Estimator) -> None:
        """Points of the last update into the map."""
        if len(e.points):
            colors = np.array([self._colors[track] for track in e.point_ids], np.uint8)
            self._map.append((e.points.astype(np.float32), colors))
            e.points, e.point_ids = np.zeros((0, 3)), np.zeros(0, np.int64)

    def _settle(self) -> None:
        if self._started:
            assert self._estimator is not None
            self._move_clones(self._estimator)

    def _give_up(self, reason: str) -> None:
        """End the segment; the next frames start anew."""
        self._settle()
        for record in self._log.frames:
            if record.segment == self._segment and record.anchor is None:
                record.lost, record.reason = True, record.reason or reason
        if self._started:
            self._clones = max(self._log.poses, default=-1) + 1
            self._segment += 1
        self._estimator, self._refined = None, False
        self._waiting.clear()
        self._tracks.keep(np.zeros(len(self._tracks), bool))
        self._grey = None

    # --- estimates ----------------------------------------------------------------------------------------------------

    def _estimate(self, index: int, problem: str) -> Estimate:
        time = self._log.frames[index].timestamp
        if not self._started:
            status = Status.LOST if problem else Status.INITIALISING
            reason = problem or ("" if self._estimator is None else self._estimator.reason)
            scale = ScaleState.NONE if self._estimator is None else ScaleState.INITIALISING
            return Estimate(time, None, status, segment=self._segment, reason=reason, scale_state=scale)
        e = self._estimator
        assert e is not None and e.filter is not None
        state = e.predict(time)
        sigma = scale_sigma(state)
        self._refined = self._refined or sigma < REFINED
        T_wc = np.linalg.inv(self._T_cw(state.motion, e))
        R_bc, p_bc = e.filter.R_bc, e.filter.p_bc
        inertial = InertialEstimate(
            state.motion.v,
            state.bias[:3],
            state.bias[3:],
            sigma,
            world_covariance(state, R_bc, p_bc),
            e.filter.offset,
        )
        reference = -1 if problem else 0  # by samples alone, the newest clone is the last image that told the pose
        return Estimate(
            time,
            poses_from_matrices(T_wc),
            Status.INERTIAL if problem else Status.TRACKING,
            0.0 if problem else e.agreement,
            self._segment,
            problem,
            covariance=relative_covariance(state, reference, R_bc, p_bc),
            reference=state.clones[reference].time,
            scale_state=ScaleState.REFINED if self._refined else ScaleState.ALIGNED,
            inertial=inertial,
        )


def speed_sigma(P: np.ndarray) -> float:
    """Standard deviation of the velocity, m/s: root of the largest variance."""
    return float(np.sqrt(np.diag(P)[6:9].max()))


def scale_sigma(state: State) -> float:
    """Relative standard deviation of the distance to the farthest clone of the window; 1 where that is not known."""
    away = np.array([state.motion.p - clone.motion.p for clone in state.clones]).reshape(-1, 3)
    if not len(away):
        return 1.0
    far = int(np.argmax(np.linalg.norm(away, axis=1)))
    length = float(np.linalg.norm(away[far]))
    if length < 1e-3:
        return 1.0
    H = np.zeros(len(state.P))
    H[:3], H[FIXED + 6 * far : FIXED + 6 * far + 3] = away[far] / length, -away[far] / length
    return float(min(np.sqrt(max(H @ state.P @ H, 0.0)) / length, 1.0))


def world_covariance(state: State, R_bc: np.ndarray, p_bc: np.ndarray) -> np.ndarray:
    """Covariance ``(9, 9)`` of position and orientation of the camera, and velocity of the sensor.

    Args:
        state: of the body.
        R_bc, p_bc: camera in the body.
    """
    R = state.motion.R
    J = np.zeros((9, len(state.P)))
    J[:3, :3], J[:3, 3:6], J[:3, EXTRINSICS : EXTRINSICS + 3] = np.eye(3), -R @ skew(p_bc), R
    J[3:6, 3:6], J[3:6, EXTRINSICS + 3 : FIXED] = R_bc.T, np.eye(3)
    J[6:, 6:9] = np.eye(3)
    return J @ state.P @ J.T


def relative_covariance(state: State, clone: int, R_bc: np.ndarray, p_bc: np.ndarray) -> np.ndarray:
    """Covariance ``(6, 6)`` of the camera relative to that of a clone, as of :class:`Estimate`.

    Args:
        state: of the body.
        clone: position of the reference in its clones.
        R_bc, p_bc: camera in the body.
    """
    reference, at = state.clones[clone].motion, FIXED + 6 * (clone % len(state.clones))
    between = reference.R.T @ state.motion.R  # body to that of the reference
    apart = reference.R.T @ (state.motion.p - reference.p)
    body = np.zeros((6, len(state.P)))  # right tangent of the body relative to that of the reference
    body[:3, :3], body[3:, 3:6] = state.motion.R.T, np.eye(3)
    body[:3, at : at + 3] = -state.motion.R.T
    body[:3, at + 3 : at + 6] = between.T @ skew(apart)
    body[3:, at + 3 : at + 6] = -between.T
    J = np.zeros((6, 6))  # to the camera
    J[:3, :3], J[3:, 3:], J[:3, 3:] = R_bc.T, R_bc.T, -R_bc.T @ skew(p_bc)
    return J @ body @ state.P @ body.T @ J.T
