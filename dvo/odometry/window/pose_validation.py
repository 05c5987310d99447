"""Pose validation: agreement of the measurements of a frame with the window, and motion between frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.core.kernels import use_kernels
from dvo.geometry import se3
from dvo.geometry.bounds import MIN_Z_DIVISION
from dvo.geometry.projection import reproject
from dvo.map.window import Window
from dvo.odometry.frames.content import MATCHED, matched_share

CONFIDENT = 0.1
"""Confidence of a measurement above which it can be an inlier."""
AGREEMENT = 0.5
"""Largest distance of an inlier from the reprojection of its patch after bundle adjustment, feature pixels."""
LONGEST = 1e3
"""Flow of a patch at most, in the mean flow of a frame pair, feature pixels."""


@dataclass(frozen=True)
class PoseSupport:
    """Agreement of the measurements of a frame with those before it in the window.

    Attributes:
        confidence: mean confidence of the edges from these frames and its own patches into the frame, in [0, 1].
        inliers: share of the patches of earlier frames that are found in it: confident, and where bundle adjustment
            reprojects them, in [0, 1].
    """

    confidence: float
    inliers: float

    def reaches(self, confidence: float, inliers: float) -> bool:
        """Decide if the pose is valid.

        Args:
            confidence, inliers: least values of a valid pose.

        Returns:
            True if both values are reached.
        """
        return self.confidence >= confidence and self.inliers >= inliers


def support_of(window: Window, position: int) -> PoseSupport:
    """Support of the pose of a frame of a window, after a step; later frames do not count.

    Args:
        window: after a step.
        position: of the frame in the window.

    Returns:
        Support; without inliers for the first frame.
    """
    found = _by_kernel(window, position)
    if found is not None:
        return found
    into = measured(window, window.confidence, (window.jj == position) & (window.ii <= position)).nonzero()[:, 0]
    if not len(into):
        return PoseSupport(0.0, 0.0)
    earlier = into[window.ii[into] < position]
    confidence = float(window.confidence[into].mean())
    if not len(earlier):
        return PoseSupport(confidence, 0.0)
    return PoseSupport(confidence, _inliers(window, earlier))


def _by_kernel(w: Window, position: int) -> PoseSupport | None:
    """The same by a compiled loop; None where it is not one for kernels."""
    floats = w.poses_cw, w.patches, w.intrinsics, w.targets, w.confidence
    if not use_kernels(*floats):
        return None
    from dvo.odometry.window.window_kernels import support

    poses, patches, intrinsics, targets, confidence = (x.detach().contiguous().numpy() for x in floats)
    jj, kk = w.jj.contiguous().numpy(), w.kk.contiguous().numpy()
    good, *values = support(
        position, w.visible is not None, jj, kk, w.per_frame, poses, patches, intrinsics, targets, confidence,
        CONFIDENT, AGREEMENT, MIN_Z_DIVISION,
    )  # fmt: skip
    return PoseSupport(*values) if good else None


def measured(window: Window, confidence: Tensor, among: Tensor) -> Tensor:
    """Edges whose measurement counts: those that do not lie in ignored pixels.

    Args:
        window: of the edges.
        confidence: ``(E, 2)``, 0 for measurements in ignored pixels.
        among: ``(E,)`` bool.

    Returns:
        ``(E,)`` bool; ``among`` itself if no frame has a mask.
    """
    return among if window.visible is None else among & (confidence != 0).any(dim=-1)  # NaN speaks against the pose


def last_unrelated(window: Window, least_confidence: float, least_inliers: float) -> int:
    """Position after the last pair of consecutive frames of a window that do not show the same scene.

    Args:
        window: after some steps.
        least_confidence, least_inliers: of two frames that show the same scene.

    Returns:
        Position of the first frame that all later ones are related to; 0 if all frames are.
    """
    found = 0
    for position in range(1, len(window)):
        pair = (window.ii == position - 1) & (window.jj == position)
        pair |= (window.ii == position) & (window.jj == position - 1)
        if not bool(pair.any()):  # its edges have left the window: nothing speaks against the two any more
            continue
        pair = measured(window, window.confidence, pair)
        confidence, inliers = float(window.confidence[pair].mean()), _inliers(window, pair)
        if confidence >= least_confidence and inliers >= least_inliers:
            continue
        # Where most of the picture is sky or water few patches agree, although both frames show the same.
        before, after = window.frames[position - 1].image, window.frames[position].image
        if before is None or after is None or math.isnan(confidence) or matched_share(before, after) < MATCHED:
            found = position
    return found


def related_share(window: Window, among: Tensor) -> float:
    """Share of the edges between different frames that are inliers.

    Args:
        window: after a step.
        among: ``(E,)`` bool, edges that count.

    Returns:
        In [0, 1]; 0 without such an edge.
    """
    edges = measured(window, window.confidence, among & (window.ii != window.jj))
    return _inliers(window, edges) if bool(edges.any()) else 0.0


def _inliers(w: Window, edges: Tensor) -> float:
    seen = reproject(w.poses_cw[None], w.patches[None], w.intrinsics[None], w.ii[edges], w.jj[edges], w.kk[edges])
    centre = seen.coords.shape[2] // 2
    residual = (w.targets[edges] - seen.coords[0, :, centre, centre]).norm(dim=-1)
    found = (w.confidence[edges].mean(dim=-1) > CONFIDENT) & (residual < AGREEMENT)
    return float(found.float().mean())


def _displacement(window: Window, i: int, j: int, rotation: bool) -> tuple[Tensor, Tensor]:
    """Patch centres of frame ``i`` reprojected into frame ``j``, and the same with a part of the motion alone.

    Args:
        window: keyframes.
        i, j: positions in the window.
        rotation: the part is the rotation (True) or the translation (False).

    Returns:
        ``(M, 2)`` positions under the whole motion and ``(M, 2)`` under the part, feature pixels.
    """
    m = window.per_frame
    device = window.patches.device
    patches = window.patches[None, i * m : (i + 1) * m]
    motion = se3.relative(window.poses_cw[i], window.poses_cw[j])
    part = motion.clone()
    if rotation:
        part[:3] = 0
    else:
        part[3:6], part[6] = 0, 1
    poses = torch.stack([se3.identity(device=device), motion, part])[None]
    intrinsics = torch.stack([window.frames[k].intrinsics for k in (i, j, j)])[None]
    kk = torch.arange(m, device=device)
    c = patches.shape[-1] // 2
    targets = torch.arange(1, 3, device=device).repeat_interleave(m)
    there = reproject(poses, patches, intrinsics, torch.zeros_like(targets), targets, kk.repeat(2)).coords
    whole, only = there[0, :, c, c].split(m)
    return whole, only


def parallax(window: Window, i: int, j: int, share: float = 0.5) -> float:
    """Parallax of a frame pair: displacement that translation adds to the rotational flow.

    Args:
        window: keyframes.
        i, j: positions of source and target frame in the window.
        share: of the patches that have as much.

    Returns:
        Feature pixels.
    """
    whole, only = _displacement(window, i, j, rotation=True)
    return float((whole - only).norm(dim=-1).quantile(1 - share))


def flow_magnitude(window: Window, i: int, j: int) -> float:
    """Mean flow of a frame pair, half of it without the rotation (``flow_mag`` of DPVO with beta 0.5).

    Args:
        window: keyframes.
        i, j: positions of source and target frame in the window.

    Returns:
        Feature pixels.
    """
    m = window.per_frame
    patches, of_i, of_j = window.patches[i * m : (i + 1) * m], window.frames[i].intrinsics, window.frames[j].intrinsics
    floats = window.poses_cw[i], window.poses_cw[j], of_i, of_j, patches
    if use_kernels(*floats) and len(patches):
        from dvo.odometry.window.window_kernels import mean_flow

        first, second, of_first, of_second, seen = (x.detach().contiguous().numpy() for x in floats)
        return mean_flow(first, second, of_first, of_second, seen, MIN_Z_DIVISION, LONGEST)
    whole, only = _displacement(window, i, j, rotation=False)
    c = window.patches.shape[-1] // 2
    start = patches[:, :2, c, c]
    moved = 0.5 * (whole - start).norm(dim=-1) + 0.5 * (only - start).norm(dim=-1)
    return float(moved.clamp(max=LONGEST).mean())
