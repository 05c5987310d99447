"""Thresholds of the support of a pose."""

from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.window.pose_validation import PoseSupport


def test_a_frame_after_an_interruption_needs_more_support():
    config = TrackerConfig(lost_confidence=0.01, min_inliers=0.02, search_inliers=0.04, join_inliers=0.1)
    weak, strong = PoseSupport(0.05, 0.05), PoseSupport(0.05, 0.2)
    continuous, retry, late = (config.policies[name] for name in ("continuous", "retry", "late"))
    first, searched = continuous.rounds
    (joined,) = retry.rounds
    assert late.rounds == retry.rounds and (retry.later, late.later) == (0, 1)

    def supports(support, inliers):
        return support.reaches(continuous.confidence, inliers)

    assert supports(weak, first.inliers) and not supports(weak, joined.inliers)
    assert supports(strong, joined.inliers) and supports(weak, searched.inliers)
    assert not supports(PoseSupport(0.05, 0.03), searched.inliers)
    assert not supports(PoseSupport(0.005, 0.9), first.inliers) and not supports(PoseSupport(0.5, 0.01), first.inliers)
