"""Decision about a pair of visits that the network has matched: a loop or not."""

from __future__ import annotations

import math

import numpy as np

from dvo.geometry import se3, so3
from dvo.graph.archive import ArchivedKeyframe
from dvo.odometry.loop_guess import Pair
from dvo.odometry.loop_options import LoopOptions
from dvo.odometry.loop_window import Match


def is_loop(match: Match, pair: Pair, options: LoopOptions) -> bool:
    """Decide if a match is a loop.

    Many inliers suffice. Fewer may come from another place with the same texture: bundle adjustment fits them as well,
    but to a pose that has nothing to do with the present one. They count only if both agree, as two loops that confirm
    each other have to; where the present poses have drifted further, a view with many inliers has to come first.
    Between segments with worlds of their own there are no present poses to agree with.

    Args:
        match: of the pair.
        pair: that was matched.
        options: thresholds.

    Returns:
        True if it is.
    """
    o = options
    if match.inliers >= o.inliers:
        return True
    if pair.present_cw is None or not match.inliers >= o.weak_inliers:
        return False
    later = [frame.identifier for frame in pair.new].index(pair.candidate.new)
    moved = se3.relative(pair.present_cw, match.poses_cw[len(pair.old) + later])
    far = float(moved[:3].norm()) * median_inverse_depth(pair.new[later])
    angle, scale = float(so3.angle(moved[3:]).rad2deg()), max(match.scale, 1 / match.scale) - 1
    return far <= o.translation and angle <= o.rotation and scale <= o.scale


def median_inverse_depth(keyframe: ArchivedKeyframe) -> float:
    """Median inverse depth of the patches of a keyframe, in inverse units of its segment; nan once they are released.

    Args:
        keyframe: archived.
    """
    return float(np.median(keyframe.inverse_depth)) if len(keyframe.inverse_depth) else math.nan
