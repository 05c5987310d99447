"""Rolling shutter: measurements in the rows of a frame as if all rows had been read at the time of the frame.

A row is read before or after the middle row, whose time is that of the frame. Between frames the camera moves as a
polynomial through the poses around, and turns as a gyroscope says where there is one; a point whose depth is known can
then be moved from the camera at the time of its row to the camera at the time of the frame (the rows' motion model of
Hedborg et al., "Rolling Shutter Bundle Adjustment", CVPR 2012, used to correct the measurements instead of extending
the residual).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.core.kernels import use_kernels
from dvo.geometry import se3, so3

_STENCIL = 5  # poses that a polynomial goes through
_NEAREST = 0.05  # least depth of a point in front of a camera, in the unit of the poses


Turns = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Rotation vectors ``(N, s, 3)`` from the camera at times ``(N,)`` to that ``(s,)`` seconds later; nan if not known."""


@dataclass(frozen=True)
class Shutter:
    """Timing of the rows of a frame.

    Attributes:
        readout: seconds from the first to the last row, read from top to bottom.
        rows: height of the feature map, image height over stride.
        turns: what a gyroscope says of rotations; None without one.
    """

    readout: float
    rows: float
    turns: Turns | None = None

    def offsets(self, v: Tensor) -> Tensor:
        """Times of rows relative to that of their frame.

        Args:
            v: ``(...)`` row coordinates, feature pixels; feature row ``v`` is image row ``4 v``.

        Returns:
            ``(...)`` seconds.
        """
        return (v - (self.rows - 0.25) / 2) * (self.readout / self.rows)


@dataclass(frozen=True)
class PoseTrack:
    """Motion of a camera around the times of its frames.

    Attributes:
        poses_cw: ``(N, 7)``.
        times: ``(N, s)`` of the ``s`` frames around each, relative to its own, seconds.
        twists: ``(N, s, 6)`` motion from the frame to those around it.
    """

    poses_cw: Tensor
    times: Tensor
    twists: Tensor

    @classmethod
    def through(cls, times: Tensor, poses_cw: Tensor, shutter: Shutter | None = None) -> PoseTrack:
        """Interpolate poses.

        Args:
            times: ``(N,)`` increasing, seconds.
            poses_cw: ``(N, 7)``.
            shutter: whose ``turns`` are taken for the rotations during the readout.

        Returns:
            The track.
        """
        n = len(times)
        size = min(_STENCIL, n)
        first = (torch.arange(n) - size // 2).clamp(0, n - size)
        around = first[:, None] + torch.arange(size)
        twists = se3.log(se3.relative(poses_cw[:, None].expand(n, size, 7), poses_cw[around]))
        track = cls(poses_cw, times[around] - times[:, None], twists)
        if shutter is None or shutter.turns is None or shutter.readout <= 0:
            return track
        offsets = torch.linspace(-0.5, 0.5, _STENCIL, dtype=times.dtype) * shutter.readout
        turned = torch.from_numpy(shutter.turns(times.numpy(), offsets.numpy())).to(poses_cw)
        nodes = offsets.expand(n, _STENCIL)
        moved = track.motion(torch.arange(n).repeat_interleave(_STENCIL), nodes.flatten())
        seen = se3.log(moved).view(n, _STENCIL, 6)
        known = turned.isfinite().all(-1, keepdim=True).all(1, keepdim=True)
        return cls(poses_cw, nodes, torch.cat([seen[..., :3], torch.where(known, turned, seen[..., 3:])], -1))

    def motion(self, frames: Tensor, offsets: Tensor) -> Tensor:
        """Motion from the time of a frame to one a little earlier or later.

        Args:
            frames: ``(Q,)`` indices.
            offsets: ``(Q,)`` seconds.

        Returns:
            ``(Q, 7)``; composed with the pose of the frame it is the pose at that time.
        """
        nodes, twists = self.times[frames], self.twists[frames]
        twist = torch.zeros_like(twists[:, 0])
        for k in range(nodes.shape[1]):  # Lagrange's basis polynomials
            basis = torch.ones_like(offsets)
            for other in range(nodes.shape[1]):
                if other != k:
                    basis = basis * (offsets - nodes[:, other]) / (nodes[:, k] - nodes[:, other])
            twist = twist + basis[:, None] * twists[:, k]
        return se3.exp(twist)


def as_global_shutter(
    part: PatchProblem, poses_cw: Tensor, depths: Tensor, frames: Tensor, track: PoseTrack, shutter: Shutter
) -> PatchProblem:
    """Correct patch centres and measurements for the motion during the readout.

    Args:
        part: as measured.
        poses_cw: ``(N, 7)`` present estimate.
        depths: ``(N, M)`` present inverse depths of the patches.
        frames: ``(N,)`` index of each pose in ``track``.
        track: motion of the camera.
        shutter: timing of the rows.

    Returns:
        The problem with the positions at which a global shutter would have seen the points.
    """
    if use_kernels(poses_cw, depths, part.patches, part.targets, part.intrinsics, track.twists, double=True):
        return _compiled(part, poses_cw, depths, frames, track, shutter)
    focal, centre = part.intrinsics.split(2, -1)

    def undo(xy: Tensor, depth: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Position ``(Q, 2)`` and depth ``(Q,)`` in the camera at the time of the frame."""
        rays = torch.cat([(xy - centre[pose]) / focal[pose], torch.ones_like(xy[:, :1])], 1)
        motion = track.motion(frames[pose], shutter.offsets(xy[:, 1]))
        point = se3.act(se3.inverse(motion), rays * depth[:, None])
        depth = point[:, 2].clamp(min=_NEAREST)
        return point[:, :2] / depth[:, None] * focal[pose] + centre[pose], depth

    source = torch.arange(len(poses_cw)).repeat_interleave(depths.shape[1])
    xy, depth = undo(part.patches[:, :2, 0, 0], 1 / depths.reshape(-1), source)
    ii, jj, kk = part.ii, part.jj, part.kk
    rays = torch.cat([(xy[kk] - centre[ii]) / focal[ii], torch.ones_like(xy[kk, :1])], 1)
    seen = se3.act(se3.relative(poses_cw[ii], poses_cw[jj]), rays * depth[kk, None])
    targets, _ = undo(part.targets, seen[:, 2].clamp(min=_NEAREST), jj)
    patches = torch.cat([xy[:, :, None, None], part.patches[:, 2:]], 1)
    return part.with_values(patches=patches, targets=targets)


def _compiled(
    part: PatchProblem, poses_cw: Tensor, depths: Tensor, frames: Tensor, track: PoseTrack, shutter: Shutter
) -> PatchProblem:
    """:func:`as_global_shutter` by a kernel."""
    from dvo.odometry.global_ba import shutter_kernels

    given = (
        so3.matrix(poses_cw[:, 3:]), poses_cw[:, :3], part.intrinsics, part.patches[:, :2, 0, 0], depths.reshape(-1),
        part.targets, part.ii, part.jj, part.kk, frames, track.times, track.twists,
    )  # fmt: skip
    arrays: list[Any] = [x.contiguous().numpy() for x in given]
    arrays += [float(shutter.readout), float(shutter.rows), _NEAREST]
    xy, targets = shutter_kernels.global_shutter(*arrays)
    patches = torch.cat([torch.from_numpy(xy).to(part.patches)[:, :, None, None], part.patches[:, 2:]], 1)
    return part.with_values(patches=patches, targets=torch.from_numpy(targets).to(part.targets))
