"""Distances of frames and choice of edges."""

import numpy as np
import torch

from dvo.geometry import se3
from dvo.odometry.droid.edges import FAR_DISTANCE, flow_distances, neighbours_of, proximity_edges


def scene(count=4):
    poses_wc = se3.identity(count)
    poses_wc[:, 0] = 0.2 * torch.arange(count)
    return se3.inverse(poses_wc), torch.ones(count, 12, 16), torch.tensor([10.0, 10, 8, 6]).expand(count, 4)


def test_sideways_motion_over_a_wall_is_the_flow():
    found = flow_distances(*scene(), 0.3)
    steps = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    np.testing.assert_allclose(found, 2.0 * steps, atol=1e-4)  # 10 px times 0.2 over the depth of one


def test_rotation_counts_with_the_rest_of_the_share():
    poses, depth, intrinsics = scene(2)
    poses[1] = se3.exp(torch.tensor([0.0, 0, 0, 0, 0.1, 0]))
    whole, none, half = (flow_distances(poses, depth, intrinsics, share)[0, 1] for share in (0.0, 1.0, 0.5))
    assert whole > 1 and none < 1e-4 and abs(half - whole / 2) < 1e-4


def test_frames_that_look_away_are_far():
    poses, depth, intrinsics = scene(2)
    poses[1] = se3.exp(torch.tensor([0.0, 0, 0, 0, 3.0, 0]))
    assert flow_distances(poses, depth, intrinsics, 0.3, [(0, 1)])[0] == FAR_DISTANCE


def test_distances_are_symmetric_and_use_the_camera_of_each_frame():
    poses, depth, intrinsics = scene(3)
    intrinsics = intrinsics.clone()
    intrinsics[2, :2] = 20.0
    found = flow_distances(poses, depth, intrinsics, 0.3)
    np.testing.assert_allclose(found, found.T, atol=1e-5)
    assert found[1, 2] > found[0, 1]


def test_neighbours_are_joined_both_ways():
    assert neighbours_of(3, 2) == [(3, 2), (2, 3), (3, 1), (1, 3)]
    assert neighbours_of(1, 3) == [(1, 0), (0, 1)]


def test_the_closest_frames_are_joined_and_their_neighbourhood_is_not():
    distances = np.full((10, 10), 50.0)
    distances[9, 2], distances[9, 3], distances[8, 5] = 1.0, 1.1, 2.0
    options = {"first": 7, "radius": 2, "separation": 1, "threshold": 10.0}
    assert proximity_edges(distances, [], **options, limit=8) == [(9, 2), (2, 9), (8, 5), (5, 8)]
    assert proximity_edges(distances, [], **options, limit=3) == [(9, 2), (2, 9)]
    assert proximity_edges(distances, [(9, 2)], **options, limit=8) == [(8, 5), (5, 8)]
    assert proximity_edges(distances, [], **(options | {"separation": 0}), limit=8)[2:4] == [(9, 3), (3, 9)]
    assert proximity_edges(distances, [], **(options | {"first": 9}), limit=8) == [(9, 2), (2, 9)]
    assert proximity_edges(np.zeros((3, 3)), [], **(options | {"first": 0}), limit=8) == []
