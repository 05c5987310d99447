"""Protocols that evo does not have: KITTI's segments, relative-pose AUC, per-frame scale.

Each function takes an estimate and a reference as camera-to-world trajectories in metres and seconds; a value without a
meaning is nan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import pose_matrices, poses_from_matrices
from dvo.metrics import associate
from dvo.metrics.relative_pose import relative_pose_errors

KITTI_LENGTHS = tuple(range(100, 801, 100))  # metres
KITTI_STEP = 10  # frames between the starts of two segments
AUC_DEGREES = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class SegmentErrors:
    """KITTI odometry's errors, averaged over all segments of 100 to 800 m that fit the sequence.

    Attributes:
        t_rel: translation, percent of the segment's length.
        r_rel: rotation, degrees per 100 m.
        longest_m: longest segment that entered; nan where the path is under 100 m and the two others are nan too.
    """

    t_rel: float = math.nan
    r_rel: float = math.nan
    longest_m: float = math.nan


def kitti_errors(
    estimate: Trajectory | Sequence[tuple[Trajectory, float]],
    reference: Trajectory,
    scale: float = 1.0,
    max_dt: float = 0.01,
) -> SegmentErrors:
    """Translation and rotation error over segments of 100, 200, ... 800 m of the reference (Geiger et al., CVPR 2012).

    A segment starts at every tenth frame of the reference and ends at the first frame beyond its length; it counts if
    the estimate has both ends. Lengths that the sequence does not reach are left out, as in KITTI's own tool.

    Args:
        estimate: camera to world; or pieces of one, each with its scale, of which one must have both ends.
        scale: factor on the estimate's translations, from the alignment.
    """
    distances = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(reference.positions, axis=0), axis=1))])
    truth = pose_matrices(reference.poses_wc)
    found = []
    for piece, factor in [(estimate, scale)] if isinstance(estimate, Trajectory) else estimate:
        i, j = associate(piece, reference, max_dt)
        rows = np.full(len(reference), -1)
        rows[j] = i
        track = pose_matrices(piece.poses_wc)
        track[:, :3, 3] *= factor
        for first in range(0, len(reference), KITTI_STEP):
            for length in KITTI_LENGTHS:
                last = int(np.searchsorted(distances, distances[first] + length, side="right"))
                if last >= len(reference) or rows[first] < 0 or rows[last] < 0:
                    continue
                step = np.linalg.inv(truth[first]) @ truth[last]
                error = np.linalg.inv(np.linalg.inv(track[rows[first]]) @ track[rows[last]]) @ step
                angle = math.acos(min(1.0, max(-1.0, (float(np.trace(error[:3, :3])) - 1) / 2)))
                found.append((float(np.linalg.norm(error[:3, 3])) / length, math.degrees(angle) / length, length))
    if not found:
        return SegmentErrors()
    table = np.array(found)
    return SegmentErrors(100 * table[:, 0].mean(), 100 * table[:, 1].mean(), table[:, 2].max())


def relative_pose_auc(
    estimate: Trajectory,
    reference: Trajectory,
    gap: int = 1,
    max_dt: float = 0.01,
    labels: np.ndarray | None = None,
) -> dict[float, float]:
    """Area under the recall curve of relative poses up to 1, 2, 5 and 10 degrees, in [0, 1]; scale plays no part.

    The errors are those of :func:`dvo.metrics.relative_pose.relative_pose_errors`. The area under a curve of steps is
    ``mean(max(0, 1 - error / threshold))``. A pair that the estimate lacks fails, and so does one whose frames lie in
    two segments: this area cannot be raised by cutting a trajectory.

    Args:
        estimate, reference: camera to world, seconds.
        gap: frames between the two of a pair.
        max_dt: largest difference of matched stamps, seconds.
        labels: segment of each row of the estimate; None for a single one.

    Returns:
        Area by threshold, degrees; nan for a reference that is too short.
    """
    errors = relative_pose_errors(estimate, reference, gap, max_dt, labels)
    if not len(errors):
        return dict.fromkeys(AUC_DEGREES, math.nan)
    return {limit: float(np.maximum(0, 1 - errors / limit).mean()) for limit in AUC_DEGREES}


def per_frame_scale(estimate: Trajectory, reference: Trajectory, max_dt: float = 0.01) -> Trajectory:
    """The estimate with every frame-to-frame translation rescaled to the reference's length, chained anew.

    This is how TartanVO and its heirs report; it hands the estimate one true number per frame, so its ATE stands in a
    column of its own and is never compared with an ordinary one. A step without a direction stays at zero.

    Args:
        estimate, reference: camera to world, seconds.
        max_dt: largest difference of matched stamps, seconds.

    Returns:
        Camera to world at the matched stamps of the reference.
    """
    i, j = associate(estimate, reference, max_dt)
    track = pose_matrices(estimate.poses_wc[i])
    truth = reference.positions[j]
    if len(i) < 2:
        return Trajectory(reference.timestamps[j], estimate.poses_wc[i])
    steps = np.diff(track[:, :3, 3], axis=0)
    have = np.linalg.norm(steps, axis=1, keepdims=True)
    want = np.linalg.norm(np.diff(truth, axis=0), axis=1, keepdims=True)
    steps = np.where(have > 1e-12, steps * want / np.maximum(have, 1e-12), 0.0)
    track[1:, :3, 3] = track[0, :3, 3] + np.cumsum(steps, axis=0)
    return Trajectory(reference.timestamps[j], poses_from_matrices(track))
