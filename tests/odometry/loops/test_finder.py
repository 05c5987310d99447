"""Candidates of the search for loops."""

from types import SimpleNamespace

import pytest

from dvo.odometry.loops.finder import AFTER_BREAK, LoopFinder


def finder(segments, worlds, begun=0):
    """Finder of kept keyframes 0, 2, 4, ..., each of a segment; segments have worlds."""
    graph = SimpleNamespace(
        segment_of=lambda k: segments[k // 2], world_of=lambda segment: worlds[segment],
        recording=SimpleNamespace(keyframe=begun),
    )  # fmt: skip
    return LoopFinder(graph, None, None, kept=[2 * k for k in range(len(segments))])


APART, JOINED = {0: 0, 1: 1}, {0: 0, 1: 0}


@pytest.mark.parametrize(
    ("row", "worlds", "begun", "last"),
    [(5, APART, 0, 8), (6, APART, 0, 8), (4 + AFTER_BREAK, APART, 0, 8), (5 + AFTER_BREAK, APART, 0, None),
     (5, JOINED, 0, None), (3, APART, 0, None), (6, APART, 10, None)],
)  # fmt: skip
def test_the_last_keyframe_before_a_break(row, worlds, begun, last):
    """It is a candidate for the first keyframes after it, while their segment has a world of its own."""
    found = finder([0] * 5 + [1] * 30, worlds, begun)
    assert found._before_break(2 * row) == last


def test_a_segment_without_poses_is_no_candidate():
    assert finder([-1] * 5 + [1] * 5, {-1: -1, 1: 1})._before_break(12) is None
