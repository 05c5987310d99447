"""Graphs of several recordings, each with a clock of its own."""

import numpy as np
import pytest
import torch

from dvo.map.io.serialisation import load_graph, save_graph
from dvo.map.merging import append_graph, moved_edges
from dvo.map.recordings import begin_recording, count_earlier, increase, increasing_times
from dvo.odometry.global_ba.final_adjustment import adjust_segment
from tests.support.archived_walk import INTERVAL, archived_walk


def two_walks(dropped=()):
    """Graph of a walk of 20 frames and another one of 12 after it, at the same times; the second walk alone."""
    graph, (other, _) = archived_walk(20)[0], archived_walk(12, dropped=dropped)
    graph.begin_segment(20)
    begin_recording(graph)
    other.begin_segment(12)
    append_graph(graph, other)
    return graph, other


@pytest.mark.parametrize(
    ("times", "first", "rising"),
    [([0, 1, 2], [0], True), ([0, 1, 1], [0], False), ([5, 6, 1, 2], [0, 2], True), ([5, 6, 1, 1], [0, 2], False),
     ([5, 4, 1, 2], [0, 2], False), ([], [0], True), ([5, 6], [0, 2], True), ([5, 1], [0, 1, 1], True)],
)  # fmt: skip
def test_times_increase_within_a_recording(times, first, rising):
    assert increase(np.array(times, float), first) is rising


def test_recordings_follow_each_other_on_one_clock():
    graph, _ = two_walks()
    frames = list(graph.archive)
    times = increasing_times(graph, frames)
    assert (times.diff() > 0).all()
    own = [frame.timestamp for frame in frames[20:]]
    assert times[20:].tolist() == own and own[0] == 0.0
    torch.testing.assert_close(times[:20].diff(), torch.full((19,), INTERVAL, dtype=torch.float64))
    assert increasing_times(graph, frames[:5]).tolist() == [frame.timestamp for frame in frames[:5]]
    assert count_earlier(graph, np.arange(32)) == 20


def test_an_appended_graph_is_that_of_the_other_with_new_numbers():
    graph, other = two_walks(dropped=(5,))
    assert graph.segment == 2 and [graph.segment_of(k) for k in (19, 20, 31, 32)] == [0, 1, 1, 2]
    mine, alone = graph.problem(segment=1), other.problem()
    assert np.array_equal(mine.identifiers, alone.identifiers + 20)
    for name in ("poses_cw", "patches", "intrinsics", "targets", "weights", "ii", "jj", "kk"):
        assert torch.equal(getattr(mine, name), getattr(alone, name)), name
    assert np.array_equal(graph.log.trajectory(1).poses_wc, other.log.trajectory().poses_wc)
    assert graph.archive.config.max_bytes == 2 * other.archive.config.max_bytes
    assert moved_edges(other.archive.parts[0].unpack(), 7).source.dtype == np.int32


def test_recordings_outlast_a_file(tmp_path):
    graph, _ = two_walks()
    save_graph(tmp_path / "a.dvo", graph)
    found = load_graph(tmp_path / "a.dvo")
    assert found.recordings == graph.recordings
    assert np.array_equal(found.log.trajectory().timestamps, graph.log.trajectory().timestamps)


def test_the_adjustment_holds_earlier_recordings():
    """The second walk in the world of the first, whose poses drift: only the second one is solved."""
    graph, _ = two_walks()
    graph.join(1, 0)
    edges = moved_edges(graph.archive.parts[-1].unpack(), 0)
    graph.add_loop(edges)
    before = {frame.identifier: frame.pose_cw.copy() for frame in graph.archive}
    assert adjust_segment(graph, 0) == 32
    moved = [not np.array_equal(frame.pose_cw, before[frame.identifier]) for frame in graph.archive]
    assert not any(moved[:20]) and all(moved[20:])
