"""Metric trajectory from a visual one and inertial samples: maximum a posteriori of a chain of body states.

A visual trajectory has an unknown scale that drifts, and orientations and displacements with noise. Unknown are, at
nodes a fraction of a second apart, orientation, position, velocity and biases of the sensor in a world whose z axis
points up, and the drift of the visual orientation and of the logarithm of the scale; and, for all nodes, scale and
orientation of each segment's world, the time offset, and the rotation between sensor and camera. Preintegrated samples
tie consecutive nodes (Forster et al., 2017, eq. 45), also across an interval without images, so that a segment after
it is joined to the one before.

Errors: ``R_wb = R Exp(phi)`` and additive positions, velocities and biases, as in that paper; ``A <- Exp(alpha) A`` of
the rotation of a segment's world. The drift of the visual orientation is in the axes of the world, where it stays as
the camera turns. How noisy a visual trajectory is, its residuals tell (:attr:`Smoothed.visual_error`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import numpy as np

from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import rotation_vector, skew, so3_exp
from dvo.odometry.inertial.chain import ChainSolution, ChainSystem, marginal, solve_chain
from dvo.odometry.inertial.preintegration import Preintegration, preintegrate

Array = np.ndarray
GRAVITY = np.array([0.0, 0.0, -9.81])
"""Acceleration of a falling body in the world, m/s^2; z is up."""
STATE = 15
"""Unknowns of the body at a node: rotation, position, velocity, gyroscope and accelerometer bias."""
NODE = 19
"""Those, and the drift of the visual orientation and of the log scale."""
_TIME, _EXTRINSIC, _SEGMENT = 0, slice(1, 4), 4  # unknowns that all nodes share; 4 for each segment after them
SHIFT = 5e-4
"""Change of the time offset, seconds, after which samples are integrated anew."""
WIDTH = 6.0
"""Of the robust kernel of visual residuals, deviations."""
SHIFTED = 0.8
"""Visual shift that goes with a visual turn that is wrong, in usual depths of the scene."""
RECENT = 2.0
"""Seconds before the newest node from which an estimate goes on, until the next one of the whole window."""
HASTE = 2.0
"""Angular rate, rad/s, at which images tell a motion half as well as at rest, and then worse with its square: blur, and
little that is seen for long."""
CARRIED, MOST_CARRIED = 15.0, 30.0
"""Angular rate over the rate of parallax (speed over depth of the scene) at which the unit that images carry from what
leaves the view to what enters it drifts twice as fast as at rest, and then with its square; and factor at most."""
LEAST_PARALLAX = 1e-2
"""Rate of parallax, rad/s, below which it is noise: a camera at rest keeps its view, and with it the unit."""
OUTLIER = 16.0
"""Squared residual, in variances, that a measurement counts for at most where the noise is estimated: images that were
wrong for a moment are no noise of all others."""
USUAL = 10.0
"""Measurements that the usual noise of visual poses counts for, where it is estimated."""
OPPOSED = -0.5
"""Correlation (:func:`acceleration_sign`) below which accelerations of the samples are opposed to the images'."""
_SURE = 8.0  # deviations of a scale whose sign is believed
_STEP, _STRETCH = 0.25, 4.0  # seconds between nodes that tell the sign, and of a stretch with a gravity of its own
_FIXED = 1e18  # information of an unknown that is held
_HELD = 1e14  # of the heading that is held, one direction of three: more would drown the others in rounding errors
_UNKNOWN = 1e12  # variance of a motion without samples


@dataclass(frozen=True)
class VisualNodes:
    """Visual poses that take part.

    Attributes:
        times: ``(N,)`` increasing, seconds, clock of the camera.
        segment: ``(N,)`` numbers from 0, increasing, each with a world and a unit of its own.
        rotation: ``(N, 3, 3)`` camera to world of the segment.
        position: ``(N, 3)`` of the camera, units of the segment.
        depth: ``(N,)`` usual depth of the scene that is seen, units of the segment.
    """

    times: Array
    segment: Array
    rotation: Array
    position: Array
    depth: Array

    def __len__(self) -> int:
        return len(self.times)

    def where(self, keep: Array) -> tuple[VisualNodes, Array]:
        """Nodes that are chosen by a mask ``(N,)``, and the numbers so far of the segments that are left."""
        left, segment = np.unique(self.segment[keep], return_inverse=True)
        nodes = VisualNodes(self.times[keep], segment, self.rotation[keep], self.position[keep], self.depth[keep])
        return nodes, left

    def of(self, segment: int) -> VisualNodes:
        """Nodes of one segment, which becomes the only one."""
        return self.where(self.segment == segment)[0]


def spaced(times: Array, worlds: Sequence[int], spacing: float) -> list[int]:
    """Frames that become nodes: about ``spacing`` apart, those on either side of a break, and the last one.

    The first frame of each interval of a fixed division of time: most are the same from estimate to estimate.

    Args:
        times: ``(N,)`` increasing, of frames, seconds.
        worlds: ``(N,)`` number of the world of each.
        spacing: seconds.

    Returns:
        Their positions, increasing.
    """
    chosen: list[int] = []
    for k, time in enumerate(times.tolist()):
        edge = k == len(times) - 1 or worlds[k + 1] != worlds[k] or times[k + 1] - time > 2 * spacing
        begins = k == 0 or worlds[k - 1] != worlds[k] or time - times[k - 1] > 2 * spacing
        if begins or edge or int(time / spacing + 1e-6) != int(times[k - 1] / spacing + 1e-6):
            chosen.append(k)
    return chosen


@dataclass(frozen=True)
class SmootherOptions:
    """Noise of the visual trajectory, and what is known before.

    Attributes:
        rotation_sigma: white noise of visual orientations, rad.
        rotation_walk: their drift in a second, rad.
        position_sigma, position_walk: noise of visual displacements: of their ends, and of a second, in depths of the
            scene.
        scale_walk: drift of the scale in a second, relative; of a window that samples do not lead.
        rotation_factor, position_factor, scale_factor: of the noise of these.
        extrinsic_sigma: of the rotation between sensor and camera, rad.
        offset_sigma: of the time offset, seconds.
        iterations: of Gauss-Newton, at most, but for steps that are taken back.
    """

    rotation_sigma: float = 4e-4
    rotation_walk: float = 2e-3
    position_sigma: float = 3e-4
    position_walk: float = 1.5e-3
    scale_walk: float = 2e-2
    rotation_factor: float = 1.0
    position_factor: float = 1.0
    scale_factor: float = 1.0
    extrinsic_sigma: float = 5e-3
    offset_sigma: float = 2e-2
    iterations: int = 12

    def variances(self, span: float | Array, depth: float | Array) -> tuple[float | Array, float | Array]:
        """Variances of what the images tell of a motion, on each axis.

        Args:
            span: between the two poses, seconds.
            depth: of the scene, in any unit.

        Returns:
            Of the rotation, rad^2, and of the displacement, squared units of the depth.
        """
        turn = self.rotation_walk**2 * span + 2 * self.rotation_sigma**2
        move = self.position_walk**2 * span + 2 * self.position_sigma**2
        return self.rotation_factor**2 * turn, (self.position_factor * depth) ** 2 * move


@dataclass(frozen=True)
class Similarities:
    """Similarities from the world of each segment, near its newest node, to the common one.

    ``x = scale A x_segment + translation``.

    Attributes:
        log_scale: ``(S,)`` of metres in a unit of the segment.
        rotation: ``(S, 3, 3)``.
        translation: ``(S, 3)`` metres.
    """

    log_scale: Array
    rotation: Array
    translation: Array


@dataclass(frozen=True)
class Smoothed:
    """Estimate of all nodes.

    Attributes:
        times: ``(N,)`` of the nodes, clock of the camera.
        segment: ``(N,)`` of the nodes.
        rotation: ``(N, 3, 3)`` body to world.
        position, velocity: ``(N, 3)`` of the body, metres and m/s.
        gyro_bias, accel_bias: ``(N, 3)``.
        log_scale: ``(N,)`` of metres in a unit of the segment, at each node.
        worlds: of the segments.
        time_offset: seconds to add to a time of the camera for that of the sensor.
        rotation_camera_imu: ``(3, 3)``.
        lever: ``(3,)`` centre of the camera in the coordinates of the sensor, metres.
        depth: usual depth of the scene of the newest segment, metres.
        covariance: ``(19 + m, 19 + m)`` of the newest node (rotation, position, velocity, biases, drift) and the shared
            unknowns (time offset, extrinsic rotation, and log scale and rotation of each segment).
        cost: half of the sum of squares.
        inertial_error: mean squared whitened residual of the preintegrated motion.
        visual_error: ``(3,)`` sum of squared whitened residuals of visual orientations with their drift, of visual
            displacements, and of the drift of the scale, over its expectation: 1 if the noise is that of the options,
            and of an estimate that goes on from another one.
        past: of the node :data:`RECENT` seconds before the newest, in the newest segment; None where there is none.
    """

    times: Array
    segment: Array
    rotation: Array
    position: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array
    log_scale: Array
    worlds: Similarities
    time_offset: float
    rotation_camera_imu: Array
    lever: Array
    depth: float
    covariance: Array
    cost: float
    inertial_error: float
    visual_error: Array
    past: Past | None = None

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale at the newest node, relative."""
        part = self.covariance[np.ix_([NODE - 1, -4], [NODE - 1, -4])]
        return float(np.sqrt(part.sum()))

    @property
    def segment_sigmas(self) -> Array:
        """``(S,)`` relative standard deviations of the scale at the first node of each segment."""
        return np.sqrt(np.diag(self.covariance)[NODE + _SEGMENT :: 4])

    @property
    def gravity_sigma(self) -> float:
        """Standard deviation of the vertical at the newest node, degrees."""
        turned = self.rotation[-1] @ self.covariance[:3, :3] @ self.rotation[-1].T
        return float(np.rad2deg(np.sqrt(turned[0, 0] + turned[1, 1])))

    @property
    def force_variance(self) -> Array:
        """``(3,)`` variances of the acceleration at the newest node, in the axes of the sensor, (m/s^2)^2.

        What is not known of the vertical acts as a bias of the accelerometer.
        """
        by = np.zeros((3, len(self.covariance)))
        by[:, 12:STATE], by[:, :3] = np.eye(3), -skew(self.rotation[-1].T @ GRAVITY)
        return ((by @ self.covariance) * by).sum(1)


@dataclass
class Values:
    """Present values of all unknowns."""

    rotation: Array
    position: Array
    velocity: Array
    bias: Array  # (N, 6)
    drift: Array  # (N, 4) of the visual orientation (rad, axes of the world) and of the log scale
    offset: float
    extrinsic: Array  # (3,) rotation vector after the given rotation
    log_scale: Array
    world: Array

    def scales(self, segment: Array) -> Array:
        """``(N,)`` log scale of each node."""
        return self.log_scale[segment] + self.drift[:, 3]

    def part(self, rows: slice) -> Values:
        """Those of some nodes."""
        return replace(
            self, rotation=self.rotation[rows], position=self.position[rows], velocity=self.velocity[rows],
            bias=self.bias[rows], drift=self.drift[rows],
        )  # fmt: skip


@dataclass(frozen=True)
class Past:
    """What the measurements up to a node tell of it and of the shared unknowns: normal equations about some values.

    Attributes:
        time: of the node, seconds.
        values: of this node alone, and the shared ones.
        information, right: ``(19 + m, 19 + m)`` and ``(19 + m,)``.
        worlds: of the segments; the node is of the last one.
        holds: heading and position of the node that is held are in it.
    """

    time: float
    values: Values
    information: Array
    right: Array
    worlds: Similarities
    holds: bool


@dataclass
class Smoother:
    """Problem of some nodes; :func:`smooth` solves it.

    Attributes:
        nodes: visual poses.
        samples: of the sensor, on its own clock; they cover the times of the nodes.
        noise: of the sensor.
        rotation_camera_imu: ``(3, 3)`` sensor to camera.
        lever: ``(3,)`` centre of the camera in the coordinates of the sensor, metres.
        options: noise of the rest.
        gyro_bias, accel_bias: ``(3,)`` known before.
        offset: time offset known before, seconds.
        held: node whose heading and position are held, as the samples do not tell them.
        past: of the first node; None: there is nothing before it.
        unit_held: samples hold the unit of the window, which does not drift faster where the camera turns far from the
            scene; nor are its displacements worse there.
    """

    nodes: VisualNodes
    samples: InertialSamples
    noise: ImuNoise
    rotation_camera_imu: Array
    lever: Array
    options: SmootherOptions = field(default_factory=SmootherOptions)
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    accel_bias: Array = field(default_factory=lambda: np.zeros(3))
    offset: float = 0.0
    held: int = 0
    past: Past | None = None
    unit_held: bool = False
    _turned: tuple[VisualNodes, Array] | None = field(default=None, init=False, repr=False)

    @property
    def segments(self) -> int:
        """Number of segments."""
        return int(self.nodes.segment[-1]) + 1

    @property
    def angular_rate(self) -> Array:
        """``(N - 1,)`` mean between nodes, rad/s."""
        if self._turned is None or self._turned[0] is not self.nodes:
            times, stamps = self.nodes.times + self.offset, self.samples.timestamps
            rate = np.linalg.norm(self.samples.gyro - self.gyro_bias, axis=1)
            turned = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(stamps))])
            self._turned = self.nodes, np.diff(np.interp(times, stamps, turned)) / np.diff(times)
        return self._turned[1]

    @property
    def haste(self) -> Array:
        """``(N - 1,)`` factors of the noise of images between nodes, by the angular rate there."""
        return 1 + (self.angular_rate / HASTE) ** 2

    @property
    def depth(self) -> Array:
        """``(N - 1,)`` of the scene between nodes; the median of the segment where samples hold the unit."""
        nodes = self.nodes
        found = np.maximum(nodes.depth[:-1], nodes.depth[1:])
        for segment in np.unique(nodes.segment) if self.unit_held else ():
            found[nodes.segment[:-1] == segment] = np.median(nodes.depth[nodes.segment == segment])
        return found

    @property
    def unit_drift(self) -> Array:
        """``(N - 1,)`` factors of the drift of the unit of the images between nodes."""
        if self.unit_held:
            return self.haste
        moved = np.linalg.norm(np.diff(self.nodes.position, axis=0), axis=1)
        parallax = moved / (self.depth * np.diff(self.nodes.times))
        lost = self.angular_rate / (CARRIED * np.maximum(parallax, LEAST_PARALLAX))
        return self.haste * np.minimum(1 + lost**2, MOST_CARRIED)

    def preintegrated(self, values: Values) -> Preintegration:
        """Samples between the nodes, with the present biases and time offset."""
        bias = values.bias[:-1]
        return preintegrate(self.samples, self.nodes.times + values.offset, bias[:, :3], bias[:, 3:], self.noise)

    def rates(self, values: Values) -> Array:
        """``(N, 3)`` angular rates at the nodes, rad/s."""
        times = self.nodes.times + values.offset
        columns = [np.interp(times, self.samples.timestamps, self.samples.gyro[:, axis]) for axis in range(3)]
        return np.stack(columns, -1) - values.bias[:, :3]

    def accelerations(self, values: Values) -> Array:
        """``(N, 3)`` accelerations in the world at the nodes, m/s^2."""
        times = self.nodes.times + values.offset
        columns = [np.interp(times, self.samples.timestamps, self.samples.accel[:, axis]) for axis in range(3)]
        return _apply(values.rotation, np.stack(columns, -1) - values.bias[:, 3:]) + GRAVITY


def _moved(problem: Smoother, values: Values, states: Array, shared: Array) -> Values:
    """Values after a step. A node with another time offset is a state at another time."""
    by_segment, late = shared[_SEGMENT:].reshape(-1, 4), float(shared[_TIME])
    rates, speeding = problem.rates(values), problem.accelerations(values)
    return Values(
        values.rotation @ so3_exp(states[:, :3]) @ so3_exp(rates * late),
        values.position + states[:, 3:6] + values.velocity * late,
        values.velocity + states[:, 6:9] + speeding * late,
        values.bias + states[:, 9:STATE], values.drift + states[:, STATE:], values.offset + late,
        values.extrinsic + shared[_EXTRINSIC],
        values.log_scale + by_segment[:, 0], so3_exp(by_segment[:, 1:4]) @ values.world,
    )  # fmt: skip


def first_values(problem: Smoother, worlds: Similarities) -> Values:
    """Values of visual poses in given worlds.

    Args:
        problem: nodes and samples.
        worlds: similarity of each segment.

    Returns:
        Values to begin with; velocities are differences of positions.
    """
    nodes, segment = problem.nodes, problem.nodes.segment
    world = worlds.rotation[segment]
    rotation = world @ nodes.rotation @ problem.rotation_camera_imu
    camera = np.exp(worlds.log_scale[segment])[:, None] * _apply(world, nodes.position) + worlds.translation[segment]
    position = camera - _apply(rotation, np.broadcast_to(problem.lever, camera.shape))
    velocity = np.zeros_like(position)
    for k in range(problem.segments):
        mine = segment == k
        if mine.sum() > 1:
            velocity[mine] = np.gradient(position[mine], nodes.times[mine], axis=0)
    bias = np.tile(np.concatenate([problem.gyro_bias, problem.accel_bias]), (len(nodes), 1))
    return Values(
        rotation, position, velocity, bias, np.zeros((len(nodes), 4)), problem.offset, np.zeros(3),
        worlds.log_scale.copy(), worlds.rotation.copy(),
    )  # fmt: skip


def linear_start(problem: Smoother) -> tuple[float, Array, Array]:
    """Scale, gravity and gyroscope bias of one segment by linear least squares (Mur-Artal and Tardos, 2017, IV).

    Args:
        problem: nodes of one segment.

    Returns:
        Metres in a unit, not positive if the motion does not tell; ``(3,)`` gravity in the world of the segment, not
        normalised; ``(3,)`` gyroscope bias.
    """
    nodes = problem.nodes
    body = nodes.rotation @ problem.rotation_camera_imu
    start = Values(
        body, nodes.position, nodes.position, np.zeros((len(nodes), 6)), np.zeros((len(nodes), 4)), problem.offset,
        np.zeros(3), np.zeros(1), np.eye(3)[None],
    )  # fmt: skip
    bias = problem.gyro_bias
    for _ in range(2):
        start.bias[:, :3] = bias
        motion = problem.preintegrated(start)
        off = rotation_vector(_turn(motion.rotation) @ _turn(body[:-1]) @ body[1:])
        jacobian = motion.rotation_by_gyro
        bias = bias + np.linalg.lstsq(jacobian.reshape(-1, 3), off.reshape(-1), rcond=None)[0]
    start.bias[:, :3], start.bias[:, 3:] = bias, problem.accel_bias
    motion = problem.preintegrated(start)
    span = motion.duration[:, None]
    arm = _apply(body, np.broadcast_to(problem.lever, nodes.position.shape))

    def bend(path: Array) -> Array:
        speed = np.diff(path, axis=0) / span
        return speed[1:] - speed[:-1]

    turned = _apply(body[:-1], motion.position) / span
    right = _apply(body[:-2], motion.velocity[:-1]) + turned[1:] - turned[:-1] + bend(arm)
    half = 0.5 * (span[1:] + span[:-1])
    design = np.concatenate([bend(nodes.position)[..., None], -half[..., None] * np.eye(3)], -1)
    found = np.linalg.lstsq(design.reshape(-1, 4), right.reshape(-1), rcond=None)[0]
    return float(found[0]), found[1:], bias


def acceleration_sign(problem: Smoother) -> float:
    """Correlation of the accelerations of the samples with those of the images, which have the sign of the scale.

    The linear solution for the scale as in :func:`linear_start`, with further unknowns that could turn its sign around:
    lever arm and bias of the accelerometer, and the gravity of each stretch of some seconds. Within a stretch the
    gyroscope tells the orientations: a visual one that is wrong comes with a wrong place, and with a part of gravity.

    Args:
        problem: nodes of one segment.

    Returns:
        -1 to 1 of what these unknowns leave; 0 if the sign is not sure.
    """
    stretches = _stretches(problem.nodes.times)
    blocks, rights = [], []
    for number, chosen in enumerate(stretches):
        times, position = problem.nodes.times[chosen], problem.nodes.position[chosen]
        motion = preintegrate(
            problem.samples, times + problem.offset, problem.gyro_bias, problem.accel_bias, problem.noise
        )
        if not motion.covered.all():
            continue
        body = np.stack(list(accumulate(motion.rotation, np.matmul, initial=np.eye(3))))
        seen = problem.nodes.rotation[chosen] @ problem.rotation_camera_imu
        left, _, right = np.linalg.svd(np.einsum("nij,nkj->ik", seen, body))
        body = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right @ body
        span = motion.duration[:, None, None]
        columns = [position[..., None], -body]  # of scale and lever arm
        bent = [np.diff(np.diff(path, axis=0) / span, axis=0) for path in columns]
        moved = [motion.position[..., None], -motion.position_by_accel]
        faster = [motion.velocity[..., None], -motion.velocity_by_accel]
        force, bias = (
            body[:-2] @ v[:-1] + np.diff(body[:-1] @ p / span, axis=0) for v, p in zip(faster, moved, strict=True)
        )
        gravity = np.zeros((len(force), 3, 3 * len(stretches)))
        gravity[..., 3 * number : 3 * number + 3] = -0.5 * (span[1:] + span[:-1]) * np.eye(3)
        blocks.append(np.concatenate([*bent, bias, gravity], -1).reshape(-1, gravity.shape[-1] + 7))
        rights.append(force.reshape(-1))
    if not blocks:
        return 0.0
    design, right = np.concatenate(blocks), np.concatenate(rights)
    others = np.linalg.qr(design[:, 1:][:, design[:, 1:].any(0)])[0]
    images, forces = (column - others @ (others.T @ column) for column in (design[:, 0], right))
    size = float(np.linalg.norm(images) * np.linalg.norm(forces))
    correlation = float(images @ forces) / size if size > 0 else 0.0
    freedom = len(right) - others.shape[1] - 1
    is_sure = correlation**2 * freedom > _SURE**2 * (1 - correlation**2)
    return correlation if is_sure else 0.0


def _stretches(times: Array) -> list[Array]:
    """Indices of times some tenths of a second apart, in stretches of some seconds."""
    found = [[0]]
    for k in range(1, len(times)):
        since = times[k] - times[found[-1][-1]]
        if since > 3 * _STEP or times[k] - times[found[-1][0]] > _STRETCH:
            found.append([k])
        elif since > _STEP - 1e-6:
            found[-1].append(k)
    return [np.array(one) for one in found if len(one) >= 8]


def upright(gravity: Array) -> Array:
    """Rotation of least angle that turns a direction of gravity to that of the world.

    Args:
        gravity: ``(3,)`` of any length.

    Returns:
        ``(3, 3)``.
    """
    down, wanted = gravity / np.linalg.norm(gravity), GRAVITY / np.linalg.norm(GRAVITY)
    axis, cosine = np.cross(down, wanted), float(down @ wanted)
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = skew(axis)
    return np.eye(3) + k + k @ k / (1 + cosine)


def smooth(problem: Smoother, start: Values) -> Smoothed:
    """Gauss-Newton with damping from a start.

    Args:
        problem: nodes and samples.
        start: values to begin with (:func:`first_values`).

    Returns:
        The solution.

    Raises:
        numpy.linalg.LinAlgError: the equations are singular.
    """
    values, damping, motion, offset = start, 1e-6, problem.preintegrated(start), start.offset
    system, cost, error = _linearise(problem, values, motion)
    iteration = 0
    while iteration < problem.options.iterations:
        step = solve_chain(system, damping)
        moved = _moved(problem, values, step.states, step.shared)
        # Biases are corrected to first order; another time offset asks for other samples.
        again = iteration in (1, 4) or abs(moved.offset - offset) > SHIFT
        motion_then = problem.preintegrated(moved) if again else motion
        further, lower, found = _linearise(problem, moved, motion_then)
        if not np.isfinite(lower) or lower > cost * (1 + 1e-6) + 1e-6:  # a shorter step, which is none more
            damping = max(10 * damping, 1e-4)
            if damping > 1e4:
                break
            continue
        done = cost - lower < 1e-4 * cost + 1e-6
        if again:
            motion, offset = motion_then, moved.offset
        values, system, cost, error, damping = moved, further, lower, found, damping / 10
        iteration += 1
        if done:
            break
    solved, scales = solve_chain(system, pairs=problem.past is None), values.scales(problem.nodes.segment)
    return Smoothed(
        problem.nodes.times, problem.nodes.segment, values.rotation, values.position, values.velocity,
        values.bias[:, :3], values.bias[:, 3:], scales, _worlds(problem, values), values.offset,
        problem.rotation_camera_imu @ so3_exp(values.extrinsic), problem.lever,
        float(np.exp(scales[-1]) * problem.nodes.depth[-1]), solved.covariance, cost, error,
        _visual_error(problem, values, solved), _past(problem, values) if problem.past is None else problem.past,
    )  # fmt: skip


def _past(problem: Smoother, values: Values) -> Past | None:
    """What the nodes tell that are older than the last seconds."""
    nodes = problem.nodes
    recent = np.flatnonzero((nodes.segment == nodes.segment[-1]) & (nodes.times >= nodes.times[-1] - RECENT))
    count = int(recent[0]) + 1
    if count < 2:
        return None
    early, part = replace(problem, nodes=nodes.where(np.arange(len(nodes)) < count)[0]), values.part(slice(count))
    information, right = marginal(_linearise(early, part, early.preintegrated(part))[0])
    newest = values.part(slice(count - 1, count))
    return Past(
        float(nodes.times[count - 1]), newest, information, right, _worlds(problem, values), problem.held < count
    )


def _worlds(problem: Smoother, values: Values) -> Similarities:
    """Similarity of each segment at its newest node; those of segments before the nodes stay."""
    nodes, first = problem.nodes, int(problem.nodes.segment[0])
    last = np.array([np.flatnonzero(nodes.segment == k)[-1] for k in range(first, problem.segments)])
    body = problem.rotation_camera_imu @ so3_exp(values.extrinsic)
    rotation = values.rotation[last] @ _turn(nodes.rotation[last] @ body)
    scales = values.scales(nodes.segment)[last]
    camera = values.position[last] + _apply(values.rotation[last], np.broadcast_to(problem.lever, (len(last), 3)))
    translation = camera - np.exp(scales)[:, None] * _apply(rotation, nodes.position[last])
    if problem.past is None:
        return Similarities(scales, rotation, translation)
    known = problem.past.worlds
    return Similarities(
        np.concatenate([known.log_scale[:first], scales]), np.concatenate([known.rotation[:first], rotation]),
        np.concatenate([known.translation[:first], translation]),
    )  # fmt: skip


def _inverse_right_jacobian(phi: Array) -> Array:
    """``(..., 3, 3)``, series to the second order: residuals are small."""
    k = skew(phi)
    return np.eye(3) + 0.5 * k + (k @ k) / 12


def _turn(a: Array) -> Array:
    return np.swapaxes(a, -1, -2)


def _apply(a: Array, v: Array) -> Array:
    return (a @ v[..., None])[..., 0]


def _linearise(problem: Smoother, values: Values, motion: Preintegration) -> tuple[ChainSystem, float, float]:
    """Normal equations, half of the sum of squares, and mean squared inertial residual."""
    count, segments = len(problem.nodes), problem.segments
    system = ChainSystem.zeros(count, NODE, _SEGMENT + 4 * segments)
    cost, inertial = _add_motion(problem, values, motion, system)
    cost += _add_visual(problem, values, system) + _add_priors(problem, values, system)
    return system, cost, inertial


def motion_factors(
    motion: Preintegration, rotation: Array, position: Array, velocity: Array, bias: Array
) -> tuple[Array, Array, Array, Array]:
    """Residuals of preintegrated motion between consecutive states (Forster et al., 2017, eq. 45).

    Args:
        motion: ``K`` intervals.
        rotation, position, velocity, bias: ``(K + 1, ...)`` body to world, metres, m/s, biases of both sensors; those
            of the motion are near.

    Returns:
        Residuals ``(K, 9)`` of rotation, velocity and position, their Jacobians ``(K, 9, 15)`` by the state before and
        after, and their covariance ``(K, 9, 9)``.
    """
    first, second = rotation[:-1], rotation[1:]
    turned, sped, moved = motion.corrected(bias[:-1, :3], bias[:-1, 3:])
    span = motion.duration[:, None]
    back = _turn(first)
    by_velocity = _apply(back, velocity[1:] - velocity[:-1] - GRAVITY * span)
    by_position = _apply(back, position[1:] - position[:-1] - velocity[:-1] * span - 0.5 * GRAVITY * span**2)
    turn = rotation_vector(_turn(turned) @ back @ second)
    residual = np.concatenate([turn, by_velocity - sped, by_position - moved], -1)
    before, after = np.zeros((2, len(span), 9, STATE))
    right = _inverse_right_jacobian(turn)
    before[:, :3, :3] = -right @ _turn(second) @ first
    after[:, :3, :3] = right
    before[:, :3, 9:12] = -right @ _turn(so3_exp(turn)) @ motion.rotation_by_gyro
    before[:, 3:6, :3], before[:, 6:, :3] = skew(by_velocity), skew(by_position)
    before[:, 3:6, 6:9], after[:, 3:6, 6:9] = -back, back
    before[:, 6:, 3:6], after[:, 6:, 3:6] = -back, back
    before[:, 6:, 6:9] = -back * span[..., None]
    before[:, 3:6, 9:12], before[:, 3:6, 12:] = -motion.velocity_by_gyro, -motion.velocity_by_accel
    before[:, 6:, 9:12], before[:, 6:, 12:] = -motion.position_by_gyro, -motion.position_by_accel
    covariance = np.where(motion.covered[:, None, None], motion.covariance, _UNKNOWN * np.eye(9))
    return residual, before, after, covariance


def _add_motion(problem: Smoother, values: Values, motion: Preintegration, system: ChainSystem) -> tuple[float, float]:
    """Preintegrated samples between consecutive nodes, and walks of the biases."""
    noise, states = problem.noise, (values.rotation, values.position, values.velocity, values.bias)
    residual, before, after, covariance = motion_factors(motion, *states)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    residual, before, after = _apply(root, residual), root @ before, root @ after
    _add_pairs(system, residual, before, after)
    cost = float((residual**2).sum())
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3) * np.sqrt(motion.duration)[:, None]
    drift = _add_walk(system, values.bias, walk, 9)
    return 0.5 * (cost + float((drift**2).sum())), cost / residual.size


def _add_pairs(
    system: ChainSystem, residual: Array, before: Array, after: Array, first: int = 0, shared: Array | None = None
) -> None:
    """Add residuals of consecutive nodes, by their unknowns from ``first`` on and by the shared ones."""
    mine = slice(first, first + before.shape[-1])
    system.diagonal[:-1, mine, mine] += _turn(before) @ before
    system.diagonal[1:, mine, mine] += _turn(after) @ after
    system.upper[:, mine, mine] += _turn(before) @ after
    system.right[:-1, mine] -= _apply(_turn(before), residual)
    system.right[1:, mine] -= _apply(_turn(after), residual)
    if shared is not None:
        system.border[:-1, mine] += _turn(before) @ shared
        system.border[1:, mine] += _turn(after) @ shared
        system.shared += (_turn(shared) @ shared).sum(0)
        system.right_shared -= _apply(_turn(shared), residual).sum(0)


def _add_walk(system: ChainSystem, values: Array, sigma: Array, first: int) -> Array:
    """Add a random walk of unknowns ``(N, D)``, deviations ``(N - 1, D)``; its whitened residuals."""
    residual = (values[1:] - values[:-1]) / sigma
    step = np.zeros((*sigma.shape, sigma.shape[1]))
    index = np.arange(sigma.shape[1])
    step[:, index, index] = 1 / sigma
    _add_pairs(system, residual, -step, step, first)
    return residual


def _robust(residual: Array) -> tuple[Array, float]:
    """Square roots ``(K, 1)`` of Cauchy's weights, so that single wrong poses count less, and the cost."""
    squares = (residual**2).sum(-1)
    return np.sqrt(1 / (1 + squares / WIDTH**2))[:, None], float(0.5 * WIDTH**2 * np.log1p(squares / WIDTH**2).sum())


@dataclass(frozen=True)
class _Residuals:
    """Whitened residuals of ``K`` measurements by the unknowns of a node, of the one after it, and the shared ones."""

    residual: Array  # (K, 3)
    weight: Array  # (K, 1) roots of the robust weights
    before: Array  # (K, 3, NODE)
    after: Array  # (K, 3, NODE), zero of a measurement of one node
    shared: Array  # (K, 3, m)

    def weighted(self) -> tuple[Array, Array, Array, Array]:
        """Residuals and Jacobians with the robust weights."""
        weight = self.weight[..., None]
        return self.residual * self.weight, self.before * weight, self.after * weight, self.shared * weight


def _drift_sigma(problem: Smoother) -> Array:
    """``(N - 1, 4)`` deviations of the drift of visual orientation and log scale between nodes."""
    nodes, options = problem.nodes, problem.options
    rotation, scale = options.rotation_walk * options.rotation_factor, options.scale_walk * options.scale_factor
    sigma = np.stack([rotation * problem.haste] * 3 + [scale * problem.unit_drift], -1)
    sigma *= np.sqrt(np.diff(nodes.times))[:, None]
    sigma[nodes.segment[1:] != nodes.segment[:-1]] = _UNKNOWN
    return sigma


def _add_visual(problem: Smoother, values: Values, system: ChainSystem) -> float:
    """Visual orientations and displacements, and their drift; cost."""
    segment = problem.nodes.segment
    begins = np.concatenate([[problem.past is None], segment[1:] != segment[:-1]])
    held, index = np.flatnonzero(begins), np.arange(STATE, NODE)
    system.diagonal[held[:, None], index, index] += _FIXED  # the drift of a segment begins with its first node
    drift = _add_walk(system, values.drift, _drift_sigma(problem), STATE)
    turns, by_turns = _orientations(problem, values)
    residual, states, _, shared = turns.weighted()
    system.diagonal += _turn(states) @ states
    system.border += _turn(states) @ shared
    system.shared += (_turn(shared) @ shared).sum(0)
    system.right -= _apply(_turn(states), residual)
    system.right_shared -= _apply(_turn(shared), residual).sum(0)
    moves, by_moves = _displacements(problem, values)
    residual, before, after, shared = moves.weighted()
    _add_pairs(system, residual, before, after, 0, shared)
    return by_turns + by_moves + 0.5 * float((drift**2).sum())


def _visual_error(problem: Smoother, values: Values, solved: ChainSolution) -> Array:
    """Squared residuals of the images over their expectation (Förstner's estimate of components of variance).

    Each residual is expected to be as large as its noise, less what the solution has adapted to it.
    """
    options, pairs = problem.options, solved.pairs
    inside = problem.nodes.segment[1:] == problem.nodes.segment[:-1]
    if pairs is None or not inside.any():
        return np.ones(3)
    turns, moves = _orientations(problem, values)[0], _displacements(problem, values)[0]
    sigma = _drift_sigma(problem)[inside]
    steps = np.diff(values.drift, axis=0)[inside] / sigma
    by_step = np.zeros((4, pairs.shape[1]))
    by_step[:, STATE:NODE], by_step[:, NODE + STATE : 2 * NODE] = -np.eye(4), np.eye(4)
    drifts = 1 - _spread(np.tile(by_step, (len(steps), 1, 1)), pairs[inside]) / sigma**2
    second = np.s_[NODE : 2 * NODE]
    nodes = np.concatenate([np.delete(np.delete(pairs, second, 1), second, 2), solved.covariance[None]])
    oriented = 1 - _spread(np.concatenate([turns.before, turns.shared], -1), nodes)
    displaced = 1 - _spread(np.concatenate([moves.before, moves.after, moves.shared], -1)[inside], pairs[inside])
    turned, moved, rotation, scale = (
        float(np.minimum((rows**2).sum(1), OUTLIER).sum())
        for rows in (turns.residual, moves.residual[inside], steps[:, :3], steps[:, 3:])
    )
    squares = np.array([turned + rotation, moved, scale])
    expected = np.array([oriented.sum() + drifts[:, :3].sum(), displaced.sum(), drifts[:, 3].sum()])
    usual = np.array([options.rotation_factor, options.position_factor, options.scale_factor]) ** -2.0
    return (squares + USUAL * usual) / (np.maximum(expected, 0) + USUAL)


def _spread(jacobians: Array, covariances: Array) -> Array:
    """Variances ``(K, 3)`` of what depends on unknowns by ``(K, 3, D)``."""
    return ((jacobians @ covariances) * jacobians).sum(-1)


def _orientations(problem: Smoother, values: Values) -> tuple[_Residuals, float]:
    """Orientations of the camera in the world of a segment, and their cost."""
    nodes, options, segment = problem.nodes, problem.options, problem.nodes.segment
    body = problem.rotation_camera_imu @ so3_exp(values.extrinsic)
    turn = rotation_vector(values.rotation @ _turn(values.world[segment] @ nodes.rotation @ body))
    haste = np.maximum(np.append(problem.haste, 1.0), np.insert(problem.haste, 0, 1.0))
    angle = (options.rotation_sigma * options.rotation_factor * haste)[:, None]
    residual = (turn - values.drift[:, :3]) / angle
    if problem.past is not None:
        residual[0] = 0.0  # it has been counted
    robust, cost = _robust(residual)
    if problem.past is not None:
        robust[0] = 0.0
    states = np.zeros((len(nodes), 3, NODE))
    shared = np.zeros((len(nodes), 3, _SEGMENT + 4 * problem.segments))
    states[:, :, :3], states[:, :, STATE : STATE + 3] = values.rotation, -np.eye(3)
    shared[:, :, _TIME] = _apply(values.rotation, problem.rates(values))
    shared[:, :, _EXTRINSIC] = -values.rotation
    for k in range(problem.segments):
        start = _SEGMENT + 4 * k + 1
        shared[segment == k, :, start : start + 3] = -np.eye(3)
    angle = angle[..., None]
    return _Residuals(residual, robust, states / angle, np.zeros_like(states), shared / angle), cost


def _displacements(problem: Smoother, values: Values) -> tuple[_Residuals, float]:
    """Displacements of the camera between nodes of a segment, in the axes of the body at the first, and their cost."""
    nodes, options, segment = problem.nodes, problem.options, problem.nodes.segment
    body = problem.rotation_camera_imu @ so3_exp(values.extrinsic)
    seen = _apply(_turn(nodes.rotation[:-1] @ body), np.diff(nodes.position, axis=0))
    lever, rates = np.broadcast_to(problem.lever, values.position.shape), problem.rates(values)
    camera = values.position + _apply(values.rotation, lever)
    back = _turn(values.rotation[:-1])
    moved = _apply(back, np.diff(camera, axis=0))
    shrunk = np.exp(-values.scales(segment)[:-1])[:, None]
    depth = problem.depth
    sigma = (np.sqrt(options.variances(np.diff(nodes.times), depth)[1]) * problem.haste)[:, None]
    # Images tell a turn and a shift sideways apart by parallax alone: where the visual turn is wrong, so is the shift.
    turned = nodes.rotation @ body
    between = _turn(values.rotation[:-1]) @ values.rotation[1:]
    wrong = rotation_vector(_turn(turned[:-1]) @ turned[1:] @ _turn(between))
    arm = SHIFTED * depth[:, None, None] * skew(body[2])
    residual = (moved * shrunk - seen + _apply(arm, wrong)) / sigma
    across = segment[1:] != segment[:-1]
    residual[across] = 0.0
    robust, cost = _robust(residual)
    robust[across] = 0.0
    before, after = np.zeros((2, len(moved), 3, NODE))
    after[:, :, 3:6], before[:, :, 3:6] = back, -back
    after[:, :, :3] = -back @ values.rotation[1:] @ skew(problem.lever)
    before[:, :, :3] = skew(moved) + skew(problem.lever)
    before[:, :, NODE - 1] = -moved
    arm = arm / shrunk[..., None]
    before[:, :, :3] += arm
    after[:, :, :3] -= arm @ between
    speed = values.velocity + _apply(values.rotation, np.cross(rates, lever))
    shared = np.zeros((len(moved), 3, _SEGMENT + 4 * problem.segments))
    shared[:, :, _TIME] = _apply(back, np.diff(speed, axis=0)) + np.cross(moved, rates[:-1])
    shared[:, :, _TIME] += _apply(arm, rates[:-1] - _apply(between, rates[1:]))
    for k in range(problem.segments):
        mine = segment[:-1] == k
        shared[mine, :, _SEGMENT + 4 * k] = -moved[mine]
    weight = (shrunk / sigma)[..., None]
    return _Residuals(residual, robust, before * weight, after * weight, shared * weight), cost


def _add_priors(problem: Smoother, values: Values, system: ChainSystem) -> float:
    """What is known before of the first node and the shared unknowns; heading and position of one node are held."""
    if 0 <= problem.held < len(problem.nodes):
        index, up = np.arange(3, 6), values.rotation[problem.held][2]
        system.diagonal[problem.held, index, index] += _FIXED
        system.diagonal[problem.held, :3, :3] += _HELD * np.outer(up, up)
    if problem.past is not None:
        return _add_past(problem, problem.past, values, system)
    noise, options = problem.noise, problem.options
    known = np.concatenate([problem.gyro_bias, problem.accel_bias])
    sigma = np.repeat([noise.gyro_bias, noise.accel_bias], 3)
    off = (values.bias[0] - known) / sigma
    index = np.arange(9, STATE)
    system.diagonal[0, index, index] += 1 / sigma**2
    system.right[0, 9:STATE] -= off / sigma
    late = (values.offset - problem.offset) / options.offset_sigma
    tilt = values.extrinsic / options.extrinsic_sigma
    system.shared[_TIME, _TIME] += 1 / options.offset_sigma**2
    system.right_shared[_TIME] -= late / options.offset_sigma
    index = np.arange(1, 4)
    system.shared[index, index] += 1 / options.extrinsic_sigma**2
    system.right_shared[_EXTRINSIC] -= tilt / options.extrinsic_sigma
    # Very weak, so that a scale without any measurement does not run away.
    scales = _SEGMENT + 4 * np.arange(problem.segments)
    system.shared[scales, scales] += 1e-2
    return 0.5 * float((off**2).sum() + late**2 + (tilt**2).sum())


def _add_past(problem: Smoother, past: Past, values: Values, system: ChainSystem) -> float:
    """What the nodes before the first one tell, about the values that they were linearised at."""
    then, late = past.values, values.offset - past.values.offset
    # A node with another time offset is a state at another time (:func:`_moved`), which is no change of it.
    states = np.concatenate(
        [
            rotation_vector(then.rotation[0].T @ values.rotation[0]) - problem.rates(values)[0] * late,
            values.position[0] - then.position[0] - values.velocity[0] * late,
            values.velocity[0] - then.velocity[0] - problem.accelerations(values)[0] * late,
            values.bias[0] - then.bias[0],
            values.drift[0] - then.drift[0],
        ]
    )
    turned = rotation_vector(values.world @ _turn(then.world))
    worlds = np.concatenate([(values.log_scale - then.log_scale)[:, None], turned], 1)
    change = np.concatenate([states, [late], values.extrinsic - then.extrinsic, worlds.ravel()])
    right = past.right - past.information @ change
    system.diagonal[0] += past.information[:NODE, :NODE]
    system.border[0] += past.information[:NODE, NODE:]
    system.shared += past.information[NODE:, NODE:]
    system.right[0] += right[:NODE]
    system.right_shared += right[NODE:]
    return -0.5 * float(change @ (past.right + right))
