"""Decision about a pair of visits that the network has matched: a loop or not."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dvo.geometry import se3, so3
from dvo.map.archive import ArchivedKeyframe
from dvo.odometry.loops.guess import Pair
from dvo.odometry.loops.joint_window import Match


@dataclass(frozen=True)
class Limits:
    """When a match is a loop, and when two loops confirm each other.

    Attributes:
        inliers: share among all patches of both visits with which a match is a loop.
        weak_inliers: the same, with which it is one if the pose agrees with the present one as closely as two loops
            that confirm each other.
        translation, rotation, scale: largest differences of the corrections of two loops that confirm each other, in
            median depths, degrees, and as a ratio less one; largest corrections of a loop with few inliers.
        corner_scale: largest difference of the scale of such a loop from that of corners, as a ratio less one: it comes
            from the depths of few patches, and the loop that confirms it has to agree within ``scale``.
    """

    inliers: float = 0.4
    weak_inliers: float = 0.12
    translation: float = 0.2
    rotation: float = 3.0
    scale: float = 0.1
    corner_scale: float = 0.5


def is_loop(match: Match, pair: Pair, limits: Limits = Limits()) -> bool:  # noqa: B008 (frozen)
    """Decide if a match is a loop.

    Many inliers suffice. Fewer may come from another place with the same texture: bundle adjustment fits them as well,
    but to a pose that has nothing to do with the present one. They count only if both agree, as two loops that confirm
    each other have to; where the present poses have drifted further, a view with many inliers has to come first.
    Between segments with worlds of their own there are no present poses to agree with; a pose from corners, which the
    network has no part in, takes their place where there is one.

    Args:
        match: of the pair.
        pair: that was matched.
        limits: thresholds.

    Returns:
        True if it is.
    """
    if match.inliers >= limits.inliers:
        return True
    if pair.present_cw is None or not match.inliers >= limits.weak_inliers:
        return False
    later = [frame.identifier for frame in pair.new].index(pair.candidate.new)
    moved = se3.relative(pair.present_cw, match.poses_cw[len(pair.old) + later])
    far = float(moved[:3].norm()) * median_inverse_depth(pair.new[later])
    angle, scale = float(so3.angle(moved[3:]).rad2deg()), max(match.scale, 1 / match.scale) - 1
    most = limits.corner_scale if pair.joins else limits.scale
    return far <= limits.translation and angle <= limits.rotation and scale <= most


def median_inverse_depth(keyframe: ArchivedKeyframe) -> float:
    """Median inverse depth of the patches of a keyframe, in inverse units of its segment; nan once they are released.

    Args:
        keyframe: archived.
    """
    return float(np.median(keyframe.inverse_depth)) if len(keyframe.inverse_depth) else math.nan
