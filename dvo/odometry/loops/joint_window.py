"""Matching of two groups of archived keyframes by the network.

A loop edge is measured as any other edge of the tracker: patches are reprojected into the other frame, correlated
there and revised by the update operator, and poses and inverse depths are fitted to the revised positions by bundle
adjustment. Poses of the older group are held; those of the newer group move, and its inverse depths with the scale.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3, so3
from dvo.map.archive import ArchivedKeyframe
from dvo.map.features import FeatureCache
from dvo.map.measurements import ArchivedEdges
from dvo.map.window import Keyframe, Window
from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.odometry.frames.front_end import encode_image
from dvo.odometry.window.patch_window import PatchWindow, StepSettings
from dvo.odometry.window.pose_validation import related_share

Group = tuple[ArchivedKeyframe, ...]
"""Keyframe with its neighbours."""

SETTLED_CHANGES = (0.001, 0.0002, 0.001)
"""Change by an update below which further ones bring nothing: translation in median depths, rotation in rad, log scale.
A tenth of the standard deviations of a loop in the pose graph (:mod:`dvo.odometry.loops.correction`)."""
_MAPS = 8  # keyframes whose feature maps are kept for the next match: a search may last for many frames


@dataclass(frozen=True)
class Match:
    """Outcome of a match of two groups.

    Attributes:
        inliers: share of the edges between the groups whose measurement is confident and agrees with bundle adjustment.
        poses_cw: ``(n, 7)`` float64 ``T_cw`` of the older and the newer group, in the world and the scale of the older.
        scale: of the lengths of the newer group, after over before.
        depths: ``(K,)`` inverse depths of the patches of the newer group, in the scale of the older.
        edges: measurements between the groups, aligned to a fraction of a pixel where that is possible.
    """

    inliers: float
    poses_cw: Tensor
    scale: float
    depths: Tensor
    edges: ArchivedEdges


class GroupMatcher:
    """Matcher of groups of archived keyframes.

    Args:
        model: the network.
        settings: of the measurements.
        device: of the computation.
    """

    def __init__(self, model: PatchVO, settings: StepSettings, device: torch.device) -> None:
        self.model, self.settings, self.device = model, settings, device
        self.maps = FeatureCache(lambda image: encode_image(model, image, device).matching, _MAPS)

    def can_match(self, frame: ArchivedKeyframe) -> bool:
        """Return True if a keyframe still has what a match needs: image, patches, and features of this network."""
        c = self.model.config
        if frame.jpeg is None or frame.matching is None or frame.context is None:
            return False
        return frame.matching.shape[1] == c.feature_channels and frame.context.shape[1] == c.hidden_channels

    def match(
        self, old: Group, new: Group, poses_cw: Tensor, decisions: Sequence[tuple[int, float]]
    ) -> Generator[None, None, Match | None]:
        """Match two groups, in steps of similar length: an image is encoded, or an update is done.

        Args:
            old, new: keyframes; each :meth:`can_match`.
            poses_cw: ``(n, 7)`` poses ``T_cw`` of the older and the newer group to start from, in the world of the
                older.
            decisions: numbers of updates, each with the share of inliers below which the groups do not match. Of the
                last ones fewer are done once poses and scale stay.

        Returns:
            The match; None if the groups do not show the same.
        """
        sizes = set()
        for frame in (*old, *new):
            if not self.maps.has(frame):
                yield
            maps = self.maps.maps(frame)
            sizes.add(None if maps is None else maps.shape)
        if len(sizes) != 1 or None in sizes:  # an image that cannot be read, or images of two sizes
            return None
        yield
        joint = self._joint(old, new, poses_cw)
        window, count = joint.window, len(old)
        across = (window.ii < count) != (window.jj < count)
        before = _newer(window, count)[1]
        share = 0.0
        for row, (number, inliers) in enumerate(decisions):
            for _ in range(number):
                yield
                start = _newer(window, count)
                joint.step(count)
                if row == len(decisions) - 1 and _is_settled(start, _newer(window, count)):
                    break
            share = related_share(window, across)
            if not share >= inliers:  # NaN fails too
                return None
        yield
        joint.finalise(across.nonzero()[:, 0])
        after = window.patches[count * window.per_frame :, 2, 0, 0]
        scale = float((before / after).median())
        poses = se3.normalise(window.poses_cw.double().cpu())
        if not (np.isfinite(scale) and scale > 0 and bool(torch.isfinite(poses).all())):
            return None
        return Match(share, poses, scale, after.float().cpu(), self._edges((*old, *new), window, across))

    def _joint(self, old: Group, new: Group, poses_cw: Tensor) -> PatchWindow:
        """Window of both groups with all edges but those within the older one."""
        joint = PatchWindow.empty(self.model, len(new[0].centres), self.settings, self.device)
        window, device = joint.window, self.device
        for slot, frame in enumerate((*old, *new)):
            self._append(joint, slot, frame, poses_cw[slot])
        m, n = window.per_frame, len(window)
        pairs = [(i, j) for i, j in product(range(n), range(n)) if max(i, j) >= len(old)]
        kk = torch.cat([torch.arange(i * m, (i + 1) * m, device=device) for i, _ in pairs])
        jj = torch.tensor([j for _, j in pairs], device=device).repeat_interleave(m)
        joint.window.connect(kk, jj)
        return joint

    def _append(self, joint: PatchWindow, slot: int, frame: ArchivedKeyframe, pose_cw: Tensor) -> None:
        device, image, maps = self.device, frame.image(), self.maps.maps(frame)
        assert image is not None and maps is not None and frame.matching is not None and frame.context is not None
        centres = torch.from_numpy(frame.centres)[None, None].to(device)
        matching, context = (torch.from_numpy(x).float().to(device) for x in (frame.matching, frame.context))
        intrinsics, colors = torch.from_numpy(frame.intrinsics).to(device), torch.from_numpy(frame.colors)
        keyframe = Keyframe(frame.identifier, frame.timestamp, slot, matching, context, colors, intrinsics, image)
        depth = torch.from_numpy(frame.inverse_depth)[None].to(device)
        patches = patch_coordinates(centres, depth, self.model.config.patch_size)[0]
        joint.insert(slot, keyframe, maps, pose_cw.to(patches), patches)

    @staticmethod
    def _edges(group: Group, window: Window, across: Tensor) -> ArchivedEdges:
        known = across & (window.weights > 0).any(-1)
        frames, m = np.array([frame.identifier for frame in group], dtype=np.int32), window.per_frame
        kk, jj = window.kk[known].cpu().numpy(), window.jj[known].cpu().numpy()
        position, weight = (x[known].float().cpu().numpy() for x in (window.targets, window.weights))
        return ArchivedEdges(
            frames[kk // m], (kk % m).astype(np.int16), frames[jj], position, weight.astype(np.float16)
        )


def _newer(window: Window, count: int) -> tuple[Tensor, Tensor]:
    """Poses ``(n, 7)`` and inverse depths ``(m,)`` of the newer group; ``count`` keyframes are of the older."""
    return window.poses_cw[count:].clone(), window.patches[count * window.per_frame :, 2, 0, 0].clone()


def _is_settled(before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> bool:
    """Return True if an update has changed poses and scale of the newer group by next to nothing."""
    moved = se3.relative(before[0], after[0])
    changes = moved[:, :3].norm(dim=-1).max() * after[1].median(), so3.angle(moved[:, 3:]).max()
    scale = (before[1] / after[1]).median().log().abs()
    return all(float(change) <= limit for change, limit in zip((*changes, scale), SETTLED_CHANGES, strict=True))
