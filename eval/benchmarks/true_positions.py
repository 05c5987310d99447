"""True positions of the patches of a tracker's window, on a rendered sequence."""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.map.window import Window
from dvo.synth.sequence import SyntheticSequence

_OCCLUDED = 0.95  # a point this much farther away than what is seen there is hidden


class TruePositions:
    """True positions of edges.

    Args:
        sequence: rendered, of the size of the working image, of a scene that does not move.
        depth: ``(N, H, W)`` of its frames.
    """

    def __init__(self, sequence: SyntheticSequence, depth: Tensor) -> None:
        self.depth = depth
        self.times = torch.from_numpy(sequence.groundtruth.timestamps)
        self.poses_cw = se3.inverse(torch.from_numpy(sequence.groundtruth.poses_wc)).float()

    def find(self, window: Window, edges: Tensor | slice = slice(None)) -> tuple[Tensor, Tensor]:
        """True positions of the patch centres in the frames that their edges lead to.

        Args:
            window: of a tracker of the sequence.
            edges: ``(e,)`` positions among its edges.

        Returns:
            ``(e, 2)`` feature pixels, and ``(e,)`` bool, True where the patch is seen there.
        """
        ii, jj, kk = window.ii[edges], window.jj[edges], window.kk[edges]
        patches, intrinsics = window.patches[None], window.intrinsics[None]
        centre = patches.shape[-1] // 2
        stamps = torch.tensor([frame.timestamp for frame in window.frames], dtype=torch.float64)
        frames = (stamps[:, None] - self.times).abs().argmin(1)
        x, y = (4 * patches[0, :, axis, centre, centre].round().long() for axis in (0, 1))
        exact = patches.clone()
        depth = self.depth[frames.repeat_interleave(window.per_frame), y, x]
        exact[0, :, 2] = (1 / depth.clamp(min=1e-6))[:, None, None]
        true = reproject(self.poses_cw[frames][None], exact, intrinsics, ii, jj, kk)
        positions = true.coords[0, :, centre, centre]
        h, w = self.depth.shape[1:]
        column, row = (4 * positions).round().long().unbind(-1)
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        there = self.depth[frames[jj], row.clamp(0, h - 1), column.clamp(0, w - 1)]
        points = torch.cat([exact[0, :, :2, centre, centre], torch.ones(len(depth), 1)], 1)
        focal, principal = intrinsics[0, ii].split(2, -1)
        rays = torch.cat([(points[kk, :2] - principal) / focal, points[kk, 2:]], 1)
        relative = se3.relative(self.poses_cw[frames[ii]], self.poses_cw[frames[jj]])
        distance = se3.act(relative, rays * depth[kk, None])[:, 2]
        seen = true.valid[0, :, centre, centre] & inside & (depth[kk] > 0) & (there > _OCCLUDED * distance)
        return positions, seen
