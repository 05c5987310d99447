"""The multi-state constraint Kalman filter: inertial state, time offset, extrinsics, and clones of past poses.

The error of the state is ``[p, theta, v, gyro bias, accel bias | time offset | p, theta of the camera in the body |
p, theta of every clone]``; ``theta`` is a right tangent (``R exp(theta)``), everything else is added. Jacobians are
taken at the first estimates of poses (Li & Mourikis 2013), so that yaw and position stay unobservable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvo.data.inertial import ImuNoise
from dvo.geometry.poses import so3_exp
from dvo.odometry.classical.msckf.features import Clones, Layout
from dvo.odometry.classical.msckf.motion import Motion, Stretch, propagate

INERTIAL, OFFSET, EXTRINSICS, FIXED = 15, 15, 16, 22  # columns: of the inertial state; begin of the others; of all


@dataclass(frozen=True)
class Clone:
    """Pose of the body at the time of an image.

    Attributes:
        number: of the clone, never reused.
        time: of the image, seconds.
        motion, first: current and first estimate; the velocity is that at the time of the image.
        rate: ``(3,)`` angular rate, rad/s.
    """

    number: int
    time: float
    motion: Motion
    first: Motion
    rate: np.ndarray


class Filter:
    """State and covariance.

    Attributes:
        time: of the inertial state, seconds on the clock of the samples.
        motion: inertial state.
        bias: ``(6,)`` of gyroscope and accelerometer.
        offset: seconds that are added to the time of an image for that of the samples.
        R_bc, p_bc: camera in the body.
        clones: in order of time.
        P: ``(22 + 6 N, 22 + 6 N)`` covariance of the error.
    """

    def __init__(
        self,
        time: float,
        motion: Motion,
        bias: np.ndarray,
        offset: float,
        R_bc: np.ndarray,
        p_bc: np.ndarray,
        P: np.ndarray,
        noise: ImuNoise,
    ) -> None:
        """Args: as the attributes; ``P (22, 22)``."""
        self.time, self.motion, self.bias, self.offset = time, motion, bias, offset
        self.R_bc, self.p_bc, self.P, self.noise = R_bc, p_bc, P, noise
        self.clones: list[Clone] = []
        self._first = motion  # at which the next transition is linearised
        self._count = 0

    @property
    def layout(self) -> Layout:
        """Columns of the present clones."""
        return Layout(len(self.P), FIXED + 6 * np.arange(len(self.clones)), EXTRINSICS)

    def poses(self, *, first: bool = False) -> Clones:
        """Current, or first, estimates of all clones."""
        motions = [clone.first if first else clone.motion for clone in self.clones]
        rates = np.array([clone.rate for clone in self.clones]).reshape(-1, 3)
        R, p, v = (np.array([getattr(m, name) for m in motions]) for name in ("R", "p", "v"))
        return Clones(R.reshape(-1, 3, 3), p.reshape(-1, 3), v.reshape(-1, 3), rates)

    def propagate(self, stretch: Stretch) -> None:
        """Move the inertial state to the end of samples that begin at its time."""
        self.motion, self.P = self.predicted(stretch)
        self._first, self.time = self.motion, float(stretch.times[-1])

    def predicted(self, stretch: Stretch) -> tuple[Motion, np.ndarray]:
        """Inertial state and covariance that :meth:`propagate` would give."""
        motion, transition, noise = propagate(stretch, self.motion, self.bias, self.noise, first=self._first)
        P, own = self.P.copy(), slice(0, INERTIAL)
        P[own, INERTIAL:] = transition @ P[own, INERTIAL:]
        P[INERTIAL:, own] = P[own, INERTIAL:].T
        P[own, own] = transition @ P[own, own] @ transition.T + noise
        return motion, P

    def clone(self, time: float, gyro: np.ndarray) -> Clone:
        """Append a clone of the present pose, whose error depends on the time offset (Li & Mourikis 2014, eq. 30).

        Args:
            time: of the image, seconds.
            gyro: ``(3,)`` measured angular rate at this time.
        """
        rate = gyro - self.bias[:3]
        J = np.zeros((6, len(self.P)))
        J[:, :6] = np.eye(6)
        J[:3, OFFSET], J[3:, OFFSET] = self.motion.v, rate
        cross = J @ self.P
        self.P = np.block([[self.P, cross.T], [cross, cross @ J.T]])
        self.clones.append(Clone(self._count, time, self.motion, self._first, rate))
        self._count += 1
        return self.clones[-1]

    def forget(self, rows: list[int]) -> None:
        """Drop clones (marginalise them out)."""
        gone = [FIXED + 6 * row + k for row in rows for k in range(6)]
        keep = np.setdiff1d(np.arange(len(self.P)), gone)
        self.P = self.P[np.ix_(keep, keep)]
        self.clones = [clone for row, clone in enumerate(self.clones) if row not in rows]

    def update(self, r: np.ndarray, H: np.ndarray, sigma: float | np.ndarray) -> None:
        """Take in a measurement.

        Args:
            r: ``(m,)`` residual.
            H: ``(m, n)`` its Jacobian.
            sigma: standard deviation of the noise, a number or ``(m,)``.
        """
        HP = H @ self.P
        S = HP @ H.T
        S[np.diag_indices(len(r))] += np.square(sigma)
        both = np.linalg.solve(np.linalg.cholesky(S), np.column_stack([HP, r]))
        B = both[:, :-1]
        self.P -= B.T @ B
        self.P = 0.5 * (self.P + self.P.T)
        self._shift(B.T @ both[:, -1])

    def _shift(self, change: np.ndarray) -> None:
        self.motion = _moved(self.motion, change[:9])
        self.bias = self.bias + change[9:15]
        self.offset += float(change[OFFSET])
        self.p_bc = self.p_bc + change[EXTRINSICS : EXTRINSICS + 3]
        self.R_bc = self.R_bc @ so3_exp(change[EXTRINSICS + 3 : FIXED])
        for row, clone in enumerate(self.clones):
            at = FIXED + 6 * row
            moved = _moved(clone.motion, np.concatenate([change[at : at + 6], change[6:9]]))
            self.clones[row] = replace(clone, motion=moved)

    def is_sound(self) -> bool:
        """Return True if all numbers are finite and variances positive."""
        state = np.concatenate([self.motion.p, self.motion.v, self.bias, self.motion.R.ravel()])
        return bool(np.isfinite(state).all() and np.isfinite(self.P).all() and (np.diag(self.P) > -1e-9).all())


def _moved(motion: Motion, change: np.ndarray) -> Motion:
    """Motion with its error ``[p, theta, v]`` corrected."""
    return Motion(motion.R @ so3_exp(change[3:6]), motion.p + change[:3], motion.v + change[6:9])
