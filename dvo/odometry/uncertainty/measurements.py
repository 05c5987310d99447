"""Measurements of a window at a moment, for what is computed from them later, and only if somebody asks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem
from dvo.map.measured_depths import depth_factors
from dvo.map.window import Window
from dvo.odometry.window.patch_window import PatchWindow


@dataclass(frozen=True)
class WindowMeasurements:
    """Measurements of a window at a moment.

    Attributes:
        problem: of the patch centres, weighted by the confidence of the network, with measured depths as factors. It
            shares tensors with the window, which replaces its own.
        timestamps: of the frames, seconds.
        bounds, kernel: of bundle adjustment.
    """

    problem: PatchProblem
    timestamps: tuple[float, ...]
    bounds: tuple[int, int]
    kernel: Kernel

    @classmethod
    def of(cls, window: PatchWindow) -> WindowMeasurements:
        """Measurements of a window.

        Args:
            window: after a step.

        Returns:
            What no later step changes.
        """
        data: Window = window.window
        middle = data.patches.shape[-1] // 2
        centres = data.patches[:, :, middle : middle + 1, middle : middle + 1].clone()
        depths = depth_factors(data.measured)
        problem = data.problem().with_values(patches=centres, weights=data.confidence, factors=depths)
        times = tuple(frame.timestamp for frame in data.frames)
        return cls(problem, times, window.bounds, window.settings.kernel)

    def with_frame(
        self, timestamp: float, pose_cw: np.ndarray, kk: np.ndarray, targets: np.ndarray, confidence: np.ndarray
    ) -> WindowMeasurements:
        """Same measurements with those of a frame that is not in the window.

        Args:
            timestamp: of the frame, seconds, after the others.
            pose_cw: ``(7,)`` world to camera.
            kk: ``(e,)`` patches of the window that were measured in it.
            targets, confidence: ``(e, 2)`` feature pixels, and as of the network.

        Returns:
            The measurements with one frame more, whose own patches have none.
        """
        p, m = self.problem, self.problem.per_frame
        index = torch.from_numpy(kk).to(p.kk)
        values = (p.poses_cw, pose_cw[None]), (p.targets, targets), (p.weights, confidence)
        poses, measured, weights = (torch.cat([own, torch.from_numpy(new).to(own)]) for own, new in values)
        problem = p.with_values(
            poses_cw=poses, targets=measured, weights=weights,
            patches=torch.cat([p.patches, p.patches[-m:]]), intrinsics=torch.cat([p.intrinsics, p.intrinsics[-1:]]),
            ii=torch.cat([p.ii, index // m]), jj=torch.cat([p.jj, torch.full_like(index, len(p.poses_cw))]),
            kk=torch.cat([p.kk, index]),
        )  # fmt: skip
        return replace(self, problem=problem, timestamps=(*self.timestamps, timestamp))

    def at(self, problem: PatchProblem) -> WindowMeasurements:
        """Same measurements at another solution.

        Args:
            problem: at the solution.

        Returns:
            The measurements with its poses and patches.
        """
        own = self.problem
        now = own.with_values(poses_cw=problem.poses_cw.to(own.poses_cw), patches=problem.patches.to(own.patches))
        return replace(self, problem=now)
