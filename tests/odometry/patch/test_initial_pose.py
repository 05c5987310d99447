"""First pose of a new frame from matches with the newest keyframe."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.map.window import Keyframe, Window
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.odometry.frames.front_end import Observation
from dvo.odometry.patch import initial_pose as pose_module
from dvo.odometry.patch.config import TRACKER_PRESETS, TrackerConfig
from dvo.odometry.patch.initial_pose import best_matches, initial_pose, pose_from_nearest
from dvo.odometry.protocol import Status
from dvo.synth.sequence import make_sequence

INTRINSICS = torch.tensor([60.0, 60.0, 39.5, 29.5])
M, CHANNELS, SIDE = 24, 32, 3


def scene(pose, wrong=0, seed=0):
    """A window of one keyframe, and a frame with the given pose that shows its patches; some at a wrong place."""
    g = torch.Generator().manual_seed(seed)
    # One patch a cell, so that none covers another.
    cells = torch.stack(torch.meshgrid(torch.arange(6), torch.arange(4), indexing="ij"), -1).reshape(-1, 2)
    centres = (cells * torch.tensor([11, 12]) + torch.tensor([12, 12])).float()[None, None]
    depth = 0.5 + torch.rand(1, M, generator=g)
    patches = patch_coordinates(centres, depth, SIDE)[0]
    matching = torch.nn.functional.normalize(torch.randn(M, CHANNELS, SIDE, SIDE, generator=g), dim=1)
    window = Window.empty(M, SIDE, 4, torch.device("cpu"))
    nothing = torch.zeros(M, 4), torch.zeros(M, 3, dtype=torch.uint8)
    window.append(Keyframe(0, 0.0, 0, matching, *nothing, INTRINSICS), se3.identity(), patches)
    poses = torch.stack([se3.identity(), pose])[None]
    kk = torch.arange(M)
    seen = reproject(poses, patches[None], INTRINSICS.expand(1, 2, 4), 0 * kk, 0 * kk + 1, kk).coords[0, :, 1, 1]
    places = seen.round().long()
    places[:wrong] = torch.tensor([75, 3])
    maps = 0.02 * torch.randn(1, 1, CHANNELS, 60, 80, generator=g)
    for patch, (x, y) in zip(matching, places.tolist(), strict=True):
        maps[0, 0, :, y - 1 : y + 2, x - 1 : x + 2] = patch
    image = np.zeros((240, 320, 3), np.uint8)
    blank = Observation(image, np.zeros(4), INTRINSICS, maps, centres, matching, *nothing)
    return window, blank, places


def apart(a, b):
    return float(se3.log(se3.relative(a, b)).norm())


TRUE = se3.exp(torch.tensor([0.12, -0.05, 0.08, 0.02, 0.06, -0.03]))


def test_matches_are_found_anywhere_in_the_image():
    window, seen, places = scene(TRUE)
    found = best_matches(window.frames[0].matching, seen.maps[0, 0])
    assert ((found - places).abs().max(-1).values < 0.5).all()


def test_a_match_lies_between_pixels_where_the_correlation_does():
    x, y = torch.arange(20.0), torch.arange(15.0)[:, None]
    bump = 5 - 0.1 * ((x - 8.3) ** 2 + (y - 6.6) ** 2)
    found = best_matches(torch.ones(1, 1, 1, 1), bump[None])
    torch.testing.assert_close(found, torch.tensor([[8.3, 6.6]]), atol=1e-3, rtol=0)
    corner = best_matches(torch.ones(1, 1, 1, 1), (x + y)[None])
    torch.testing.assert_close(corner, torch.tensor([[19.0, 14.0]]))


@pytest.mark.parametrize("wrong", [0, 8])
@pytest.mark.parametrize("start", [0.0, 0.25])
def test_the_pose_is_that_of_the_matches(wrong, start):
    """From a prediction that is a long way off, with a third of the matches wrong; places are rounded to pixels."""
    window, seen, _ = scene(TRUE, wrong)
    prediction = se3.retract(se3.identity(), torch.full((6,), -start))
    found = pose_from_nearest(window, seen, prediction)
    assert apart(found, TRUE) < 0.02 < apart(prediction, TRUE)


def test_a_prediction_is_kept_where_it_is_good_or_the_matches_are_not():
    window, seen, _ = scene(TRUE)
    near = se3.retract(TRUE, torch.full((6,), 2e-3))
    assert torch.equal(pose_from_nearest(window, seen, near), near)
    noise = replace(seen, maps=torch.randn(seen.maps.shape, generator=torch.Generator().manual_seed(1)))
    far = se3.retract(TRUE, torch.full((6,), 0.1))
    assert torch.equal(pose_from_nearest(window, noise, far), far)
    assert torch.equal(initial_pose(window, seen, far, "motion"), far)
    assert not torch.equal(initial_pose(window, seen, far, "nearest"), far)


def test_the_setting_has_a_name_and_belongs_to_the_preset():
    assert TRACKER_PRESETS["mamba"].initial_pose == "nearest"
    assert TRACKER_PRESETS["small"].initial_pose == TrackerConfig().initial_pose == "motion"
    with pytest.raises(DvoError, match=r"initial_pose.*Use one of motion, nearest"):
        TrackerConfig(initial_pose="middle")


@pytest.mark.slow
def test_a_fast_rotation_begins_closer_to_its_pose(monkeypatch):
    """A hand-held walk at 5 frames per second, with the shipped weights: rotation of the first poses."""
    frames = list(make_sequence(6, frames=9, kind="handheld", fps=5.0))
    errors = {}
    for method in ("motion", "nearest"):
        first = []

        def record(*arguments, first=first):
            first.append(initial_pose(*arguments))
            return first[-1]

        monkeypatch.setattr(pose_module, "initial_pose", record)
        odometry = dvo.load("small", initial_pose=method, final_adjustment=False)
        found = []
        for frame in frames:
            before = len(first)
            estimate = odometry.track(frame)
            if len(first) > before and estimate.status is Status.TRACKING:
                pose_cw = se3.inverse(torch.from_numpy(estimate.pose_wc)).float()
                found.append(float(se3.log(se3.relative(first[-1], pose_cw))[3:].norm()))
        assert len(found) >= 3
        errors[method] = np.median(found)
    assert errors["nearest"] < 0.5 * errors["motion"]
