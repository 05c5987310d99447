"""Views of a keyframe graph between two frames, for observers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dvo.geometry.poses import invert_poses
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.window import Keyframe
from dvo.session.observer import archived_lines, graph_of, window_view

FOCAL = torch.tensor([80.0, 60.0, 40.0, 30.0])  # of the feature map


@pytest.fixture
def graph() -> KeyframeGraph:
    """Four keyframes at x = 0, 1, 2, 3 that look along z; two patches each, of inverse depth 0.5 and 0.25."""
    graph = KeyframeGraph(2, 3, 4, torch.device("cpu"))
    for number in range(4):
        features = torch.zeros(2, 1, 1, 1), torch.zeros(2, 4)
        colors = torch.tensor([[number, 1, 2], [number, 3, 4]], dtype=torch.uint8)
        keyframe = Keyframe(number, 0.5 * number, number, *features, colors, FOCAL)
        patches = torch.zeros(2, 3, 3, 3)
        patches[:, 0], patches[:, 1] = 48, 36
        patches[0, 2], patches[1, 2] = 0.5, 0.25
        graph.window.append(keyframe, torch.tensor([-float(number), 0, 0, 0, 0, 0, 1]), patches)
    window = graph.window
    window.connect(torch.tensor([0, 1, 6, 7]), torch.tensor([3, 3, 0, 3]))
    window.targets = torch.tensor([[40.0, 30], [56, 36], [1, 1], [48, 36]])
    window.confidence = torch.tensor([[0.2, 0.4], [0.9, 0.9], [0.6, 0.6], [0.5, 0.5]])
    window.weights = torch.ones(4, 2)
    return graph


def test_the_window_in_the_world_and_in_the_newest_image(graph):
    view = window_view(graph)
    assert view is not None and view.timestamp == 1.5
    np.testing.assert_allclose(view.poses_wc[:, :3], [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(view.patches, [[0.1, 0.1], [0.1, 0.1]], atol=1e-6)
    np.testing.assert_allclose(view.matches, [[0, 0], [0.2, 0.1]], atol=1e-6, err_msg="edges of other frames only")
    np.testing.assert_allclose(view.confidence, [0.3, 0.9], atol=1e-6)
    assert view.pairs.tolist() == [[0, 3]]
    np.testing.assert_allclose(view.pair_confidence, [0.6], atol=1e-6)
    np.testing.assert_allclose(view.points[:2], [[0.2, 0.2, 2], [0.4, 0.4, 4]], atol=1e-6)
    np.testing.assert_allclose(view.points[6], [3.2, 0.2, 2], atol=1e-6)
    assert view.colors[6].tolist() == [3, 1, 2]


def test_edges_without_an_update_and_far_points_are_left_out(graph):
    graph.window.confidence = torch.zeros(4, 2)
    graph.window.patches[0, 2] = 1e-4
    view = window_view(graph)
    assert view is not None and len(view.matches) == len(view.pairs) == 0 and len(view.points) == 7


def test_the_view_is_a_copy(graph):
    before = window_view(graph)
    points = before.points.copy()
    graph.window.patches *= 2
    graph.window.poses_cw *= 2
    np.testing.assert_array_equal(before.points, points)


def test_archived_lines_join_kept_keyframes_of_one_world(graph):
    assert archived_lines(graph).shape == (0, 2, 3)
    graph.archive_oldest()
    assert archived_lines(graph).shape == (0, 2, 3), "the other end is in the window"
    while len(graph.window):
        graph.archive_oldest()
    expected = [[[0, 0, 0], [3, 0, 0]], [[3, 0, 0], [0, 0, 0]]]
    np.testing.assert_allclose(archived_lines(graph), expected, atol=1e-6)
    assert len(archived_lines(graph, limit=1)) == 1
    graph.starts.append((3, 1))
    assert archived_lines(graph).shape == archived_lines(graph, 1).shape == (0, 2, 3), "worlds that share nothing"
    graph.worlds[1] = 0
    assert len(archived_lines(graph, 1)) == 2, "joined"
    np.testing.assert_allclose(invert_poses(graph.log.keyframe_pose(3))[:3], [3, 0, 0], atol=1e-6)


def test_nothing_to_read(fake_odometry):
    assert graph_of(fake_odometry()) is None
    assert window_view(KeyframeGraph(2, 3, 4, torch.device("cpu"))) is None
