"""Metric trajectory from a visual one and inertial samples: maximum a posteriori of a chain of body states.

The visual trajectory of each segment is known up to a similarity, with white noise. Unknown are, at nodes a fraction of
a second apart, orientation, position, velocity and biases of the sensor in a world whose z axis points up; and, for all
nodes, the similarity of each segment, the time offset, and the rotation between sensor and camera. Preintegrated
samples tie consecutive nodes (Forster et al., 2017, eq. 45), also across an interval without images, so that a segment
after it is joined to the one before. With the visual trajectory held, this is the inertial-only estimation of ORB-SLAM3
(Campos et al., 2021, III-D), with the noise of the visual poses in it.

Errors: ``R_wb = R Exp(phi)`` and additive positions, velocities and biases, as in that paper; ``A <- Exp(alpha) A`` of
the rotation of a segment's world.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import rotation_vector, skew, so3_exp
from dvo.odometry.inertial.chain import ChainSystem, solve_chain
from dvo.odometry.inertial.preintegration import Preintegration, preintegrate

Array = np.ndarray
GRAVITY = np.array([0.0, 0.0, -9.81])
"""Acceleration of a falling body in the world, m/s^2; z is up."""
STATE = 15
"""Unknowns of a node: rotation, position, velocity, gyroscope and accelerometer bias."""
_TIME, _EXTRINSIC, _SEGMENT = 0, slice(1, 4), 4  # unknowns that all nodes share; 7 for each segment after them
SHIFT = 5e-4
"""Change of the time offset, seconds, after which samples are integrated anew."""
_FIXED = 1e18  # information of an unknown that is held
_UNKNOWN = 1e12  # variance of a motion without samples


@dataclass(frozen=True)
class VisualNodes:
    """Visual poses that take part.

    Attributes:
        times: ``(N,)`` increasing, seconds, clock of the camera.
        segment: ``(N,)`` numbers from 0, increasing, each with a world and a unit of its own.
        rotation: ``(N, 3, 3)`` camera to world of the segment.
        position: ``(N, 3)`` of the camera, units of the segment.
        depth: ``(S,)`` usual depth of the scene of each segment, units of the segment.
    """

    times: Array
    segment: Array
    rotation: Array
    position: Array
    depth: Array

    def __len__(self) -> int:
        return len(self.times)

    def after(self, time: float) -> VisualNodes:
        """Nodes later than a time."""
        keep = self.times > time
        return replace(
            self, times=self.times[keep], segment=self.segment[keep], rotation=self.rotation[keep],
            position=self.position[keep],
        )  # fmt: skip


@dataclass(frozen=True)
class SmootherOptions:
    """Noise of the visual trajectory, and what is known before.

    Attributes:
        rotation_sigma: of visual orientations, rad.
        position_sigma: of visual positions, in depths of the scene.
        extrinsic_sigma: of the rotation between sensor and camera, rad.
        offset_sigma: of the time offset, seconds.
        iterations: of Gauss-Newton, at most.
    """

    rotation_sigma: float = 2e-3
    position_sigma: float = 1e-3
    extrinsic_sigma: float = 5e-3
    offset_sigma: float = 2e-2
    iterations: int = 12


@dataclass(frozen=True)
class Similarities:
    """Similarities from the world of each segment to the common one: ``x = scale A x_segment + translation``.

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
        rotation: ``(N, 3, 3)`` body to world.
        position, velocity: ``(N, 3)`` of the body, metres and m/s.
        gyro_bias, accel_bias: ``(N, 3)``.
        worlds: of the segments.
        time_offset: seconds to add to a time of the camera for that of the sensor.
        rotation_camera_imu: ``(3, 3)``.
        covariance: ``(15 + m, 15 + m)`` of the newest node (rotation, position, velocity, biases) and the shared
            unknowns (time offset, extrinsic rotation, and log scale, rotation, translation of each segment).
        cost: half of the sum of squares.
        inertial_error: mean squared whitened residual of the preintegrated motion.
        visual_error: ``(2,)`` mean squared whitened residual of visual orientations and positions.
    """

    times: Array
    rotation: Array
    position: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array
    worlds: Similarities
    time_offset: float
    rotation_camera_imu: Array
    covariance: Array
    cost: float
    inertial_error: float
    visual_error: Array

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale of the newest segment, relative."""
        return float(np.sqrt(self.covariance[-7, -7]))

    @property
    def gravity_sigma(self) -> float:
        """Standard deviation of the vertical in the newest segment, degrees."""
        return float(np.rad2deg(np.sqrt(self.covariance[-6, -6] + self.covariance[-5, -5])))


@dataclass
class Values:
    """Present values of all unknowns."""

    rotation: Array
    position: Array
    velocity: Array
    bias: Array  # (N, 6)
    offset: float
    extrinsic: Array  # (3,) rotation vector after the given rotation
    log_scale: Array
    world: Array
    translation: Array


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

    @property
    def segments(self) -> int:
        """Number of segments."""
        return int(self.nodes.segment[-1]) + 1

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
    by_segment, late = shared[_SEGMENT:].reshape(-1, 7), float(shared[_TIME])
    rates, speeding = problem.rates(values), problem.accelerations(values)
    return Values(
        values.rotation @ so3_exp(states[:, :3]) @ so3_exp(rates * late),
        values.position + states[:, 3:6] + values.velocity * late,
        values.velocity + states[:, 6:9] + speeding * late,
        values.bias + states[:, 9:], values.offset + late, values.extrinsic + shared[_EXTRINSIC],
        values.log_scale + by_segment[:, 0], so3_exp(by_segment[:, 1:4]) @ values.world,
        values.translation + by_segment[:, 4:],
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
        rotation, position, velocity, bias, problem.offset, np.zeros(3), worlds.log_scale.copy(),
        worlds.rotation.copy(), worlds.translation.copy(),
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
        body, nodes.position, nodes.position, np.zeros((len(nodes), 6)), problem.offset, np.zeros(3), np.zeros(1),
        np.eye(3)[None], np.zeros((1, 3)),
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
    system, cost, errors = _linearise(problem, values, motion)
    for iteration in range(problem.options.iterations):
        step = solve_chain(system, damping)
        moved = _moved(problem, values, step.states, step.shared)
        # Biases are corrected to first order; another time offset asks for other samples.
        again = iteration in (1, 4) or abs(moved.offset - offset) > SHIFT
        motion_then = problem.preintegrated(moved) if again else motion
        further, lower, found = _linearise(problem, moved, motion_then)
        if not np.isfinite(lower) or lower > cost * (1 + 1e-6) + 1e-6:
            damping = max(10 * damping, 1e-4)
            if damping > 1e4:
                break
            continue
        done = cost - lower < 1e-4 * cost + 1e-6
        if again:
            motion, offset = motion_then, moved.offset
        values, system, cost, errors, damping = moved, further, lower, found, damping / 10
        if done:
            break
    covariance = solve_chain(system).covariance
    return Smoothed(
        problem.nodes.times, values.rotation, values.position, values.velocity, values.bias[:, :3], values.bias[:, 3:],
        Similarities(values.log_scale, values.world, values.translation), values.offset,
        problem.rotation_camera_imu @ so3_exp(values.extrinsic), covariance, cost, *errors,
    )  # fmt: skip


def _inverse_right_jacobian(phi: Array) -> Array:
    """``(..., 3, 3)``, series to the second order: residuals are small."""
    k = skew(phi)
    return np.eye(3) + 0.5 * k + (k @ k) / 12


def _turn(a: Array) -> Array:
    return np.swapaxes(a, -1, -2)


def _apply(a: Array, v: Array) -> Array:
    return (a @ v[..., None])[..., 0]


def _linearise(
    problem: Smoother, values: Values, motion: Preintegration
) -> tuple[ChainSystem, float, tuple[float, Array]]:
    """Normal equations, half of the sum of squares, and mean squared inertial and visual residual."""
    count, segments = len(problem.nodes), problem.segments
    system = ChainSystem.zeros(count, STATE, _SEGMENT + 7 * segments)
    cost, inertial = _add_motion(problem, values, motion, system)
    more, visual = _add_visual(problem, values, system)
    return system, cost + more + _add_priors(problem, values, system), (inertial, visual)


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
    drift = (values.bias[1:] - values.bias[:-1]) / walk
    before, after = np.zeros((2, len(walk), 6, STATE))
    index = np.arange(6)
    before[:, index, 9 + index], after[:, index, 9 + index] = -1 / walk, 1 / walk
    _add_pairs(system, drift, before, after)
    return 0.5 * (cost + float((drift**2).sum())), cost / residual.size


def _add_pairs(system: ChainSystem, residual: Array, before: Array, after: Array) -> None:
    system.diagonal[:-1] += _turn(before) @ before
    system.diagonal[1:] += _turn(after) @ after
    system.upper += _turn(before) @ after
    system.right[:-1] -= _apply(_turn(before), residual)
    system.right[1:] -= _apply(_turn(after), residual)


def _add_visual(problem: Smoother, values: Values, system: ChainSystem) -> tuple[float, Array]:
    """Visual poses, through the similarity of their segment."""
    nodes, options, segment = problem.nodes, problem.options, problem.nodes.segment
    count = len(nodes)
    world, scale = values.world[segment], np.exp(values.log_scale[segment])[:, None]
    body = problem.rotation_camera_imu @ so3_exp(values.extrinsic)
    rates = problem.rates(values)
    turn = rotation_vector(_turn(world @ nodes.rotation @ body) @ values.rotation)
    arm = _apply(values.rotation, np.broadcast_to(problem.lever, (count, 3)))
    place = values.position + arm - values.translation[segment]
    back = _turn(world)
    seen = _apply(back, place) / scale
    sigma = options.position_sigma * nodes.depth[segment][:, None]
    residual = np.concatenate([turn / options.rotation_sigma, (seen - nodes.position) / sigma], -1)
    states = np.zeros((count, 6, STATE))
    shared = np.zeros((count, 6, _SEGMENT + 7 * problem.segments))
    back_body = _turn(values.rotation)
    states[:, :3, :3] = np.eye(3)
    shared[:, :3, _TIME] = rates
    shared[:, :3, _EXTRINSIC] = -np.eye(3)
    states[:, 3:, 3:6] = back / scale[..., None]
    states[:, 3:, :3] = -back @ values.rotation @ skew(problem.lever) / scale[..., None]
    speed = values.velocity + _apply(values.rotation, np.cross(rates, problem.lever))
    shared[:, 3:, _TIME] = _apply(back, speed) / scale
    for k in range(problem.segments):
        mine, start = segment == k, _SEGMENT + 7 * k
        shared[mine, 3:, start] = -seen[mine]
        shared[mine, :3, start + 1 : start + 4] = -back_body[mine]
        shared[mine, 3:, start + 1 : start + 4] = back[mine] @ skew(place[mine]) / scale[mine][..., None]
        shared[mine, 3:, start + 4 : start + 7] = -back[mine] / scale[mine][..., None]
    weight = np.concatenate([np.full((count, 3), 1 / options.rotation_sigma), np.repeat(1 / sigma, 3, 1)], 1)[..., None]
    states, shared = states * weight, shared * weight
    # Cauchy's weights, so that single wrong poses count less.
    squares = (residual**2).sum(-1)
    robust = np.sqrt(1 / (1 + squares / 36))[:, None]
    residual, states, shared = residual * robust, states * robust[..., None], shared * robust[..., None]
    system.diagonal += _turn(states) @ states
    system.border += _turn(states) @ shared
    system.shared += (_turn(shared) @ shared).sum(0)
    system.right -= _apply(_turn(states), residual)
    system.right_shared -= _apply(_turn(shared), residual).sum(0)
    return float(18 * np.log1p(squares / 36).sum()), np.array(
        [(residual[:, :3] ** 2).mean(), (residual[:, 3:] ** 2).mean()]
    )


def _add_priors(problem: Smoother, values: Values, system: ChainSystem) -> float:
    """Biases of the first node, time offset, extrinsic rotation; heading and origin of the first segment are held."""
    noise, options = problem.noise, problem.options
    known = np.concatenate([problem.gyro_bias, problem.accel_bias])
    sigma = np.repeat([noise.gyro_bias, noise.accel_bias], 3)
    off = (values.bias[0] - known) / sigma
    index = np.arange(9, STATE)
    system.diagonal[0, index, index] += 1 / sigma**2
    system.right[0, 9:] -= off / sigma
    late = (values.offset - problem.offset) / options.offset_sigma
    tilt = values.extrinsic / options.extrinsic_sigma
    system.shared[_TIME, _TIME] += 1 / options.offset_sigma**2
    system.right_shared[_TIME] -= late / options.offset_sigma
    index = np.arange(1, 4)
    system.shared[index, index] += 1 / options.extrinsic_sigma**2
    system.right_shared[_EXTRINSIC] -= tilt / options.extrinsic_sigma
    held = _SEGMENT + np.arange(3, 7)
    system.shared[held, held] += _FIXED
    # Very weak, so that a scale without any measurement does not run away.
    scales = _SEGMENT + 7 * np.arange(problem.segments)
    system.shared[scales, scales] += 1e-2
    return 0.5 * float((off**2).sum() + late**2 + (tilt**2).sum())
