"""Renumbering of the window, and the motion measures."""

import pytest
import torch

from dvo.geometry import se3
from dvo.map.window import Keyframe, Window
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.odometry.patch.initial_pose import predict_pose
from dvo.odometry.window.pose_validation import flow_magnitude, parallax


def window(count=4, m=2):
    w = Window.empty(m, 3, 5, torch.device("cpu"))
    for index in range(count):
        centres = torch.tensor([[[[10, 8], [20, 12]]]])
        patches = patch_coordinates(centres, torch.full((1, m), 0.5), 3)[0]
        intrinsics = torch.tensor([40.0, 40.0, 20.0, 15.0])
        empty = torch.zeros(0)
        w.append(
            Keyframe(index, 0.1 * index, w.free_map_slot(), empty, empty, empty, intrinsics), se3.identity(), patches
        )
    return w


def test_remove_renumbers_patches_frames_and_edges():
    w = window()
    w.connect(torch.arange(8).repeat_interleave(4), torch.arange(4).repeat(8))
    w.hidden = torch.arange(32.0)[:, None].expand(-1, 5).clone()
    before = {(int(k), int(j)): float(h) for k, j, h in zip(w.kk, w.jj, w.hidden[:, 0], strict=True)}
    assert w.remove(1).identifier == 1
    assert [f.identifier for f in w.frames] == [0, 2, 3]
    assert [f.map_slot for f in w.frames] == [0, 2, 3]
    assert w.free_map_slot() == 1
    after = {(int(k), int(j)): float(h) for k, j, h in zip(w.kk, w.jj, w.hidden[:, 0], strict=True)}
    frame = [0, 2, 3]
    expected = {(m, j): before[(frame[m // 2] * 2 + m % 2, frame[j])] for m in range(6) for j in range(3)}
    assert after == expected


def test_a_frame_in_between_is_joined_with_both_sides_and_its_removal_leaves_nothing():
    w = window(5)
    w.poses_cw = se3.exp(torch.arange(30.0).view(5, 6) / 10)
    w.connect(torch.arange(10).repeat_interleave(5), torch.arange(5).repeat(10))
    before, names = w.snapshot(), ("kk", "jj", "poses_cw", "patches")
    indices = {name: getattr(w, name) for name in names}
    empty = torch.zeros(0)
    new = Keyframe(9, 0.35, w.free_map_slot(), empty, empty, empty, w.frames[0].intrinsics)
    w.insert(4, new, se3.identity(), w.patches[:2] + 1)
    assert [f.identifier for f in w.frames] == [0, 1, 2, 3, 9, 4]
    assert torch.equal(w.patches[8:10], before.patches[:2] + 1) and torch.equal(w.poses_cw[5], before.poses_cw[4])
    assert torch.equal(w.ii[:50] - (w.ii[:50] == 5).long(), indices["kk"] // 2)
    assert torch.equal(w.jj[:50] - (w.jj[:50] == 5).long(), indices["jj"])
    assert not w.touching(4).any()
    w.connect_frame(4, (1, 2), True)
    pairs = {(int(i), int(j)) for i, j in zip(w.ii[50:], w.jj[50:], strict=True)}
    assert pairs == {(2, 4), (3, 4), (5, 4), (4, 2), (4, 3), (4, 4), (4, 5)} and len(w.kk) == 50 + 2 * 7
    w.remove(4)
    assert all(torch.equal(getattr(w, name), value) for name, value in indices.items())
    assert [f.identifier for f in w.frames] == [0, 1, 2, 3, 4]


def test_reset_keeps_frames_patches_and_edges_but_not_what_was_estimated():
    w = window()
    w.connect(torch.tensor([0, 1, 6]), torch.tensor([1, 1, 2]))
    w.poses_cw = se3.exp(torch.arange(24.0).view(4, 6) / 10)
    w.patches[:, 2] = 3.0
    for name in ("hidden", "targets", "weights", "confidence"):
        setattr(w, name, getattr(w, name) + 1.0)
    first, places = w.poses_cw[0].clone(), w.patches[:, :2].clone()
    w.reset()
    assert torch.equal(w.poses_cw, first.expand(4, 7)) and torch.equal(w.patches[:, :2], places)
    assert (w.patches[:, 2] == 1).all()
    assert not any(getattr(w, name).any() for name in ("hidden", "targets", "weights", "confidence"))
    assert w.kk.tolist() == [0, 1, 6] and w.jj.tolist() == [1, 1, 2] and len(w) == 4


def test_prediction_goes_on_with_half_the_motion():
    step = torch.tensor([0.2, 0.0, 0.1, 0.0, 0.04, 0.0], dtype=torch.float64)
    a = se3.exp(torch.tensor([1.0, 2, 3, 0.1, 0.2, 0.3], dtype=torch.float64))
    poses = torch.stack([a, se3.retract(a, step)])
    torch.testing.assert_close(predict_pose(poses, [0.0, 0.1], 0.2, 0.5), se3.retract(poses[1], 0.5 * step))
    torch.testing.assert_close(predict_pose(poses[:1], [0.0], 0.2, 0.5), a)


@pytest.mark.long
def test_rotation_has_flow_but_no_parallax():
    w = window(2)
    w.poses_cw[1] = se3.exp(torch.tensor([0, 0, 0, 0, 0.1, 0.0]))
    assert parallax(w, 0, 1) < 1e-4
    assert flow_magnitude(w, 0, 1) > 1.5
    w.poses_cw[1] = se3.exp(torch.tensor([0.1, 0, 0, 0, 0, 0.0]))
    # fx * t * d = 40 * 0.1 * 0.5
    assert abs(parallax(w, 0, 1) - 2.0) < 1e-4
    assert abs(flow_magnitude(w, 0, 1) - 2.0) < 1e-4
