"""Correction by a pose graph: what it is prepared from, and what moves along."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.geometry import se3, sim3
from dvo.odometry.loops import correction
from dvo.odometry.loops.finder import Loop
from tests.support.archived_walk import archived_walk


def loop_of(graph, kept, old, new):
    """Loop that asks for a correction."""
    poses = graph.poses_cw(np.array([kept[old], kept[new]]))
    measured = sim3.from_se3(se3.relative(*poses), 1.05).clone()
    measured[0] += 0.1
    return Loop(kept[old], kept[new], 0.0, 1.0, "proximity", 0.5, measured, 10, None)


@pytest.fixture
def walk():
    graph, _ = archived_walk(frames=12, dropped=(4, 5, 9))
    return graph, [frame.identifier for frame in graph.archive if frame.anchor is None]


def test_a_change_of_the_graph_does_not_reach_what_is_solved_beside_it(walk):
    graph, kept = walk
    loop = loop_of(graph, kept, 0, 7)
    still = graph.archived()
    identifiers, expected = correction.solve(graph, kept, [loop], loop)
    graph.correct(kept[3], np.array([9.0, 0, 0, 0, 0, 0, 1]), 5 * graph.archive[kept[3]].inverse_depth)
    graph.archive.add(replace(graph.archive[kept[-1]], identifier=99))
    graph.begin_segment(kept[-1])
    graph.join(1, 0)
    found = correction.solve(still, kept, [loop], loop)
    assert np.array_equal(found[0], identifiers) and identifiers.tolist() == kept
    assert torch.equal(found[1], expected) and (expected[:, 7] != 1).any()


def test_keyframes_that_were_archived_meanwhile_move_with_the_last_before_them(walk):
    graph, kept = walk
    loop = loop_of(graph, kept, 0, 5)
    known = kept[:-2]
    identifiers, found = correction.solve(graph, known, [loop], loop)
    before = graph.poses_cw(np.array(kept))
    units = correction.apply(graph, kept, loop, identifiers, found).units
    assert list(units) == kept and [units[k] for k in known] == found[:, 7].tolist()
    after, last = graph.poses_cw(np.array(kept)), len(known) - 1
    for row, k in enumerate(kept):
        anchor = min(row, last)
        step = sim3.from_se3(se3.relative(before[anchor], before[row]))
        expected = found[row] if row <= last else sim3.compose(step, found[last])
        assert torch.equal(after[row], torch.cat([expected[:3] / expected[7:], expected[3:7]]))
        assert units[k] == float(expected[7])


def test_a_correction_of_the_window_is_told(walk):
    graph, kept = walk
    loop = loop_of(graph, kept, 0, 7)
    last = np.array(kept[-1:])
    before = sim3.from_se3(graph.poses_cw(last))
    (told,) = correction.apply(graph, kept, loop, *correction.solve(graph, kept, [loop], loop)).worlds
    assert told.window and told.world == graph.world_of(graph.segment)
    assert told.time == graph.archive[kept[-1]].timestamp
    moved = sim3.compose(before, sim3.inverse(told.change[None]))
    expected = graph.poses_cw(last)
    assert float(told.change[7]) != 1
    torch.testing.assert_close(moved[:, :3] / moved[:, 7:], expected[:, :3], rtol=0, atol=1e-6)
    torch.testing.assert_close(moved[:, 3:7], expected[:, 3:7], rtol=0, atol=1e-6)
