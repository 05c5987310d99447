"""Bias of an accelerometer from mean forces between frames of a camera, told apart from how the sensor moves.

With the force ``f``, the orientation ``R`` of the sensor, its bias ``b``, its acceleration ``a`` and gravity ``g``, up,

    R (f - b) = a + g

The mean of ``a`` with the weights of a hat over three frames (0 at the outer two, 1 at the middle one) is the
difference of the mean velocities of its two sides over half its length, whatever the motion between the frames was.
Velocities are those of the places of the camera, in an unknown unit, and of the lever arm; without places they are only
known to be usual. All unknowns are linear: bias, gravity, unit and lever arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.data.inertial import InertialSamples
from dvo.odometry.inertial.temporal import ImuAlignment, integrate_gyro

Array = np.ndarray
SPACING = 0.5
"""Seconds from frame to frame of the hats, at least."""
LONGEST = 2.0
"""Seconds of a hat, at most."""
SPEED, ARM = 1.0, 0.5
"""Usual velocity that turns with a camera, m/s, and way from what it turns about, m, where its places are not known."""
LEVER = 0.1
"""Deviation of the lever arm from the stated one, m."""
STEADY = 2.5
"""Seconds after which the bias may be another."""
_MOST_STEPS = 16  # of the bias
_ANY = 100.0  # deviation of what nothing is known about, m/s^2
_ROUNDS = 4


@dataclass(frozen=True)
class MeanForces:
    """Mean forces of ``W`` hats over ``N`` frames.

    Attributes:
        frames: ``(N,)`` indices of the frames.
        times: ``(N,)`` of these frames, seconds.
        rotations_wc: ``(N, 3, 3)`` camera to world.
        middle: ``(W,)`` the middle frames of the hats, of these frames.
        turns: ``(W, 3, 3)`` orientations of the sensor at the middle frames, sensor to world.
        forces: ``(W, 3)`` means in the axes of the sensor at the middle frame, m/s^2.
        own: ``(W, 3, 3)`` means of the orientation of the sensor in these axes, by the gyroscope.
    """

    frames: Array
    times: Array
    rotations_wc: Array
    middle: Array
    turns: Array
    forces: Array
    own: Array

    @classmethod
    def of(cls, samples: InertialSamples, found: ImuAlignment, timestamps: Array, rotations_wc: Array) -> MeanForces:
        """Means of samples, without hats in which samples are missing or frames are far apart.

        Args:
            samples: with increasing times, in rad/s and m/s^2.
            found: alignment with the camera.
            timestamps: ``(K,)`` increasing times of frames.
            rotations_wc: ``(K, 3, 3)`` camera to world.
        """
        times = samples.timestamps - found.time_offset
        path = integrate_gyro(times, samples.gyro, found.gyro_bias)
        frames = [0]
        for k in range(1, len(timestamps)):
            if timestamps[k] >= timestamps[frames[-1]] + SPACING:
                frames.append(k)
        stamps, poses, steps = timestamps[frames], rotations_wc[frames], np.gradient(times)
        middle, forces, own = [], [], []
        for n in range(1, len(frames) - 1):
            ends = stamps[n - 1 : n + 2]
            first, end = np.searchsorted(times, ends[[0, 2]])
            if ends[2] - ends[0] > LONGEST or end - first < 10 or not path.covers(ends[:1], ends[2:])[0]:
                continue
            weights = steps[first:end] * np.interp(times[first:end], ends, [0.0, 1.0, 0.0])
            turned = path.at(ends[1:2])[0][0].T @ path.rotations[first:end]
            middle.append(n)
            forces.append(np.einsum("n,nij,nj->i", weights, turned, samples.accel[first:end]) / weights.sum())
            own.append(np.einsum("n,nij->ij", weights, turned) / weights.sum())
        chosen = np.array(middle, int)
        return cls(
            np.array(frames), stamps, poses, chosen, poses[chosen] @ found.rotation_camera_imu,
            np.array(forces).reshape(-1, 3), np.array(own).reshape(-1, 3, 3),
        )  # fmt: skip

    def in_world(self, axes: Array) -> Array:
        """Forces ``(W, 3)`` in the world of the camera.

        Args:
            axes: ``(3, 3)`` orthogonal, that those of the accelerometer are taken as.
        """
        return np.einsum("nij,nj->ni", self.turns @ axes, self.forces)

    def differences(self, means: Array) -> Array:
        """Mean accelerations ``(W, ...)`` from mean velocities.

        Args:
            means: ``(N - 1, ...)`` between consecutive frames.
        """
        change = means[self.middle] - means[self.middle - 1]
        width = 0.5 * (self.times[self.middle + 1] - self.times[self.middle - 1])
        return change / width.reshape(-1, *[1] * (means.ndim - 1))


def bias_and_gravity(means: MeanForces, walk: float, positions_wc: Array | None, lever: Array) -> tuple[Array, Array]:
    """Mean bias of the accelerometer and gravity, beside the motion.

    Without places of the camera the motion is that of an arm that swings, of a velocity that turns with the camera, and
    of velocities that are independent from frame to frame: a change of them is taken back later.

    Args:
        means: eight or more.
        walk: of the bias, m/s^3/sqrt(Hz).
        positions_wc: ``(K, 3)`` of the camera at all frames in any unit, or None.
        lever: ``(3,)`` from the camera to the sensor in the axes of the camera, m.

    Returns:
        Bias in the axes of the sensor and gravity, up, in the world of the camera, ``(6,)`` m/s^2, and their deviations
        ``(6,)``, which allow for errors that last.
    """
    spans, poses = np.diff(means.times)[:, None, None], means.rotations_wc
    swinging = means.differences(np.diff(poses, axis=0) / spans)
    seen, noise = means.in_world(np.eye(3)), np.eye(len(means.middle))
    if positions_wc is not None:
        speeds = np.diff(positions_wc[means.frames], axis=0)[..., None] / spans
        moving = means.differences(speeds)
        moving = moving / max(float(np.sqrt((moving**2).mean())), 1e-12)
        seen, sigma = seen - swinging @ lever, [_ANY, *[LEVER] * 3]
    else:
        moving, sigma = means.differences(0.5 * (poses[1:] + poses[:-1])), [*[SPEED] * 3, *[ARM] * 3]
        mixing = means.differences(np.eye(len(spans)))
        noise = mixing @ mixing.T * len(mixing) / (mixing**2).sum()
    biased = means.turns @ means.own
    walking, step = _steps(means.times[means.middle], biased, walk)
    level = np.broadcast_to(np.eye(3), biased.shape)
    design = np.concatenate([biased, level, moving, swinging, walking], -1)
    white = np.linalg.inv(np.linalg.cholesky(noise))
    rows, right = np.tensordot(white, design, 1).reshape(-1, design.shape[-1]), (white @ seen).reshape(-1)
    prior = np.diag(np.array([*[_ANY] * 6, *sigma, *[step] * walking.shape[-1]]) ** -2.0)
    scatter = 1.0
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(rows.T @ rows / scatter + prior)
        solution = covariance @ rows.T @ right / scatter
        error = (right - rows @ solution).reshape(-1, 3)
        scatter = max(float((error**2).mean()) * len(right) / max(len(right) - len(solution), 1), 1e-12)
    follows = float((error[1:] * error[:-1]).sum() / max((error**2).sum(), 1e-12))
    lasting = max(1.0, (1 + follows) / (1 - follows))
    return solution[:6], np.sqrt(lasting * np.diagonal(covariance)[:6])


def _steps(times: Array, biased: Array, walk: float) -> tuple[Array, float]:
    """Columns ``(W, 3, 3 S)`` of steps of the bias about its mean, and the deviation of a step."""
    count = int(np.clip((times[-1] - times[0]) / STEADY, 1, _MOST_STEPS))
    knots = np.linspace(times[0], times[-1], count + 1)
    later = (times[:, None] > knots[1:-1]).astype(float)
    columns = np.einsum("nk,nij->nikj", later - later.mean(0), biased).reshape(len(times), 3, -1)
    return columns, max(walk * float(np.sqrt(knots[1] - knots[0])), 1e-6)
