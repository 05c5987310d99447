"""Preintegrated inertial measurements between two frames, and the walk of their biases, as factors.

Residuals of an interval of length T (Forster et al., "On-manifold preintegration", 2017, eq. 45), with the body, an
inertial sensor, in the world, ``db`` the change of the bias, and the measured ``dR, dv, dp``:

    r_phi = Log((dR Exp(J db))^T R_i^T R_j)
    r_v   = R_i^T (v_j - v_i - g T) - (dv + J db)
    r_p   = R_i^T (p_j - p_i - v_i T - g T^2 / 2) - (dp + J db)

The poses of a problem are ``T_cw`` and move on the left. With the extrinsics ``T_cb`` and the log scale s of the
visual unit, the body is at ``R_wb = R_cw^T R_cb`` and ``p = e^s c + R_cw^T t_cb``, c the centre of the camera; a left
tangent ``[tau, phi]`` of ``T_cw`` turns the body by ``-R_cb^T phi`` on its right and moves it by
``R_cw^T (t_cb x phi - e^s tau)``. With a time offset (stamps of the inertial clock minus those of the camera) that
differs by d from the one that was integrated with, the states are first moved to the instants of the integration:
``R Exp(-w d)``, ``v - a d``, ``p - v d + a d^2 / 2``, with the rate w and the acceleration ``a = R f + g`` there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.blocks import GRAVITY, IMU_BIAS, LOG_SCALE, POSES, T_CAMERA_IMU, TIME_OFFSET, VELOCITY, tangent_basis
from dvo.ba.kernels import Kernel
from dvo.ba.problem import Factor, Linearisation
from dvo.geometry import so3


@dataclass(frozen=True)
class InertialFactor(Factor):
    """Preintegrated rotation, velocity and position of ``F`` intervals.

    It measures the blocks ``poses`` (``T_cw``), ``velocity`` (of the body in the world, m/s) and ``imu_bias`` (gyro,
    accel) and, of the globals ``gravity`` (unit vector down in the world), ``log_scale`` (of metres for one unit of
    the poses), ``time_offset`` (seconds) and ``T_camera_imu``, those that the problem has; see
    :func:`dvo.ba.blocks.inertial_blocks`. Without velocities the rotation alone is measured, without biases they are
    as integrated. All tensors are ``(B, F, ...)``, or ``(1, F, ...)`` for the whole batch.

    Attributes:
        duration: ``(B, F)`` seconds.
        rotation: ``(B, F, 4)`` unit quaternion, body at the end to body at the start.
        velocity, position: ``(B, F, 3)`` m/s and m in the body frame at the start.
        by_bias: ``(B, F, 9, 6)`` derivative of (phi, v, p) by (gyro, accel) bias; phi on the right of ``rotation``.
        root: ``(B, F, 9, 9)`` inverse of the lower Cholesky factor of the covariance of (phi, v, p).
        bias: ``(B, F, 6)`` that was integrated with.
        rates, forces: ``(B, F, 2, 3)`` rad/s and m/s^2 of the body at start and end, without bias.
        offset: ``(B, F)`` time offset that was integrated with, seconds.
        gravity: ``(B, 3)`` m/s^2 in the world; with a block, its length alone counts.
        extrinsics: ``(B, 7)`` ``T_camera_imu``; with a block of quaternions its translation alone counts.
        ii, jj: ``(F,)`` poses at start and end.
        state_i, state_j: ``(F,)`` velocities and biases there; None: they have the numbers of the poses.
        kernel: robust kernel of the whitened residual.
    """

    duration: Tensor
    rotation: Tensor
    velocity: Tensor
    position: Tensor
    by_bias: Tensor
    root: Tensor
    bias: Tensor
    rates: Tensor
    forces: Tensor
    offset: Tensor
    gravity: Tensor
    extrinsics: Tensor
    ii: Tensor
    jj: Tensor
    state_i: Tensor | None = None
    state_j: Tensor | None = None
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        poses = values[POSES]
        count, batch = len(self.ii), len(poses)
        state_i = self.ii if self.state_i is None else self.state_i
        state_j = self.jj if self.state_j is None else self.state_j
        none = torch.zeros_like(self.ii)
        full = VELOCITY in values
        rows = 9 if full else 3

        # both ends of the intervals at once: i, then j
        ends = poses.index_select(1, torch.cat((self.ii, self.jj)))
        q_wc = so3.conjugate(ends[..., 3:])
        q_cb, t_cb = self._extrinsics(values)
        r_wc, r_cb = so3.matrix(q_wc), so3.matrix(q_cb)
        q_wb, turned = so3.multiply(q_wc, q_cb), torch.eye(3).to(q_wc).expand(1, 2 * count, 3, 3)
        if TIME_OFFSET in values:
            x = so3.exp(self._ends(self.rates) * self._late(values)[..., None])  # Exp(w d)
            q_wb, turned = so3.multiply(q_wb, so3.conjugate(x)), so3.matrix(x)

        db = None
        if IMU_BIAS in values:
            db = (values[IMU_BIAS].index_select(1, state_i) - self.bias)[..., None]
        j_phi = self.by_bias[..., :3, :]
        bent = (j_phi @ db)[..., 0] if db is not None else torch.zeros_like(self.velocity)
        measured = so3.multiply(self.rotation, so3.exp(bent))
        between = so3.multiply(so3.conjugate(q_wb[:, :count]), q_wb[:, count:])
        r_phi, e = so3.log_terms(so3.multiply(so3.conjugate(measured), between))
        # inverse right and left Jacobians of SO(3)
        hat = so3.hat(r_phi)
        even = torch.eye(3).to(hat) + e[..., None] * (hat @ hat)
        by_end = even + hat / 2
        by_start = -by_end @ so3.matrix(between).mT
        turns = [by_start @ turned[:, :count], by_end @ turned[:, count:]]  # by right tangents of R_wb
        residual, moves = [r_phi], []
        slots: list[tuple[str, Tensor, Tensor]] = []

        def add(name: str, index: Tensor, *parts: Tensor) -> None:
            """Derivative of the residual by elements of a block, in parts of three rows."""
            shape = batch, count, 3, parts[0].shape[-1]
            slots.append((name, index, torch.cat([part.expand(shape) for part in parts], -2)))

        zero = torch.zeros_like(hat)
        if full:
            f, time = self._ends(self.forces), self.duration[..., None]
            late = self._late(values)[..., :count, None]
            scale, down = self._scale(values), self._gravity(values)
            r_wb = r_wc @ r_cb
            centre = -(r_wc @ ends[..., :3, None])[..., 0]
            lever = (r_wc @ t_cb[..., None])[..., 0]
            force = (r_wb @ f[..., None])[..., 0]
            p_i, p_j = (scale * centre + lever).split(count, 1)
            v_i, v_j = values[VELOCITY].index_select(1, torch.cat((state_i, state_j))).split(count, 1)
            back = so3.matrix(q_wb[:, :count]).mT
            step, change, gain = v_j - v_i, force[:, count:] - force[:, :count], force[:, :count] + down
            u_v = step - down * time - change * late
            u_p = (
                p_j - p_i - v_i * time - down * time**2 / 2 - step * late + gain * (late * time) + change * late**2 / 2
            )
            r_v, r_p = (back @ u_v[..., None])[..., 0], (back @ u_p[..., None])[..., 0]
            by = (self.by_bias @ db)[..., 0] if db is not None else torch.zeros_like(self.root[..., 0])
            residual += [r_v - self.velocity - by[..., 3:6], r_p - self.position - by[..., 6:]]
            x_i, late_, time_ = turned[:, :count], late[..., None], time[..., None]
            hat_v, hat_p, hat_f = so3.hat(r_v), so3.hat(r_p), so3.hat(f)
            by_force = x_i @ hat_f[:, :count] * late_
            turns[0] = torch.cat((turns[0], hat_v @ x_i - by_force, hat_p @ x_i - by_force * (time_ - late_ / 2)), -2)
            by_force = back @ r_wb[:, count:] @ hat_f[:, count:] * late_
            turns[1] = torch.cat(torch.broadcast_tensors(turns[1], by_force, -by_force * late_ / 2), -2)
            moves = [torch.cat((zero, zero, sign * back), -2) for sign in (-1, 1)]  # by positions
            add(VELOCITY, state_i, zero, -back, (late_ - time_) * back)
            add(VELOCITY, state_j, zero, back, -late_ * back)

        for end, index in ((0, self.ii), (1, self.jj)):
            part = slice(end * count, (end + 1) * count)
            by_phi = -turns[end] @ r_cb.mT
            if full:
                by_phi = by_phi + moves[end] @ r_wc[:, part] @ so3.hat(t_cb)
                by_tau = -moves[end] @ (r_wc[:, part] * scale[..., None])
            else:
                by_tau = torch.zeros_like(by_phi)
            slots.append((POSES, index, torch.cat((by_tau, by_phi), -1)))
        if db is not None:
            # inverse left Jacobian of r times right one of J db
            _, b, c = so3.exp_terms(bent)
            bow = so3.hat(bent)
            right = torch.eye(3).to(bow) - b[..., None] * bow + c[..., None] * (bow @ bow)
            by_phi = -(even - hat / 2) @ right @ j_phi
            add(IMU_BIAS, state_i, *((by_phi, *(-self.by_bias[..., 3:, :]).split(3, -2)) if full else (by_phi,)))
        if full and GRAVITY in values:
            by_down = back @ (tangent_basis(values[GRAVITY]) * self.gravity.norm(dim=-1)[:, None, None, None])
            add(GRAVITY, none, zero[..., :2], -time_ * by_down, (late_ - time_ / 2) * time_ * by_down)
        if full and LOG_SCALE in values:
            moved = ((moves[0] @ centre[:, :count, :, None]) + (moves[1] @ centre[:, count:, :, None])) * scale[
                ..., None
            ]
            slots.append((LOG_SCALE, none, moved))
        if TIME_OFFSET in values:
            w_i, w_j = (part[..., None] for part in self._ends(self.rates).split(count, 1))
            parts = [-by_end @ w_j - by_start @ w_i]
            if full:
                parts.append(-hat_v @ w_i - back @ change[..., None])
                parts.append(-hat_p @ w_i + back @ (gain * time - step + change * late)[..., None])
            add(TIME_OFFSET, none, *parts)
        if T_CAMERA_IMU in values:
            by_phi = (turns[0] + turns[1]) @ r_cb.mT
            if values[T_CAMERA_IMU].shape[-1] == 4:
                slots.append((T_CAMERA_IMU, none, by_phi))
            elif full:
                by_tau = moves[0] @ r_wc[:, :count] + moves[1] @ r_wc[:, count:]
                slots.append((T_CAMERA_IMU, none, torch.cat((by_tau, by_phi - by_tau @ so3.hat(t_cb)), -1)))
            else:
                slots.append((T_CAMERA_IMU, none, torch.cat((torch.zeros_like(by_phi), by_phi), -1)))

        root = self.root[..., :rows, :rows]
        whole = torch.cat([jacobian.expand(batch, count, rows, -1) for _, _, jacobian in slots], -1)
        jacobians = (-root @ whole).split([jacobian.shape[-1] for _, _, jacobian in slots], -1)
        white = (root @ torch.cat([r.expand(batch, count, 3) for r in residual], -1)[..., None])[..., 0]
        weight = torch.ones_like(white)
        robust = self.kernel.weights(white, weight, -1)
        weight = weight if robust is None else weight * robust
        return Linearisation(
            white, weight, tuple(name for name, _, _ in slots), tuple(index for _, index, _ in slots), jacobians
        )

    @staticmethod
    def _ends(x: Tensor) -> Tensor:
        """``(B, F, 2, 3)`` at starts and ends, ``(B, 2F, 3)``."""
        return torch.cat((x[..., 0, :], x[..., 1, :]), 1)

    def _late(self, values: Mapping[str, Tensor]) -> Tensor:
        """``(B, 2F)`` time offset beyond the one that was integrated with."""
        offset = torch.cat((self.offset, self.offset), -1)
        return values[TIME_OFFSET][:, 0] - offset if TIME_OFFSET in values else torch.zeros_like(offset)

    def _extrinsics(self, values: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Rotation and translation ``(B, 1, .)`` of ``T_camera_imu``."""
        pose = values.get(T_CAMERA_IMU, self.extrinsics[:, None])
        translation = self.extrinsics[:, None] if pose.shape[-1] == 4 else pose
        return pose[..., -4:], translation[..., :3]

    def _scale(self, values: Mapping[str, Tensor]) -> Tensor:
        """``(B, 1, 1)`` metres for one unit of the poses."""
        return values[LOG_SCALE].exp() if LOG_SCALE in values else torch.ones_like(self.gravity[:1, None, :1])

    def _gravity(self, values: Mapping[str, Tensor]) -> Tensor:
        """``(B, 1, 3)`` m/s^2."""
        gravity = self.gravity[:, None]
        return values[GRAVITY] * gravity.norm(dim=-1, keepdim=True) if GRAVITY in values else gravity


@dataclass(frozen=True)
class BiasWalk(Factor):
    """Random walk of the biases of an inertial sensor: ``r = b_j - b_i`` of variance ``sigma^2 T``.

    Attributes:
        weight: ``(B, F, 6)`` or broadcastable to it; inverse variances of (gyro, accel).
        ii, jj: ``(F,)`` elements of the block ``imu_bias``.
    """

    weight: Tensor
    ii: Tensor
    jj: Tensor

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        bias = values[IMU_BIAS]
        residual = bias.index_select(1, self.jj) - bias.index_select(1, self.ii)
        one = torch.eye(6).to(residual).expand(*residual.shape, 6)
        weight = self.weight.expand(residual.shape)
        return Linearisation(residual, weight, (IMU_BIAS,) * 2, (self.ii, self.jj), (one, -one))
