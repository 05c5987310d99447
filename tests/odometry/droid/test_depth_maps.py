"""Agreement of depths between keyframes and the fused cloud."""

import numpy as np
import torch

from dvo.geometry import se3
from dvo.odometry.droid.depth_maps import StoredDepth, agreeing_views, backproject, depth_maps, fused, reliable_pixels

INTRINSICS = torch.tensor([10.0, 10.0, 7.5, 5.5], dtype=torch.float64)


def wall(count=4, distance=2.0):
    """Cameras that move sideways along a wall, and their inverse depths."""
    poses_wc = se3.identity(count, dtype=torch.float64)
    poses_wc[:, 0] = 0.1 * torch.arange(count)
    inverse = torch.full((count, 12, 16), 1 / distance, dtype=torch.float64)
    return se3.inverse(poses_wc), inverse, INTRINSICS.expand(count, 4)


def test_true_depths_agree_with_all_neighbours():
    count = agreeing_views(*wall(), 0.01)
    assert count[1, 2:-2, 4:-4].eq(3).all() and count[0, 2:-2, 4:-4].eq(2).all()


def test_a_wrong_depth_agrees_with_none():
    poses, inverse, intrinsics = wall()
    inverse[1, 5, 8] *= 1.5
    count = agreeing_views(poses, inverse, intrinsics, 0.05)
    assert count[1, 5, 8] == 0 and count[1, 5, 3] == 3
    assert agreeing_views(poses, inverse, intrinsics, 0.9)[1, 5, 8] == 3


def test_scale_does_not_matter():
    poses, inverse, intrinsics = wall()
    larger = torch.cat([poses[:, :3] * 7, poses[:, 3:]], -1)
    assert torch.equal(
        agreeing_views(poses, inverse, intrinsics, 0.02), agreeing_views(larger, inverse / 7, intrinsics, 0.02)
    )


def test_points_behind_a_camera_agree_with_nothing():
    poses, inverse, intrinsics = wall(2)
    poses[1] = torch.tensor([0.0, 0, 0, 0, 1, 0, 0], dtype=torch.float64)  # turned around
    assert (agreeing_views(poses, inverse, intrinsics, 0.5) == 0).all()


def test_what_is_reliable():
    views = torch.tensor([2, 1, 2, 2]).view(1, 1, 4).expand(5, 1, 4)
    confidence = torch.tensor([0.9, 0.9, 0.1, 0.9]).view(1, 1, 4).expand(5, 1, 4)
    inverse = torch.tensor([1.0, 1.0, 1.0, 0.01]).view(1, 1, 4).expand(5, 1, 4)
    found = reliable_pixels(confidence, inverse, views, 0.5, 2)
    assert found[2, 0].tolist() == [True, False, False, False]
    alone = reliable_pixels(confidence[:1], inverse[:1], 0 * views[:1], 0.5, 2)
    assert alone[0, 0].tolist() == [True, True, False, False]  # nothing to compare with


def test_maps_and_cloud_lie_in_the_world():
    poses, inverse, _ = wall(3)
    colors = np.full((12, 16, 3), 7, np.uint8)
    sure = np.ones((12, 16), np.float32)
    stored = [
        StoredDepth(k, 0, 0.5 * k, INTRINSICS.float().numpy(), inverse[k].float().numpy(), sure, colors)
        for k in range(3)
    ]
    known = {k: poses[k].numpy() for k in (0, 1)}
    maps, clouds = depth_maps(stored, known, confidence=0.5, tolerance=0.05, views=1)
    assert [found.timestamp for found in maps] == [0.0, 0.5]  # the third has no pose
    cloud = fused(clouds)
    assert np.allclose(cloud.points[:, 2], 2.0) and (cloud.colors == 7).all()
    assert len(cloud.points) == sum(int(found.reliable.sum()) for found in maps) > 100
    np.testing.assert_allclose(maps[1].pose_wc[:3], [0.1, 0, 0], atol=1e-9)
    first = backproject(inverse[:1], INTRINSICS[None])[0][torch.from_numpy(maps[0].reliable)]
    np.testing.assert_allclose(cloud.points[: len(first)], first.numpy(), atol=1e-5)
    assert len(fused([]).points) == 0
