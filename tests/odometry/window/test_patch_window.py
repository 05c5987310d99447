"""A frame is tried in a window: it is kept where its measurements support its pose, and leaves no trace elsewhere."""

from dataclasses import fields, replace

import pytest
import torch

from dvo.ba.limits import DEPTH_RANGE, depth_range_of
from dvo.odometry.frames.front_end import View, observe
from dvo.odometry.patch.initial_pose import first_depth
from dvo.odometry.window.patch_window import PatchWindow, Round
from dvo.odometry.window.pose_validation import PoseSupport
from tests.support.tiny_tracker import SMALL, frames, tracker

COUNT = 9


@pytest.fixture(params=["final", "none"])
@torch.inference_mode()
def tried(request):
    """A tracker between two frames, and a view that it has not seen."""
    odometry = tracker(replace(SMALL, align=request.param))
    *seen, new = frames(COUNT)
    for frame in seen:
        odometry.track(frame)
    record = odometry.graph.log.add(new.timestamp)
    return odometry, View([record], observe(odometry.network, new.image, new.camera, odometry.select, odometry.device))


@torch.inference_mode()
def content(window):
    """All tensors of a window and of its snapshot, by name."""
    data = window.window
    found = {field.name: getattr(data, field.name) for field in fields(data) if field.name not in ("frames", "_edges")}
    shot = window.snapshot()
    found |= {"identifiers": [frame.identifier for frame in data.frames]}
    if shot.alignment is not None:
        found["images"] = window.alignment.images
    return {name: value.clone() if isinstance(value, torch.Tensor) else value for name, value in found.items()}


@torch.inference_mode()
def attempt(odometry, view, position, inliers, **changes):
    policy = replace(odometry.config.policies["continuous"], rounds=(Round(2, 0.0), Round(1, 0.0)), **changes)
    policy = replace(policy, rounds=tuple(replace(one, inliers=inliers) for one in policy.rounds))
    depth = first_depth(odometry.window, odometry.config, True)
    return odometry.patch_window.try_insert(view, position, 77, odometry.window.poses_cw[-1], depth, policy)


def same(one, other):
    return one.keys() == other.keys() and all(
        torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]
        for name, value in one.items()
    )


@pytest.mark.long
@pytest.mark.parametrize("back", [0, 1])
def test_what_is_not_supported_leaves_no_trace(tried, back):
    odometry, view = tried
    before, position = content(odometry.patch_window), len(odometry.window) - back
    found = attempt(odometry, view, position, inliers=2.0)
    assert not found.accepted and 0 <= found.support.inliers <= 1
    assert same(content(odometry.patch_window), before)


@pytest.mark.long
@pytest.mark.parametrize("back", [0, 1])
def test_what_is_supported_is_part_of_the_window(tried, back):
    odometry, view = tried
    window, position = odometry.window, len(odometry.window) - back
    others = [frame.identifier for frame in window.frames]
    found = attempt(odometry, view, position, inliers=0.0, later=back)
    assert found.accepted
    assert [frame.identifier for frame in window.frames] == [*others[:position], 77, *others[position:]]
    assert bool(((window.ii == position) & (window.jj != position)).any()) and bool((window.jj == position).any())
    assert bool(torch.isfinite(window.poses_cw).all())


def test_rounds_end_with_the_first_that_supports_it(tried, monkeypatch):
    odometry, view = tried
    counts = []
    real = PatchWindow.update
    monkeypatch.setattr(
        PatchWindow, "update", lambda self, many, count=1: counts.append(count) or real(self, many, count)
    )
    assert attempt(odometry, view, len(odometry.window), inliers=0.0).accepted and counts == [2]
    counts.clear()
    view.records[0].timestamp += 0.1
    assert not attempt(odometry, view, len(odometry.window), inliers=2.0).accepted and counts == [2, 1]
    counts.clear()
    assert attempt(odometry, view, len(odometry.window), inliers=2.0, checked=False).accepted and counts == [2, 1]


def test_a_pose_is_valid_from_both_thresholds_on():
    assert PoseSupport(0.2, 0.1).reaches(0.2, 0.1)
    assert not PoseSupport(0.2, 0.1).reaches(0.21, 0.1) and not PoseSupport(0.2, 0.1).reaches(0.2, 0.11)
    assert not PoseSupport(float("nan"), 1.0).reaches(0.0, 0.0)


def test_policies_follow_the_settings():
    config = replace(SMALL, updates=2, search_updates=5, min_inliers=0.1, search_inliers=0.2, join_inliers=0.3)
    policies = config.policies
    assert policies["continuous"].rounds == (Round(2, 0.1), Round(5, 0.2))
    assert policies["retry"].rounds == policies["late"].rounds == (Round(5, 0.3),)
    assert (policies["retry"].later, policies["late"].later) == (0, 1) and not policies["located"].checked
    assert all((one.distances, one.optimised) == ((1, 2, 3, 4), 4) for one in policies.values())


@pytest.mark.parametrize(
    "edges, lifetime, distances",
    [("all", 1, (1,)), ("all", 7, (1, 2, 3, 4, 5, 6, 7)), ("spread", 1, (1,)), ("spread", 5, (1, 2, 3, 4, 5)),
     ("spread", 7, (1, 2, 3, 4, 6, 7)), ("spread", 10, (1, 2, 3, 4, 6, 8, 10))],
)  # fmt: skip
def test_distances_of_edges(edges, lifetime, distances):
    assert replace(SMALL, edges=edges, lifetime=lifetime).distances == distances


@torch.inference_mode()
def test_a_scene_that_has_come_near_is_not_held_at_the_usual_bound():
    """The same window in another unit, in which its patches are thirty times as near."""
    odometry = tracker()
    for frame in frames(COUNT):
        odometry.track(frame)
    window = odometry.window
    before = window.patches[:, 2, 1, 1].clone()
    factor = 30.0 / float(before.median())
    poses, patches = window.poses_cw.clone(), window.patches.clone()
    poses[:, :3] /= factor
    patches[:, 2] *= factor
    window.poses_cw, window.patches = poses, patches
    odometry.patch_window.update(odometry.config.optimisation)
    assert float(window.patches[:, 2, 1, 1].median()) > 20.0
    assert depth_range_of(2.0) == DEPTH_RANGE and depth_range_of(30.0) == (DEPTH_RANGE[0], 75.0)
