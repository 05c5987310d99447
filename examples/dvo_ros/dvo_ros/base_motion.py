"""Motion of ``base_link`` in ``odom``, of the poses that dvo gives: those of a camera in a world of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

import dvo
from dvo.data.extrinsics import pose_of_numbers
from dvo.geometry.poses import compose_poses, invert_poses, pose_matrices

IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])


@dataclass(frozen=True)
class BaseState:
    """Motion of ``base_link`` at a frame, as ``nav_msgs/Odometry`` defines it.

    Attributes:
        T_odom_base: ``(7,)`` float64 ``tx ty tz qx qy qz qw``.
        covariance: ``(6, 6)`` of the position and of a rotation about it, both in the axes of ``odom``, in the unit of
            the poses and radians, relative to the oldest keyframe in use; None where it is not known.
        twist: ``(6,)`` mean linear and angular velocity since the pose before, in the axes of ``base_link``; None for
            the first pose of a segment or after frames without one.
    """

    T_odom_base: np.ndarray
    covariance: np.ndarray | None
    twist: np.ndarray | None


class BaseMotion:
    """The frame ``odom`` (REP 105): ``base_link`` at the first pose, without a step where the world of dvo changes.

    Poses of a new segment, or of one that was joined to an earlier world, go on from the last pose: the motion between
    is not known. Each segment has a scale of its own.

    Args:
        T_base_camera: seven or sixteen numbers (:func:`dvo.data.extrinsics.pose_of_numbers`), camera (optical frame: x
            right, y down, z forward) to ``base_link``, in the unit of the poses.

    Raises:
        DvoError: numbers that are no pose.
    """

    def __init__(self, T_base_camera: object) -> None:
        pose = pose_of_numbers(T_base_camera)
        self._T_camera_base = invert_poses(pose)
        self._adjoint = dvo.se3.adjoint(torch.from_numpy(pose)).numpy()
        self.reset()

    def reset(self) -> None:
        """The next pose is the identity."""
        self._T_odom_world = self._last = IDENTITY
        self._segment: int | None = None
        self._time: float | None = None  # of the last pose, if it was that of the last frame

    def update(self, estimate: dvo.Estimate) -> BaseState | None:
        """State at the next frame; None without a pose.

        Args:
            estimate: of the frame.
        """
        if estimate.pose_wc is None:
            self._time = None
            return None
        T_world_base = compose_poses(estimate.pose_wc, self._T_camera_base)
        if estimate.segment != self._segment or estimate.recovered:
            self._T_odom_world = compose_poses(self._last, invert_poses(T_world_base))
            self._segment, self._time = estimate.segment, None
        before, self._last = self._last, compose_poses(self._T_odom_world, T_world_base)
        twist = None
        if self._time is not None:
            step = dvo.se3.log(torch.from_numpy(compose_poses(invert_poses(before), self._last))).numpy()
            twist = step / (estimate.timestamp - self._time)
        self._time = estimate.timestamp
        covariance = None
        if estimate.covariance is not None:
            # The error is a right tangent, T_wc Exp(xi): T_odom_base Exp(Ad(T_base_camera) xi), in the axes of
            # base_link; those of odom are turned.
            jacobian = np.kron(np.eye(2), pose_matrices(self._last)[:3, :3]) @ self._adjoint
            covariance = jacobian @ estimate.covariance @ jacobian.T
        return BaseState(self._last, covariance, twist)
