"""References in another convention than poses of the camera in a right-handed world."""

from __future__ import annotations

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import invert_poses
from dvo.metrics.metrics import evaluate

_LEAST = 2.0  # % of the path: smaller errors need no other explanation
_SHARE = 0.25  # of the error, that another convention leaves at most
_MATCHES = 10
_MIRROR = np.array([-1, 1, 1, 1, -1, -1, 1.0])
_INVERTED = "poses of the world in the camera (T_cw): invert them"
_MIRRORED = "those of a left-handed system (Unity, Unreal): mirror one axis"


def other_convention(estimate: Trajectory, reference: Trajectory, max_dt: float = 0.01) -> str | None:
    """What a reference looks like, if the estimate fits it far better in another convention.

    Args:
        estimate: camera to world.
        reference: that should be camera to world, in a right-handed system.
        max_dt: largest difference of matched timestamps, seconds.

    Returns:
        End of a sentence; None where the reference fits, or no other convention explains that it does not.
    """
    usual = evaluate(estimate, reference, max_dt=max_dt)
    if usual.reason is not None or not usual.ate_percent > _LEAST or usual.matched < _MATCHES:
        return None
    others = {_INVERTED: invert_poses(reference.poses_wc), _MIRRORED: reference.poses_wc * _MIRROR}
    for text, poses in others.items():
        found = evaluate(estimate, Trajectory(reference.timestamps, poses), max_dt=max_dt)
        if found.reason is None and found.ate_percent < _SHARE * usual.ate_percent:
            return text
    return None
