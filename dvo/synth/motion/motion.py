"""Motions in continuous time: camera paths and the motion of bodies, with a pose at any time.

A :class:`Path` is ``T_wc(t) = T_0 Exp(g w(t) xi) Exp(g shake(w(t)))``: a constant body twist (straight, arc, orbit,
turn)
plus smooth shake, with gain g and a time warp w for stop-and-go. Any frame rate, motion blur and rolling shutter can be
read from the same path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvo.geometry.poses import look_rotation, pose_from, se3_exp, so3_exp

Array = np.ndarray
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Path:
    """Smooth path of constant twist plus shake.

    Attributes:
        kind: one of ``dvo.synth.KINDS``.
        rotation, position: ``(3, 3)``, ``(3,)`` camera to world at rest.
        twist: ``(6,)`` body velocity ``[v, omega]``, world units and rad per second.
        frequency: ``(F,)`` of the shake, rad/s.
        shake: ``(F, 2, 6)`` sine and cosine amplitudes ``[position (body axes), rotation vector]``.
        depth: median depth in view at the start.
        warp: amplitude, rad/s and phase of the time warp; an amplitude near 1 nearly stops.
        gain: factor on the whole motion.
    """

    kind: str
    rotation: Array
    position: Array
    twist: Array
    frequency: Array
    shake: Array
    depth: float
    warp: tuple[float, float, float] = (0.0, 1.0, 0.0)
    gain: float = 1.0

    def scaled(self, gain: float) -> Path:
        """Same path with its motion scaled.

        Args:
            gain: factor; -1 reverses the motion.

        Returns:
            The scaled path.
        """
        return replace(self, gain=self.gain * gain)

    def poses_wc(self, times: Array) -> Array:
        """Camera-to-world poses.

        Args:
            times: ``(T,)`` seconds.

        Returns:
            ``(T, 7)`` float64.
        """
        times = np.asarray(times, float)
        amplitude, rate, phase = self.warp
        warped = times + amplitude / rate * (np.sin(rate * times + phase) - np.sin(phase))
        turn, move = se3_exp(self.gain * warped[:, None] * self.twist)
        angle = warped[:, None] * self.frequency
        wave = np.stack([np.sin(angle), np.cos(angle) - 1], -1)  # zero at time 0
        shake = self.gain * np.einsum("tfk,fkc->tc", wave, self.shake)
        rotation = self.rotation @ turn @ so3_exp(shake[:, 3:])
        position = self.position + (move + (turn @ shake[:, :3, None])[..., 0]) @ self.rotation.T
        return pose_from(rotation, position)


@dataclass(frozen=True)
class SplinePath:
    """Long path: uniform cubic B-spline through position, yaw, pitch and roll, plus shake.

    Attributes:
        kind: one of ``dvo.synth.LONG_KINDS``.
        control: ``(K, 6)`` x, y, z, yaw, pitch, roll (rad; yaw 0 looks along y, pitch up is positive).
        interval: seconds between control points.
        frequency, shake: as in :class:`Path`; added in body axes.
        start: time at which the control points begin, seconds.
    """

    kind: str
    control: Array
    interval: float
    frequency: Array
    shake: Array
    start: float = 0.0

    @property
    def duration(self) -> float:
        """Time covered by the control points, seconds."""
        return (len(self.control) - 3) * self.interval

    @staticmethod
    def weights(share: Array) -> Array:
        """Weights of the four control points of a segment of a uniform cubic B-spline.

        Args:
            share: ``(T,)`` of the segment that has passed.

        Returns:
            ``(T, 4)``.
        """
        s = share
        return np.stack([(1 - s) ** 3, 3 * s**3 - 6 * s**2 + 4, -3 * s**3 + 3 * s**2 + 3 * s + 1, s**3], -1) / 6

    def poses_wc(self, times: Array) -> Array:
        """Camera-to-world poses.

        Args:
            times: ``(T,)`` seconds in [start, start + duration].

        Returns:
            ``(T, 7)`` float64.
        """
        times = np.asarray(times, float)
        # Just before the start the first segment is extrapolated: a shutter opens before the time of its frame.
        place = np.clip((times - self.start) / self.interval, -0.2, len(self.control) - 3 - 1e-9)
        index = np.maximum(np.floor(place), 0).astype(int)
        state = (self.weights(place - index)[..., None] * self.control[index[:, None] + np.arange(4)]).sum(1)
        yaw, pitch, roll = state[:, 3:].T
        forward = np.stack([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)], -1)
        rotation = np.stack([look_rotation(f, UP, r) for f, r in zip(forward, roll, strict=True)])
        angle = times[:, None] * self.frequency
        shake = np.einsum("tfk,fkc->tc", np.stack([np.sin(angle), np.cos(angle) - 1], -1), self.shake)
        position = state[:, :3] + (rotation @ shake[:, :3, None])[..., 0]
        return pose_from(rotation @ so3_exp(shake[:, 3:]), position)


@dataclass(frozen=True)
class Sway:
    """Smooth motion of a body: steady drift, oscillation, turn about the vertical and a wobble.

    Attributes:
        centre: ``(3,)`` position at time 0 without the oscillation.
        drift: ``(3,)`` velocity, world units per second.
        reach: ``(2, 3)`` amplitudes of the sine and cosine of ``rate t + phase``.
        rate, phase: rad/s and rad.
        heading, spin: yaw at time 0 (rad) and its rate (rad/s).
        wobble: ``(3,)`` rotation vector that oscillates at 1.7 times the rate.
    """

    centre: Array
    drift: Array
    reach: Array
    rate: float
    phase: float
    heading: float
    spin: float
    wobble: Array

    def poses_wc(self, times: Array) -> Array:
        """Body-to-world poses.

        Args:
            times: ``(T,)`` seconds.

        Returns:
            ``(T, 7)`` float64.
        """
        times = np.asarray(times, float)
        angle = self.rate * times + self.phase
        swing = np.stack([np.sin(angle), np.cos(angle)], -1) @ self.reach
        turn = np.zeros((len(times), 3))
        turn[:, 2] = self.heading + self.spin * times
        rotation = so3_exp(turn) @ so3_exp(np.sin(1.7 * angle)[:, None] * self.wobble)
        return pose_from(rotation, self.centre + times[:, None] * self.drift + swing)
