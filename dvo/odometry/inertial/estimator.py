"""Alignment of a visual trajectory with inertial samples while it grows, and prediction of poses without images.

Until scale and vertical are known for sure nothing is said of them: a wrong alignment is worse than none. Each test
that fails is a reason that is told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from dvo.data.inertial import NOISE_PRESETS, ImuNoise, InertialSamples
from dvo.geometry.poses import rotation_vector, skew, so3_exp, split
from dvo.odometry.inertial.options import InertialOptions
from dvo.odometry.inertial.preintegration import integrated_turn, preintegrate, propagate
from dvo.odometry.inertial.smoother import (
    GRAVITY,
    HASTE,
    NODE,
    OPPOSED,
    SHIFT,
    STATE,
    Past,
    Similarities,
    Smoothed,
    Smoother,
    SmootherOptions,
    Values,
    VisualNodes,
    acceleration_sign,
    first_values,
    linear_start,
    motion_factors,
    smooth,
    upright,
)
from dvo.odometry.inertial.stream import SampleStream
from dvo.odometry.inertial.temporal import ImuAlignment, align_imu
from dvo.odometry.protocol import ScaleState

Array = np.ndarray
EVERY, BETWEEN, AT_FIRST = 1.0, 0.2, 0.5
"""Seconds from one estimate of the whole window to the next; of those that go on from it; and before the alignment."""
STARTS = (1.0, 0.4, 2.5)
"""Factors of the scale of the linear solution that the first estimate begins with."""
REFINED_AFTER = 15.0
"""Seconds after the alignment at which scale and vertical are called refined (Campos et al., 2021, III-D)."""
ROUNDS, FINAL_ITERATIONS = 3, 25
"""Estimates at the end of a recording, and Gauss-Newton steps of each."""
MAX_GRAVITY_SIGMA = 1.5
"""Standard deviation of the vertical that an alignment needs, degrees."""
LOST_SCALE = 0.2
"""Relative deviation of the scale above which an alignment is withdrawn, if it lasts for as long as samples alone may
predict poses; up to it, the adjustment of images and samples may make sure of that of a world that is not aligned."""
UNSURE_SCALE, SURE_SCALE = 0.06, 0.04
"""Relative deviation of the scale above which a world in metres is not called aligned, and down to which it is."""
NOTHING_TOLD = 0.5
"""Relative deviation of the scale above which the motion tells nothing of it."""
MAX_ERROR = 6.0
"""Mean squared whitened residual above which samples and images do not fit."""
GRAVITY_RANGE = (6.0, 16.0)
"""Median specific force of a camera that is moved by hand, by a vehicle or in flight, m/s^2."""
MAX_TURN, MOST_TURNS, LAST_TURNS = 1.5, 0.9, 1.0
"""Difference of rotations between nodes above which gyroscope and images disagree, degrees at a calm rate: root mean
square of most of them, by share, as images fail now and then; and median of the last seconds."""
FOUND_EXTRINSIC = 0.02
"""Deviation of a rotation between sensor and camera that was found from the motion, rad."""
NOISE_RANGE = (0.3, 30.0)
"""Factors of the noise of visual poses."""
MAX_FORCE_SIGMA = 0.025
"""Deviation of the acceleration, m/s^2, by bias and vertical together, above which samples hold a velocity no better
than images do, and are no measurement for the window."""
MAX_ADJUSTED_FORCE_SIGMA = 0.1
"""The same, where the adjustment of images and samples brings window and map back to their unit every few seconds."""
MAX_ROTATION_FACTOR = 8.0
"""Factor of the noise of visual orientations above which samples and images do not fit."""
MAX_SHIFT = 0.02
"""Change of the time offset since the alignment above which the clocks drift, seconds."""
CLOCK_EVERY, CLOCK_SPAN, MAX_DRIFT = 4.0, 6.0, 1e-3
"""Seconds between looks at the clock of the samples; of a segment that tells its drift; and drift, seconds a second,
beyond three of its deviations, with which samples are no use."""
MAX_BIASES = (0.15, 1.0)
"""Biases that no working sensor has, rad/s and m/s^2."""
AGREEMENT = 0.03
"""Difference of the scales of two estimates in a row that agree, relative, beyond three of their deviations."""
FAILING = 2.0
"""Seconds for which all estimates fail the tests, after which an alignment is withdrawn."""
MOST_PATIENCE = 2.0
"""Seconds from one estimate to the next where all that is known speaks against one."""
CLOSER = 0.5
"""Share of the deviation of the scale that an alignment needs, where the adjustment of images and samples tells it: the
noise of the images is assumed there, and errors of the camera's calibration are not in it."""
ADJUSTED_SIGMA = 0.75
"""The same share while the recording goes on, of each of two adjustments in a row."""
PATIENT = 1.5
"""Seconds after the first estimate that is unsure of the scale, before the adjustment is asked: with a good sensor the
next ones are sure."""
_WAITING = ("too few poses", "too few samples")
_UNCERTAIN = "the scale is uncertain"
SURE_OFFSET, SURE_TURN = 3e-3, 0.5
"""Deviation of the time offset, seconds, and of rotations over a third of a second, degrees, of a gyroscope that tells
the rotation within a readout."""
HELD = 0.05
"""Seconds for which the newest sample is held."""
LEAD = 0.03
"""Seconds of samples beyond the nodes, by which a time offset that is not known yet may change."""
LONGEST_GAP = 0.02
"""Between samples that tell a rotation within a readout, seconds."""
SILENT = 1.0
"""Seconds without samples after which a scale is in doubt: the unit of the images drifts unseen."""
STILL = (0.02, 0.15)
"""Standard deviations of rates (rad/s) and forces (m/s^2) over :data:`STILL_FOR` of a sensor that stands still."""
STILL_FOR = 0.4
STILL_SPEED = 0.05
"""Predicted speed, beyond three of its deviations, below which a sensor that feels nothing stands still, m/s."""


@dataclass(frozen=True)
class Similarity:
    """Similarity from the world of visual poses to the metric one: ``x = scale rotation x_visual + translation``.

    Attributes:
        scale: metres in a unit.
        rotation: ``(3, 3)``.
        translation: ``(3,)`` metres.
    """

    scale: float
    rotation: Array
    translation: Array

    def points(self, points: Array) -> Array:
        """``(..., 3)`` points in metres."""
        return self.scale * points @ self.rotation.T + self.translation

    def inverse_points(self, points: Array) -> Array:
        """``(..., 3)`` points in the units of the visual poses."""
        return (points - self.translation) @ self.rotation / self.scale

    def before(self, change: Similarity) -> Similarity:
        """The same place in the metric world, of poses that a similarity of the visual world has changed."""
        scale, rotation = self.scale / change.scale, self.rotation @ change.rotation.T
        return Similarity(scale, rotation, self.translation - scale * rotation @ change.translation)


@dataclass(frozen=True)
class BodyState:
    """State of the sensor at one time.

    Attributes:
        time: seconds, clock of the camera.
        rotation: ``(3, 3)`` body to world.
        position, velocity: ``(3,)`` metres and m/s.
        gyro_bias, accel_bias: ``(3,)``.
        covariance: ``(15, 15)`` of rotation, position, velocity and biases; with rows of further unknowns after
            these, which do not change with time.
    """

    time: float
    rotation: Array
    position: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array

    @property
    def speed(self) -> float:
        """Metres a second."""
        return float(np.linalg.norm(self.velocity))


class _DisagreementError(Exception):
    """Gyroscope and images do not belong together."""


class InertialEstimator:
    """Scale, vertical, velocity and biases of one recording.

    Args:
        options: settings.

    Attributes:
        state: what is known.
        reason: why there is no alignment (yet), why one was withdrawn or is in doubt; empty otherwise.
        worlds: similarity by the number of the world of visual poses, of those that are aligned.
        untold: worlds whose scale the samples do not tell at the end: they are short, or do not change their speed.
        stream: samples.
        solution: newest estimate that passed the tests; None before it.
        history: what has happened, for run.json.
    """

    def __init__(self, options: InertialOptions) -> None:
        self.options = options
        self.stream = SampleStream()
        self.state, self.reason = ScaleState.NONE, ""
        self.worlds: dict[int, Similarity] = {}
        self.untold: set[int] = set()
        self.solution: Smoothed | None = None
        self.history: list[dict[str, Any]] = []
        self.noise: ImuNoise = NOISE_PRESETS["phone"]
        self.rotation_camera_imu: Array | None = None
        self.translation_camera_imu: Array = np.zeros(3)
        self.first_offset = 0.0  # time offset that the first estimate begins with, seconds
        self._candidate: tuple[float, float] | None = None  # log scale and its deviation, of an estimate that passed
        self._adjusted: tuple[float, float] | None = None  # the same of an adjustment of images and samples
        self._unsure: tuple[Smoothed, VisualNodes, int] | None = None  # estimate whose scale is not sure, and its world
        self._unsure_since = np.inf  # time of the first of them, since the start or a withdrawal
        self._doubtful, self._known_at = False, -np.inf  # the scale is not known for now; when it was, roughly
        self._silent = False  # samples are missing
        self._failing, self._patience = np.inf, AT_FIRST  # since the first of the last estimates, which all fail
        self._next = self._whole = -np.inf  # times of the next estimate, and of the last one of the whole window
        self._aligned, self._offset = np.nan, 0.0  # time of the alignment, and time offset then
        self._past: list[BodyState] = []  # states that were newest
        self._held = np.nan  # time of the node whose heading and position are held
        self._drift, self._watched = "", -np.inf  # what is told of a clock that drifts; time of the last look at it
        self._smoother = SmootherOptions()
        self._known: list[int] = []  # worlds of the solution, in its order

    @property
    def aligned(self) -> bool:
        """True if poses are in metres, also where the scale is not known for now."""
        return self.state in (ScaleState.ALIGNED, ScaleState.REFINED)

    @property
    def scale_state(self) -> ScaleState:
        """What is known of the present scale."""
        in_doubt = self._doubtful or self._silent or self._failing < np.inf
        return ScaleState.INITIALISING if self.aligned and in_doubt else self.state

    @property
    def _most_sigma(self) -> float:
        """Relative deviation of the scale up to which a new segment joins a metric trajectory."""
        return 2 * self.options.max_scale_sigma

    @property
    def holds_unit(self) -> bool:
        """True if samples alone hold the unit of the window."""
        return self.aligned and self.force_sigma <= MAX_FORCE_SIGMA

    @property
    def leads(self) -> bool:
        """True if samples tell the acceleration well enough to be a measurement for the window."""
        most = MAX_FORCE_SIGMA if self._adjusted is None else MAX_ADJUSTED_FORCE_SIGMA
        return self.aligned and self.force_sigma <= most

    @property
    def scale_sigma(self) -> float:
        """Relative deviation of the scale; inf without an estimate."""
        return np.inf if self.solution is None else self.solution.scale_sigma

    @property
    def force_sigma(self) -> float:
        """Deviation of the acceleration that samples tell, m/s^2; inf without an estimate."""
        s = self.solution
        return np.inf if s is None else float(np.sqrt(s.force_variance.mean()))

    def add(self, samples: InertialSamples) -> None:
        """Take samples; the first with an extrinsic calibration and noise decide these.

        Args:
            samples: of the sensor, see :class:`dvo.data.inertial.InertialSamples`.

        Raises:
            DvoError: samples out of order or not finite.
        """
        self.stream.add(samples)
        if not len(samples):
            return
        if self.state is ScaleState.NONE and not self.reason:
            self.state, self.reason = ScaleState.INITIALISING, "too few poses"
        if samples.noise is not None:
            self.noise = samples.noise
        if samples.T_camera_imu is not None and self.rotation_camera_imu is None:
            rotation, translation = split(np.asarray(samples.T_camera_imu, float))
            self.rotation_camera_imu, self.translation_camera_imu = rotation, translation

    def refresh(
        self, time: float, nodes: Callable[[float], tuple[VisualNodes, list[int]]], *, moved: bool = True
    ) -> None:
        """Make the next estimate if it is due: of the whole window, or one that goes on from it.

        Args:
            time: of the newest frame, seconds.
            nodes: gives the visual poses from a time on, and the world of each of their segments.
            moved: by more than a little; once it is aligned, a frame that has not needs no estimate.
        """
        self._listen(time)
        if self.state is ScaleState.NONE or time < self._next:
            return
        past = self.solution.past if self.solution is not None and self.aligned else None
        if past is not None and not moved:
            return
        if past is None or time > self._whole + EVERY - 1e-6 or not self._go_on(past, *nodes(past.time)):
            self.update(*nodes(time - self.options.window))

    def update(self, nodes: VisualNodes, worlds: list[int]) -> None:
        """Make an estimate of the whole window, and take it if it passes the tests.

        Args:
            nodes: visual poses of the last seconds.
            worlds: number of the world of each segment of the nodes.
        """
        if not len(nodes):
            return
        self._unsure = None
        time = self._whole = float(nodes.times[-1])
        self._listen(time)
        self._next = time + (EVERY if self.aligned else AT_FIRST)
        if self.solution is not None:  # the window begins with a node that is known
            known = np.isin(np.round(nodes.times, 6), np.round(self.solution.times, 6))
            nodes, worlds = _chosen(nodes, worlds, np.arange(len(nodes)) >= int(known.argmax()))
        self._watch_clock(nodes, time)
        problem, worlds, doubt = self._problem(nodes, worlds)
        if problem is None:
            self._refuse(doubt, time)
            return
        try:
            found = self._solved(problem, worlds)
        except _DisagreementError as disagreement:
            offset = self._found_offset(nodes)
            told = f"; the rotations fit with an offset of {1000 * offset:.0f} ms" if abs(offset) > HELD else ""
            self._refuse(f"{disagreement}{told}", time)
            if offset and abs(offset) <= HELD:
                self.first_offset, self._next = offset, time
            return
        except np.linalg.LinAlgError:
            found = None
        if found is None:
            self._refuse("the motion does not tell scale and gravity", time)
            return
        self._adapt(found, led=self.leads)
        reason = self._doubt(problem, found)
        unsure = not reason or (reason.startswith(_UNCERTAIN) and found.scale_sigma <= LOST_SCALE)
        if unsure and not self.aligned:
            self._unsure = _from_first_camera(found), problem.nodes, worlds[-1]
            self._unsure_since = min(self._unsure_since, time)
        if worlds[-1] not in self.worlds or found.scale_sigma <= LOST_SCALE:
            self._known_at = time
        elif not reason and time - self._known_at > self.options.longest:
            reason, self._failing = f"{_UNCERTAIN} by {100 * found.scale_sigma:.0f} %", -np.inf  # at once
        if reason:
            self._refuse(reason, time)
            return
        self._held = float(found.times[problem.held])
        self._accept(found, worlds, time)

    def predict(self, start: BodyState, times: Array) -> list[BodyState]:
        """States after a known one, from samples alone.

        Args:
            start: the known state.
            times: ``(N,)`` increasing, later than it, seconds, clock of the camera.

        Returns:
            A state for each time, with its covariance. A sensor that stands still does not move.
        """
        assert self.solution is not None
        offset = self.solution.time_offset
        samples = self.stream.near(start.time + offset - 0.5, times[-1] + offset + 0.5)
        found, state = [], start
        for time in times.tolist():
            state = state if samples is None else _step(state, time, offset, samples, self.noise)
            found.append(state)
        return found

    def corrected(self, world: int, target: int, change: Similarity, time: float) -> None:
        """Follow a correction of the visual poses.

        The newest poses of the world keep their place in the metric one, at once and in the next estimates: heading and
        position are held no earlier than at the last keyframe that was corrected, as the way to it has changed.

        Args:
            world: number of the world that the poses were in.
            target: of that they are in now.
            change: from that world before to the one after.
            time: of the last keyframe of that world, seconds.
        """
        known, s = self._known_similarity(world), self.solution
        if known is None or s is None:
            return
        self.worlds.pop(world, None)
        self.worlds[target] = known.before(change)
        if world not in self._known:
            return
        w = s.worlds
        mine = np.flatnonzero(np.array(self._known) == world)
        logs, rotations, translations = w.log_scale.copy(), w.rotation.copy(), w.translation.copy()
        for k in mine:
            found = Similarity(float(np.exp(logs[k])), rotations[k], translations[k]).before(change)
            logs[k], rotations[k], translations[k] = np.log(found.scale), found.rotation, found.translation
            self._known[k] = target
        # The estimate begins with the scales of the last one.
        scales = np.where(np.isin(s.segment, mine), s.log_scale - np.log(change.scale), s.log_scale)
        worlds = Similarities(logs, rotations, translations)
        self.solution = replace(s, log_scale=scales, worlds=worlds, past=None)
        self._held = max(self._held, time)

    def to_be_adjusted(self, world: int) -> tuple[Smoothed, VisualNodes | None] | None:
        """Estimate that an adjustment of images and samples begins with, where it is of use.

        Args:
            world: number of the present world of the visual poses.

        Returns:
            An estimate whose scale is not sure, with its nodes; or that of an aligned world, None for the nodes, which
            samples do not hold well enough. None where there is nothing to gain.
        """
        if not self.aligned:
            waited = self._whole - self._unsure_since >= PATIENT
            return self._unsure[:2] if waited and self._unsure is not None and self._unsure[2] == world else None
        if self.solution is None or world not in self.worlds or self._known[-1:] != [world]:
            return None
        return None if self.holds_unit else (self.solution, None)

    def confirms(self, scale: float, scale_sigma: float) -> bool:
        """Find out if the solution of an adjustment can be taken; an alignment needs two in a row that agree.

        Args:
            scale: metres in a unit of the newest visual poses.
            scale_sigma: its relative deviation.
        """
        if self.aligned:
            return scale_sigma <= self.options.max_scale_sigma
        now = float(np.log(scale)), scale_sigma
        before, self._adjusted = self._adjusted, now
        if scale_sigma > ADJUSTED_SIGMA * self.options.max_scale_sigma:
            self._adjusted = None
            return False
        return before is not None and abs(now[0] - before[0]) <= AGREEMENT + 3 * before[1]

    def adopt(self, states: Smoothed, similarity: Similarity, world: int, scale_sigma: float) -> None:
        """Go on from the solution of an adjustment, to which the visual poses have been corrected.

        Args:
            states: of the nodes, in the metric world.
            similarity: from the world of visual poses to that.
            world: number of the world of the visual poses.
            scale_sigma: relative deviation of the scale.
        """
        log_scale = np.array([np.log(similarity.scale)])
        known = Similarities(log_scale, similarity.rotation[None], similarity.translation[None])
        time = float(states.times[-1])
        self.solution = replace(states, log_scale=np.repeat(log_scale, len(states.times)), worlds=known, past=None)
        self.worlds[world], self._known, self._failing = similarity, [world], np.inf
        self._next = self._whole = -np.inf
        self._adjusted = float(log_scale[0]), scale_sigma
        if not self.aligned:
            self.state, self.reason, self._aligned, self._offset = ScaleState.ALIGNED, "", time, states.time_offset
            self._unsure, self._held, self._known_at = None, time, time
            self.history.append({"time": time, "event": "aligned", "scale_sigma": scale_sigma})
            state = self.last_state()
            assert state is not None
            self._past = [state]
        self._held = max(self._held, time)

    def last_state(self) -> BodyState | None:
        """State of the newest node of the solution; None without one."""
        return None if self.solution is None else _newest(self.solution, self._covariance()[:STATE, :STATE])

    def state_at(self, time: float) -> BodyState | None:
        """State at a time within the solution, or soon after it; None without one.

        Args:
            time: seconds, clock of the camera.

        Returns:
            The node before, carried on by samples; its covariance is that of the newest node.
        """
        s, last = self.solution, self.last_state()
        if s is None or last is None or time < s.times[0] or time > last.time + self.options.longest:
            return None
        at = int(np.searchsorted(s.times, time + 1e-9, "right")) - 1
        state = replace(
            last, time=float(s.times[at]), rotation=s.rotation[at], position=s.position[at], velocity=s.velocity[at],
            gyro_bias=s.gyro_bias[at], accel_bias=s.accel_bias[at],
        )  # fmt: skip
        return state if time <= state.time + 1e-6 else self.predict(state, np.array([time]))[0]

    def beside(self, time: float, rotation: Array, position: Array) -> tuple[BodyState, Array]:
        """State at a frame whose pose is that of the images in metres, and what is known of both.

        Args:
            time: of the frame, seconds; the newest node is as late, or a little earlier.
            rotation, position: ``(3, 3)`` and ``(3,)`` of the camera, as given.

        Returns:
            The state, and the covariance ``(9, 9)`` of position and orientation (right tangent) of the camera, and of
            the velocity of the sensor.
        """
        s, noise = self.solution, self._smoother
        assert s is not None
        # The pose follows similarity and pose of the newest node, and the images from there on.
        size = len(s.covariance)
        kept = np.zeros(
            (STATE + 10, size)
        )  # the state; rotation and position of the node, extrinsic rotation, log scale
        kept[:STATE, :STATE], kept[STATE : STATE + 6, :6] = np.eye(STATE), np.eye(6)
        kept[STATE + 6 : STATE + 9, NODE + 1 : NODE + 4], kept[STATE + 9, [NODE - 1, -4]] = np.eye(3), 1
        state = _newest(s, kept @ self._covariance() @ kept.T)
        moved = position - state.position - state.rotation @ s.lever
        turned = np.hstack([state.rotation, np.zeros((3, 3)), -state.rotation, np.zeros((3, 1))])
        chain = np.zeros((9, STATE + 10))
        chain[:3, STATE:] = -skew(moved) @ turned
        chain[:3, STATE : STATE + 3] -= state.rotation @ skew(s.lever)
        chain[:3, STATE + 3 : STATE + 6], chain[:3, -1] = np.eye(3), moved
        chain[3:6, STATE:], chain[6:, 6:9] = rotation.T @ turned, np.eye(3)
        late = max(time - state.time, 0.0)
        state = self.predict(state, np.array([time]))[0] if late > 0 else state
        covariance = chain @ state.covariance @ chain.T
        turns, moves = noise.variances(late, s.depth)
        covariance[range(6), range(6)] += np.repeat([moves, turns], 3)
        covariance[:3, :3] += (noise.scale_factor * noise.scale_walk) ** 2 * late / 3 * np.outer(moved, moved)
        return replace(state, covariance=state.covariance[:STATE, :STATE]), covariance

    def _covariance(self) -> Array:
        """Covariance of the newest node and the shared unknowns, with heading and position of the node that is held.

        They were those of the alignment at first. Later they are those of an older estimate, which is a window away:
        what it did not know of them, when that node was its newest, is of other measurements.
        """
        found = self.solution
        assert found is not None
        past = [state for state in self._past if state.time <= self._held + 1e-6]
        if not past:
            return found.covariance
        state = past[-1]
        told = np.zeros((4, STATE))  # heading and position of that state
        told[0, :3], told[1:, 3:6] = state.rotation[2], np.eye(3)
        follows = np.zeros((len(found.covariance), 4))  # the newest state by these
        follows[:3, 0] = found.rotation[-1][2]
        (x, y, _), (u, v, _) = found.position[-1] - state.position, found.velocity[-1]
        follows[3:9, 0] = -y, x, 0.0, -v, u, 0.0  # about the vertical
        follows[3:6, 1:] = np.eye(3)
        chain = follows @ told
        return found.covariance + chain @ state.covariance @ chain.T

    def turn_between(self, before: float, after: float) -> Array | None:
        """Rotation of the camera between two frames by the gyroscope.

        Args:
            before, after: seconds, clock of the camera.

        Returns:
            ``(3, 3)`` from the camera after to the camera before; None if samples do not cover the time, or the
            rotation between sensor and camera is not known.
        """
        turn = self.rotation_camera_imu
        if turn is None:
            return None
        offset = self.first_offset if self.solution is None else self.solution.time_offset
        bias = np.zeros(3) if self.solution is None else self.solution.gyro_bias[-1]
        times = np.array([before, after]) + offset
        near = self.stream.near(times[0] - 0.1, times[1] + 0.1)
        if near is None or len(near) < 2:
            return None
        rotation = integrated_turn(near, times, bias)
        return None if rotation is None else turn @ rotation @ turn.T

    def turns_about(self, time: float, offsets: Array) -> Array | None:
        """Orientations of the camera about the time of a frame by the gyroscope, whose newest sample is held.

        Args:
            time: of the frame, seconds, clock of the camera.
            offsets: ``(S,)`` seconds relative to it, some hundredths at most.

        Returns:
            ``(S, 3)`` rotation vectors from the orientation at the time to those at the offsets, in the axes of the
            camera, rad; None without samples, or if the rotation between sensor and camera is not known.
        """
        turn, bias = self.rotation_camera_imu, np.zeros(3) if self.solution is None else self.solution.gyro_bias[-1]
        time += self.first_offset if self.solution is None else self.solution.time_offset
        near = self.stream.near(time - HELD, time + HELD)
        if turn is None or near is None or near.timestamps[0] > time:
            return None
        columns = [np.interp(np.append(time + offsets, time), near.timestamps, axis) for axis in near.gyro.T]
        rates = np.stack(columns, -1) - bias
        return 0.5 * (rates[:-1] + rates[-1]) * offsets[:, None] @ turn.T

    def turns(self, nodes: VisualNodes) -> Callable[[Array, Array], Array] | None:
        """What the gyroscope tells of rotations about the times of frames, also without an alignment.

        Args:
            nodes: visual poses of the recording; the longest segment tells time offset and bias.

        Returns:
            Rotation vectors ``(N, s, 3)`` from the camera at times ``(N,)`` to that ``(s,)`` seconds later, nan without
            samples; None where time offset and bias are not told for sure.
        """
        samples, turn = self.stream.samples(), self.rotation_camera_imu
        if samples is None or turn is None or not len(nodes):
            return None
        longest = nodes.of(int(np.bincount(nodes.segment).argmax()))
        found = align_imu(longest.times, longest.rotation, samples.timestamps, samples.gyro, turn, fixed=True)
        if found.reason or found.sigma_offset > SURE_OFFSET or found.residual > SURE_TURN:
            return None
        return partial(_turns, samples, found)

    def information(self) -> dict[str, Any]:
        """Entries of run.json."""
        facts: dict[str, Any] = {"state": self.state.value}
        if self.reason:
            facts["reason"] = self.reason
        s = self.solution
        if s is not None and self.aligned:
            facts |= {
                "scale_sigma": s.scale_sigma, "gravity_sigma_deg": s.gravity_sigma, "time_offset": s.time_offset,
                "gyro_bias": s.gyro_bias[-1].tolist(), "accel_bias": s.accel_bias[-1].tolist(),
                "aligned_at": self._aligned,
            }  # fmt: skip
        return facts | ({"history": self.history} if self.history else {})

    def settle(
        self, nodes: VisualNodes, worlds: list[int], confirm: Callable[[Smoothed], float] | None = None
    ) -> Smoothed | None:
        """Estimate of a whole recording at its end, whose similarities are the final ones.

        The poses have been adjusted: their noise is estimated anew, and a recording that was never aligned may be now.

        Args:
            nodes: visual poses of the recording; of one segment, if there was no alignment.
            worlds: number of the world of each segment of the nodes.
            confirm: relative deviation of the scale by a closer look at an estimate, for one that is not sure of it;
                inf if that finds no solution. None: there is none.

        Returns:
            The estimate; None where there is none that passes the tests: what was known before stays, and the reason
            is told.
        """
        if any(world in self.worlds for world in worlds):  # what was lost before the alignment keeps its own world
            first = next(k for k, world in enumerate(worlds) if world in self.worlds)
            nodes, worlds = _chosen(nodes, worlds, nodes.segment >= first)
        end = float(nodes.times[-1]) if len(nodes) else -np.inf
        problem, worlds, doubt = self._problem(nodes, worlds)
        if problem is None:
            self.reason = doubt if self.aligned else self.reason
            return None
        if self.solution is None:
            problem.held = 0  # the origin is the place of the first camera
        found: Smoothed | None = None
        sigma, unsure, reason = 0.0, False, ""
        try:
            for _ in range(ROUNDS):  # each with the noise that the one before has found
                problem = replace(problem, options=replace(self._smoother, iterations=FINAL_ITERATIONS))
                start = None if self.solution is None else self._start(problem, worlds)
                found = self._solved(problem, worlds) if start is None else smooth(problem, start)
                if found is None:
                    return None
                self._adapt(found)
                reason = self._doubt(problem, found)
                unsure = reason.startswith(_UNCERTAIN) and found.scale_sigma <= LOST_SCALE and confirm is not None
                if reason and not unsure:
                    self.reason = reason
                    return None
                if not unsure:
                    self.solution, self._known = found, list(worlds)
            if unsure:
                assert confirm is not None and found is not None
                sigma = confirm(found)
                if sigma > CLOSER * self.options.max_scale_sigma:
                    self.reason = reason
                    return None
                self.solution, self._known = found, list(worlds)
        except _DisagreementError as disagreement:
            self.reason = str(disagreement)
            return None
        except np.linalg.LinAlgError:
            self.reason = "the motion does not tell scale and gravity"
            return None
        assert found is not None
        if not self.aligned:
            self.state, self.reason, self._aligned = ScaleState.ALIGNED, "", float(found.times[-1])
            self.history.append(
                {"time": self._aligned, "event": "aligned at the end", "scale_sigma": sigma or found.scale_sigma}
            )
        self._take(found, worlds)
        self.untold = set(worlds) - set(self.worlds)
        self._doubtful, self._failing = False, np.inf  # that was of the newest poses
        late = end + found.time_offset - self.stream.end
        self.reason = f"no samples for the last {late:.0f} s" if late > self.options.longest else ""
        return found

    # ------------------------------------------------------------------------------------------------------------------

    def _go_on(self, past: Past, nodes: VisualNodes, worlds: list[int]) -> bool:
        """Bring the last estimate to the newest pose, as what older poses have told stays; False if they do not fit."""
        known = self.solution
        if (
            known is None
            or worlds != self._known[-1:]
            or worlds[0] not in self.worlds
            or abs(nodes.times[0] - past.time) > 1e-6
        ):
            return False
        problem, _, _ = self._problem(nodes, worlds)
        if problem is None or problem.nodes.times[0] != nodes.times[0]:
            return False
        count, present = len(self._known), problem.nodes
        problem.nodes = replace(present, segment=present.segment + count - 1)
        problem.past, problem.held = past, -1 if past.holds else problem.held
        problem.options = replace(self._smoother, iterations=1)
        try:
            found = smooth(problem, self._start(problem, self._known))
        except np.linalg.LinAlgError:
            return False
        self._next = float(nodes.times[-1]) + BETWEEN
        if not self._doubt(problem, found):
            self._follow(_joined(known, found))
        return True

    def _problem(self, nodes: VisualNodes, worlds: list[int]) -> tuple[Smoother | None, list[int], str]:
        """Problem of nodes that samples cover, and the worlds of its segments; None and why there is none."""
        samples, turn = self.stream.samples(), self.rotation_camera_imu
        if self._drift:
            return None, worlds, self._drift
        if samples is None or len(samples) < 2:
            return None, worlds, "too few samples"
        if turn is None:
            reason = self._turn_between(nodes, samples)
            turn = self.rotation_camera_imu
            if turn is None:
                return None, worlds, reason
        offset = self.first_offset if self.solution is None else self.solution.time_offset
        # Where the sensor's clock is ahead, the newest sample is older than the newest frame.
        images, times = nodes.times, nodes.times + offset
        kept = (times <= samples.timestamps[-1] + HELD) & (times - LEAD >= samples.timestamps[0])
        if not kept.all():
            nodes, worlds = _chosen(nodes, worlds, kept)
        enough = self.options.first if not self.aligned else 2 * self.options.interval
        if len(nodes) < 3 or nodes.times[-1] - nodes.times[0] < enough:
            if len(images) < 3 or images[-1] - images[0] < enough:
                return None, worlds, "too few poses"
            spans = f"from {samples.timestamps[0]:.3f} to {samples.timestamps[-1]:.3f} s"
            return None, worlds, f"too few samples: they are {spans}, images from {images[0]:.3f} to {images[-1]:.3f} s"
        near = samples.between(nodes.times[0] - 0.5, nodes.times[-1] + 0.5)
        last = float(nodes.times[-1]) + offset + (0.0 if self.aligned else LEAD)
        near = _held(near, min(last, float(samples.timestamps[-1]) + HELD))
        force = float(np.median(np.linalg.norm(near.accel, axis=1))) if len(near) else 0.0
        if not GRAVITY_RANGE[0] <= force <= GRAVITY_RANGE[1]:
            return None, worlds, f"the median specific force is {force:.3g} m/s^2 where gravity is 9.81: units, or axes"
        lever = -turn.T @ self.translation_camera_imu
        problem = Smoother(
            nodes, near, self.noise, turn, lever, self._smoother, offset=offset, unit_held=self.holds_unit
        )  # fmt: skip
        if self.solution is None:
            problem.held = len(nodes) - 1
        else:
            at = int(np.abs(self.solution.times - nodes.times[0]).argmin())
            problem.held = self._common(nodes)
            problem.gyro_bias, problem.accel_bias = self.solution.gyro_bias[at], self.solution.accel_bias[at]
        return problem, worlds, ""

    def _turn_between(self, nodes: VisualNodes, samples: InertialSamples) -> str:
        """Find the rotation between sensor and camera; why it is not found."""
        unknown = "the rotation between sensor and camera is not known"
        if len(nodes) < 10 or nodes.segment[0] != nodes.segment[-1]:
            return unknown
        found = align_imu(nodes.times, nodes.rotation, samples.timestamps, samples.gyro)
        if found.reason or found.sigma_rotation.max() > MAX_TURN or not np.isfinite(found.sigma_offset):
            return f"{unknown}, and {found.reason or 'the motion does not tell it'}: turn about several axes"
        self.rotation_camera_imu, self.first_offset = found.rotation_camera_imu, found.time_offset
        self._smoother = replace(self._smoother, extrinsic_sigma=FOUND_EXTRINSIC)
        self.history.append({"time": float(nodes.times[-1]), "event": "rotation between sensor and camera found"})
        return ""

    def _offset_by_turns(self, nodes: VisualNodes) -> tuple[float, float] | None:
        """Time offset by the rotations of nodes of one segment alone, and its deviation; None: they do not tell it."""
        samples, turn = self.stream.samples(), self.rotation_camera_imu
        if samples is None or turn is None:
            return None
        near = samples.between(nodes.times[0] - 1.0, nodes.times[-1] + 1.0)
        found = align_imu(nodes.times, nodes.rotation, near.timestamps, near.gyro, turn, fixed=True)
        if found.reason or found.sigma_offset > SURE_OFFSET or found.residual > SURE_TURN:
            return None
        return found.time_offset, found.sigma_offset

    def _watch_clock(self, nodes: VisualNodes, time: float) -> None:
        """Compare the time offsets of two halves of the newest segment now and then: a clock that drifts is no use."""
        mine = nodes.of(int(nodes.segment[-1]))
        span = float(mine.times[-1] - mine.times[0])
        if self._drift or time < self._watched + CLOCK_EVERY or span < CLOCK_SPAN:
            return
        self._watched, early = time, mine.times <= mine.times[0] + span / 2
        first, second = (self._offset_by_turns(mine.where(half)[0]) for half in (early, ~early))
        if first is None or second is None:
            return
        (before, sigma), (after, other) = first, second
        rate, known = 2 * (after - before) / span, 2 * float(np.hypot(sigma, other)) / span
        if abs(rate) - 3 * known > MAX_DRIFT:
            self._drift = f"the clock of the samples drifts by {1000 * rate:.1f} ms a second"
            self._failing = -np.inf  # at once

    def _found_offset(self, nodes: VisualNodes) -> float:
        """Time offset by rotations, where they tell another one than an alignment began with; 0 otherwise."""
        if self.history:  # an offset that another one follows is a clock that drifts
            return 0.0
        found = self._offset_by_turns(nodes.of(int(nodes.segment[-1])))
        return 0.0 if found is None or abs(found[0] - self.first_offset) < SHIFT else found[0]

    def _solved(self, problem: Smoother, worlds: list[int]) -> Smoothed | None:
        """The best solution from some starts."""
        if self.aligned and self.solution is not None:
            return smooth(
                replace(problem, options=replace(problem.options, iterations=4)), self._start(problem, worlds)
            )
        nodes = problem.nodes.of(problem.segments - 1)  # a first alignment needs one segment alone
        if len(nodes) < 3 or nodes.times[-1] - nodes.times[0] < self.options.first:
            return None
        problem.nodes, problem.held = nodes, len(nodes) - 1 if problem.held else 0
        scale, gravity, bias = linear_start(problem)
        problem.gyro_bias = bias
        self._turned_apart(problem, nodes, np.tile(bias, (len(nodes), 1)), np.zeros((len(nodes), 3)), problem.offset)
        if scale < 0 and acceleration_sign(problem) < OPPOSED:
            raise _DisagreementError(
                "accelerations of samples and images are opposed: the accelerometer has the wrong sign (its axis that "
                "points up reads +9.8 at rest)"
            )
        best: Smoothed | None = None
        for factor in STARTS:
            first = np.array([np.log(factor * (scale if scale > 1e-6 else 1.0))])
            start = first_values(problem, Similarities(first, upright(gravity)[None], np.zeros((1, 3))))
            try:
                found = smooth(problem, start)
            except np.linalg.LinAlgError:
                continue
            if best is None or found.cost < best.cost:
                best = found
            if scale > 1e-6 and factor == 1.0 and found.scale_sigma < 0.1 * self.options.max_scale_sigma:
                break  # nothing else fits such measurements
        return best

    def _start(self, problem: Smoother, worlds: list[int]) -> Values:
        """Values of the last solution, and of what it tells of a segment after it."""
        known = self.solution
        assert known is not None
        count = problem.segments
        logs, rotations, translations = np.zeros(count), np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
        for k, world in enumerate(worlds[:count]):
            similarity = self._known_similarity(world) or self._joined(problem, k)
            logs[k], rotations[k], translations[k] = (
                np.log(similarity.scale),
                similarity.rotation,
                similarity.translation,
            )
        start = first_values(problem, Similarities(logs, rotations, translations))
        times = problem.nodes.times
        bias = np.concatenate([known.gyro_bias, known.accel_bias], 1)
        start.bias = np.stack([np.interp(times, known.times, column) for column in bias.T], 1)
        start.extrinsic = rotation_vector(problem.rotation_camera_imu.T @ known.rotation_camera_imu)
        # Nodes of the last solution as they were, and those after it as the samples tell: visual poses are too noisy.
        same = np.searchsorted(known.times, times).clip(max=len(known.times) - 1)
        old = np.abs(known.times[same] - times) < 1e-6
        for values, solved in (
            (start.rotation, known.rotation), (start.position, known.position), (start.velocity, known.velocity),
        ):  # fmt: skip
            values[old] = solved[same[old]]
        later, state = np.flatnonzero(times > known.times[-1] + 1e-6), self.last_state()
        assert state is not None
        samples = problem.samples
        times_there = np.concatenate([[state.time], times[later]]) + problem.offset
        if len(later) and samples.timestamps[0] <= times_there[0]:
            found = propagate(
                state.rotation, state.position, state.velocity, samples, times_there, state.gyro_bias,
                state.accel_bias, GRAVITY,
            )  # fmt: skip
            start.rotation[later], start.position[later], start.velocity[later] = (part[1:] for part in found)
        start.world, start.log_scale, start.drift = self._drifts(problem, start, known)
        return start

    @staticmethod
    def _drifts(problem: Smoother, start: Values, known: Smoothed) -> tuple[Array, Array, Array]:
        """Worlds and scales of the segments at their first nodes, and the drift of the others."""
        nodes, past = problem.nodes, problem.past
        body = problem.rotation_camera_imu @ so3_exp(start.extrinsic)
        begins = np.flatnonzero(np.concatenate([[True], nodes.segment[1:] != nodes.segment[:-1]]))
        scales = start.log_scale[nodes.segment]
        inside = (nodes.times >= known.times[0] - 1e-6) & (nodes.times <= known.times[-1] + 1e-6)
        scales[inside] = np.interp(nodes.times[inside], known.times, known.log_scale)
        if past is None:
            world = start.rotation[begins] @ np.swapaxes(nodes.rotation[begins] @ body, -1, -2)
            logs = scales[begins]
        else:  # the first nodes are before these
            world, logs = past.values.world, past.values.log_scale
        turn = rotation_vector(start.rotation @ np.swapaxes(world[nodes.segment] @ nodes.rotation @ body, -1, -2))
        return world, logs, np.concatenate([turn, (scales - logs[nodes.segment])[:, None]], 1)

    def _common(self, nodes: VisualNodes) -> int:
        """The node that is held: of those that the last solution has, the nearest to the one held there."""
        assert self.solution is not None
        known = np.isin(np.round(nodes.times, 6), np.round(self.solution.times, 6))
        return int(np.where(known, np.abs(nodes.times - self._held), np.inf).argmin())

    def _known_similarity(self, world: int) -> Similarity | None:
        """Present estimate of a world."""
        if self.solution is not None and world in self._known:
            k = len(self._known) - 1 - self._known[::-1].index(world)  # it may have come again
            w = self.solution.worlds
            return Similarity(float(np.exp(w.log_scale[k])), w.rotation[k], w.translation[k])
        return self.worlds.get(world)

    def _joined(self, problem: Smoother, segment: int) -> Similarity:
        """Similarity of a new segment, from the state that is predicted for its first node."""
        nodes, last = problem.nodes, self.last_state()
        assert last is not None
        mine = np.flatnonzero(nodes.segment == segment)
        mine = mine[nodes.times[mine] > last.time] if (nodes.times[mine] > last.time).any() else mine
        state = self.predict(last, nodes.times[mine[:1]])[0] if nodes.times[mine[0]] > last.time else last
        # The axes of the segment are those of its first camera: until samples tell its vertical, the prediction does.
        rotation = state.rotation @ (nodes.rotation[mine[0]] @ problem.rotation_camera_imu).T
        path, times = nodes.position[mine], nodes.times[mine]
        visual = (path[-1] - path[0]) if len(mine) > 1 else np.zeros(3)
        ahead = self.predict(state, times[-1:])[0] if len(mine) > 1 and times[-1] > state.time else state
        arms = [s.rotation @ problem.lever for s in (state, ahead)]
        moved = ahead.position + arms[1] - state.position - arms[0]
        length = float(np.linalg.norm(visual))
        scale = float(np.linalg.norm(moved)) / length if length > 1e-9 else 1.0
        scale = scale if scale > 1e-6 else 1.0
        return Similarity(scale, rotation, state.position + arms[0] - scale * rotation @ path[0])

    @staticmethod
    def _turned_apart(problem: Smoother, nodes: VisualNodes, gyro: Array, accel: Array, offset: float) -> None:
        """Compare the rotations of gyroscope and images between nodes."""
        turned = nodes.rotation @ problem.rotation_camera_imu
        motion = preintegrate(problem.samples, nodes.times + offset, gyro[:-1], accel[:-1], problem.noise)
        off = rotation_vector(np.swapaxes(motion.rotation, -1, -2) @ np.swapaxes(turned[:-1], -1, -2) @ turned[1:])
        inside = motion.covered & (nodes.segment[1:] == nodes.segment[:-1])
        recent = inside & (nodes.times[:-1] >= nodes.times[-1] - LAST_TURNS)
        # the first poses of a segment are the least sure
        settled = nodes.times[-1] - nodes.times[nodes.segment == nodes.segment[-1]][0] > 2 * LAST_TURNS
        # In haste the images are wrong; as fast as both say, or a wrong unit of the gyroscope would excuse itself.
        seen = np.linalg.norm(rotation_vector(np.swapaxes(turned[:-1], -1, -2) @ turned[1:]), axis=1)
        haste = 1 + (np.minimum(problem.angular_rate, seen / np.diff(nodes.times)) / HASTE) ** 2
        squares = (off**2).sum(-1) / haste**2
        most = np.sort(squares[inside])[: int(np.ceil(MOST_TURNS * inside.sum()))]
        angle = float(np.rad2deg(np.sqrt(most.mean()))) if inside.any() else 0.0
        if settled and recent.any():  # a sensor that has just been hit; images that jump once do not count
            angle = max(angle, float(np.rad2deg(np.sqrt(np.median(squares[recent])))))
        if angle > MAX_TURN:
            raise _DisagreementError(
                f"gyroscope and images turn differently, by {angle:.1f} degrees: axes, time offset or clock"
            )

    def _adapt(self, found: Smoothed, *, led: bool = False) -> None:
        """Follow the noise of the visual poses; those that samples lead agree with them, whatever the noise is."""
        factors = np.clip(np.sqrt(found.visual_error), 1.0 if led else 0.7, 1.4)
        known = self._smoother
        now = np.array([known.rotation_factor, known.position_factor, known.scale_factor])
        rotation, position, scale = np.clip(now * factors, *NOISE_RANGE).tolist()
        self._smoother = replace(known, rotation_factor=rotation, position_factor=position, scale_factor=scale)

    def _doubt(self, problem: Smoother, found: Smoothed) -> str:
        """Why an estimate is not believed; empty if it is."""
        try:
            self._turned_apart(problem, problem.nodes, found.gyro_bias, found.accel_bias, found.time_offset)
        except _DisagreementError as disagreement:
            return str(disagreement)
        for name, values, limit, unit in (
            ("gyroscope", found.gyro_bias, MAX_BIASES[0], "rad/s"),
            ("accelerometer", found.accel_bias, MAX_BIASES[1], "m/s^2"),
        ):
            bias = float(np.abs(values[-1]).max())
            if bias > limit + 3 * (self.noise.gyro_bias if unit == "rad/s" else self.noise.accel_bias):
                return f"a bias of the {name} of {bias:.2g} {unit}: a damaged sensor, or wrong units"
        if found.inertial_error > MAX_ERROR or self._smoother.rotation_factor > MAX_ROTATION_FACTOR:
            return "samples and images do not fit: noise, time offset or extrinsic calibration"
        if self.aligned and abs(found.time_offset - self._offset) > MAX_SHIFT:
            shift = 1000 * (found.time_offset - self._offset)
            return f"the time offset has changed by {shift:.0f} ms: the clocks drift"
        if not self.aligned:
            speeding = np.diff(found.velocity, axis=0) / np.diff(found.times)[:, None]
            excitation = float(np.sqrt(speeding.var(0).sum()))
            if excitation < self.options.min_excitation:
                least = self.options.min_excitation
                return f"too little acceleration, {excitation:.2f} of {least:.2f} m/s^2"
            if found.scale_sigma > NOTHING_TOLD:
                return "the images show rotation, and too little translation with changes of speed"
            if found.scale_sigma > self.options.max_scale_sigma:
                return f"{_UNCERTAIN} by {100 * found.scale_sigma:.1f} %: move on, with changes of speed"
            if found.gravity_sigma > MAX_GRAVITY_SIGMA:
                return f"the vertical is uncertain by {found.gravity_sigma:.1f} degrees"
        return ""

    def _refuse(self, reason: str, time: float) -> None:
        """Note why there is no estimate; an alignment that fails again and again is withdrawn."""
        self._candidate = None
        if not self.aligned:
            # The same again and again: look more rarely, but not where a little more motion is all that is missing.
            again = _words(reason) == _words(self.reason) and not reason.startswith(_WAITING)
            if again and "is uncertain" not in reason:
                self._patience = min(2 * self._patience, MOST_PATIENCE)
            else:
                self._patience = AT_FIRST
            self._next = time + self._patience
            self.reason = reason
            return
        if reason.startswith(_WAITING):
            return
        self._failing, self.reason = min(self._failing, time), reason
        if time - self._failing > FAILING - 1e-6:
            self.history.append({"time": time, "event": "withdrawn", "reason": reason})
            self.state, self.reason = ScaleState.INITIALISING, f"withdrawn: {reason}"
            self.worlds, self.solution, self._known, self._failing, self._past = {}, None, [], np.inf, []
            self._unsure, self._adjusted, self._unsure_since, self._doubtful = None, None, np.inf, False

    def _accept(self, found: Smoothed, worlds: list[int], time: float) -> None:
        """Take an estimate that has passed; the first one has to be confirmed by another."""
        self._failing = np.inf
        if not self.aligned:
            worlds = worlds[-1:]
            now = float(found.worlds.log_scale[-1]), found.scale_sigma
            before, self._candidate = self._candidate, now
            if before is None or abs(now[0] - before[0]) > AGREEMENT + 3 * before[1]:
                self.reason = "the estimate waits for another that confirms it"
                return
            self.state, self.reason, self._aligned = ScaleState.ALIGNED, "", time
            self._offset = found.time_offset
            self._take(_from_first_camera(found), worlds)
            self.history.append({"time": time, "event": "aligned", "scale_sigma": found.scale_sigma})
            return
        new = worlds[-1] not in self.worlds
        if not new or found.scale_sigma <= self._most_sigma:
            self._take(found, worlds)
        elif found.scale_sigma < NOTHING_TOLD:  # a new segment, whose scale is not sure yet
            self.solution, self._known = found, list(worlds[: len(found.worlds.log_scale)])
            self._tell()
        if time - self._aligned >= REFINED_AFTER:
            self.state = ScaleState.REFINED

    def _listen(self, time: float) -> None:
        """Note if samples are missing at the time of a frame."""
        offset = self.first_offset if self.solution is None else self.solution.time_offset
        late = time + offset - self.stream.end
        self._silent = self.aligned and late > SILENT
        if self._silent:
            self.reason = f"no samples for {late:.0f} s"

    def _tell(self) -> None:
        """Note if the present scale is known."""
        if not self.aligned:
            return
        self._doubtful = self.scale_sigma > (SURE_SCALE if self._doubtful else UNSURE_SCALE)
        if self._doubtful:
            self.reason = f"{_UNCERTAIN} by {100 * self.scale_sigma:.0f} % for now"
        elif self._failing == np.inf and not self._silent:
            self.reason = ""

    def _take(self, found: Smoothed, worlds: list[int]) -> None:
        """Let poses follow an estimate."""
        self._known = list(worlds[: len(found.worlds.log_scale)])
        self._follow(found)
        state = self.last_state()
        assert state is not None
        before = [k for k, known in enumerate(self._past) if known.time <= self._held + 1e-6]
        self._past = [*self._past[before[-1] if before else 0 :], state]  # those that are told of, now or later
        if found.past is not None:
            self._next = self._whole + BETWEEN

    def _follow(self, found: Smoothed) -> None:
        self.solution = found
        self._tell()
        told = found.segment_sigmas <= self._most_sigma
        told[-1] |= found.scale_sigma <= self._most_sigma or not self.worlds
        for k, world in enumerate(self._known):
            w = found.worlds
            if told[k] or world in self.worlds:
                self.worlds[world] = Similarity(float(np.exp(w.log_scale[k])), w.rotation[k], w.translation[k])


def _chosen(nodes: VisualNodes, worlds: list[int], keep: Array) -> tuple[VisualNodes, list[int]]:
    """Nodes that are chosen by a mask ``(N,)``, and the worlds of their segments."""
    nodes, left = nodes.where(keep)
    return nodes, [worlds[k] for k in left]


def _newest(found: Smoothed, covariance: Array) -> BodyState:
    """State of the newest node."""
    return BodyState(
        float(found.times[-1]), found.rotation[-1], found.position[-1], found.velocity[-1], found.gyro_bias[-1],
        found.accel_bias[-1], covariance,
    )  # fmt: skip


def _joined(before: Smoothed, after: Smoothed) -> Smoothed:
    """An estimate, and nodes of the one that it goes on from before it."""
    kept = before.times < after.times[0] - 1e-6

    def joined(early: Array, late: Array) -> Array:
        return np.concatenate([early[kept], late])

    return replace(
        after, times=joined(before.times, after.times), segment=joined(before.segment, after.segment),
        rotation=joined(before.rotation, after.rotation), position=joined(before.position, after.position),
        velocity=joined(before.velocity, after.velocity), gyro_bias=joined(before.gyro_bias, after.gyro_bias),
        accel_bias=joined(before.accel_bias, after.accel_bias), log_scale=joined(before.log_scale, after.log_scale),
    )  # fmt: skip


def _from_first_camera(found: Smoothed) -> Smoothed:
    """An estimate of one segment, whose origin moves to the place of the first camera."""
    origin = found.worlds.translation[-1]
    worlds = replace(found.worlds, translation=found.worlds.translation - origin)
    return replace(found, position=found.position - origin, worlds=worlds, past=None)


def _turns(samples: InertialSamples, sensor: ImuAlignment, times: Array, offsets: Array) -> Array:
    """Rotation vectors ``(N, s, 3)`` from the camera at times to the camera later by offsets; nan without samples."""
    stamps = samples.timestamps - sensor.time_offset
    steps = 0.5 * (samples.gyro[1:] + samples.gyro[:-1]) * np.diff(stamps)[:, None]
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    ends = np.concatenate([times[:, None] + offsets, times[:, None]], 1)
    after = np.searchsorted(stamps, ends).clip(1, len(stamps) - 1)
    covered = (ends >= stamps[0]) & (ends <= stamps[-1]) & (stamps[after] - stamps[after - 1] < LONGEST_GAP)
    turned = np.stack([np.interp(ends, stamps, column) for column in angle.T], -1)
    turned = turned[:, :-1] - turned[:, -1:] - sensor.gyro_bias * offsets[:, None]
    return np.where(covered.all(1)[:, None, None], -turned @ sensor.rotation_camera_imu.T, np.nan)


def _words(reason: str) -> str:
    """A reason without its numbers."""
    return "".join(letter for letter in reason if not letter.isdigit())


def _held(samples: InertialSamples, until: float) -> InertialSamples:
    """Samples of which the newest is held until a time soon after it, as where the sensor's clock is ahead."""
    stamps = samples.timestamps
    if not len(samples) or not 0 < until - stamps[-1] <= HELD:
        return samples
    gyro, accel = (np.concatenate([values, values[-1:]]) for values in (samples.gyro, samples.accel))
    return replace(samples, timestamps=np.append(stamps, until), gyro=gyro, accel=accel)


def _step(state: BodyState, time: float, offset: float, samples: InertialSamples, noise: ImuNoise) -> BodyState:
    """State at a later time."""
    times = np.array([state.time, time]) + offset
    near = _held(samples.between(times[0] - 0.5, times[1] + 0.5), times[1])
    if len(near) < 2:
        return state
    motion, span = preintegrate(near, times, state.gyro_bias, state.accel_bias, noise), time - state.time
    if motion.covered[0]:
        rotation = state.rotation @ motion.rotation[0]
        velocity = state.velocity + GRAVITY * span + state.rotation @ motion.velocity[0]
        position = state.position + 0.5 * (2 * state.velocity + GRAVITY * span) * span
        position = position + state.rotation @ motion.position[0]
    else:
        known = state.rotation, state.position, state.velocity, near, times, state.gyro_bias, state.accel_bias
        rotation, position, velocity = (part[1] for part in propagate(*known, GRAVITY))
    pair = (
        np.stack([state.rotation, rotation]),
        np.stack([state.position, position]),
        np.stack([state.velocity, velocity]),
    )
    bias = np.tile(np.concatenate([state.gyro_bias, state.accel_bias]), (2, 1))
    _, before, after, own = motion_factors(motion, *pair, bias)
    back = np.linalg.inv(after[0, :, :9])
    size = len(state.covariance)
    forward, added = np.eye(size), np.zeros((size, size))
    forward[:9, :STATE] = -back @ before[0]
    added[:9, :9] = back @ own[0] @ back.T
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3) ** 2 * span
    added[range(9, STATE), range(9, STATE)] = walk
    covariance = forward @ state.covariance @ forward.T + added
    sigma = float(np.sqrt(np.trace(covariance[6:9, 6:9])))
    if np.linalg.norm(velocity) < STILL_SPEED + 3 * sigma and _stands_still(near, times[1], state):
        position, velocity = state.position, np.zeros(3)
        covariance[6:9, :], covariance[:, 6:9] = 0, 0
        covariance[6:9, 6:9] = 1e-4 * np.eye(3)
    return BodyState(time, rotation, position, velocity, state.gyro_bias, state.accel_bias, covariance)


def _stands_still(samples: InertialSamples, time: float, state: BodyState) -> bool:
    """Nothing is felt for a while."""
    recent = samples.between(time - STILL_FOR, time)
    if len(recent) < 5 or recent.timestamps[-1] - recent.timestamps[0] < 0.7 * STILL_FOR:
        return False
    rates, forces = recent.gyro - state.gyro_bias, recent.accel
    quiet = rates.std(0).max() < STILL[0] and forces.std(0).max() < STILL[1]
    return bool(quiet and np.linalg.norm(rates.mean(0)) < STILL[0])


def camera_pose(state: BodyState, rotation_camera_imu: Array, translation_camera_imu: Array) -> tuple[Array, Array]:
    """Camera to world of a body state: rotation ``(3, 3)`` and position ``(3,)``."""
    rotation = state.rotation @ rotation_camera_imu.T
    return rotation, state.position - rotation @ translation_camera_imu


def camera_covariance(state: BodyState, rotation_camera_imu: Array, translation_camera_imu: Array) -> Array:
    """Covariance ``(9, 9)`` of position and orientation (right tangent) of the camera, and of velocity of the sensor.

    Args:
        state: of the sensor.
        rotation_camera_imu, translation_camera_imu: pose of the sensor in the camera.
    """
    chain = np.zeros((9, STATE))
    chain[:3, :3] = state.rotation @ skew(rotation_camera_imu.T @ translation_camera_imu)
    chain[:3, 3:6] = chain[6:, 6:9] = np.eye(3)
    chain[3:6, :3] = rotation_camera_imu
    return chain @ state.covariance @ chain.T
