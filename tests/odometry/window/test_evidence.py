"""Thresholds of the evidence for a pose."""

from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.window.evidence import Evidence


def test_a_frame_after_an_interruption_needs_more_evidence():
    config = TrackerConfig(lost_confidence=0.01, min_inliers=0.02, search_inliers=0.04, join_inliers=0.1)
    weak, strong = Evidence(0.05, 0.05), Evidence(0.05, 0.2)
    continuous, retry, late = (config.policies[name] for name in ("continuous", "retry", "late"))
    first, searched = continuous.rounds
    (joined,) = retry.rounds
    assert late.rounds == retry.rounds and (retry.later, late.later) == (0, 1)

    def supports(evidence, inliers):
        return evidence.supports(continuous.confidence, inliers)

    assert supports(weak, first.inliers) and not supports(weak, joined.inliers)
    assert supports(strong, joined.inliers) and supports(weak, searched.inliers)
    assert not supports(Evidence(0.05, 0.03), searched.inliers)
    assert not supports(Evidence(0.005, 0.9), first.inliers) and not supports(Evidence(0.5, 0.01), first.inliers)
