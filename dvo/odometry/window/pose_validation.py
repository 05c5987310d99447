"""Pose validation: agreement of the measurements of a frame with the window."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from dvo.core.kernels import use_kernels
from dvo.geometry.bounds import MIN_Z_DIVISION
from dvo.geometry.projection import reproject
from dvo.map.window import Window
from dvo.odometry.frames.content import MATCHED, matched_share

CONFIDENT = 0.1
"""Confidence of a measurement above which it can be an inlier."""
AGREEMENT = 0.5
"""Largest distance of an inlier from the reprojection of its patch after bundle adjustment, feature pixels."""


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


def newest_support(window: Window) -> PoseSupport:
    """Support of the pose of the newest frame of a window, after a step.

    Args:
        window: after a step.

    Returns:
        Support; zero for a window of one frame.
    """
    return support_of(window, len(window) - 1)


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
