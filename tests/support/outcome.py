"""Results and estimates as values that are equal only if every byte is."""

from __future__ import annotations


def content(result):
    """All of a result as bytes."""
    rows = [
        segment.trajectory.poses_wc.tobytes() + segment.trajectory.timestamps.tobytes() for segment in result.segments
    ]
    return [
        *rows,
        result.map.points.tobytes(),
        result.map.colors.tobytes(),
        repr(result.breaks),
        repr(sorted(result.info.items())),
    ]


def told(estimate):
    pose = None if estimate.pose_wc is None else estimate.pose_wc.tobytes()
    covariance = None if estimate.covariance is None else estimate.covariance.tobytes()
    known = estimate.confidence, estimate.reference, covariance
    return estimate.timestamp, pose, estimate.status, known, estimate.segment, estimate.reason
