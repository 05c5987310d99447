"""Turned cameras of training clips, against the renderer."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry import se3, so3
from dvo.synth import random_scene, render
from dvo.synth.motion.paths import random_path
from dvo.synth.render.quality import Quality
from train.data.augment import crop_and_resize, random_source
from train.data.turns import Turns, random_walk, turn_cameras, turn_clip

H, W = 96, 128
K = torch.tensor([[110.0, 108.0, 61.0, 49.5]])
ALWAYS = Turns(probability=1.0)


@pytest.fixture(scope="module")
def scene():
    return random_scene(3, "room")


def view(scene, poses_cw, k=K):
    """Clip of a scene, rendered with so many rays that warping it adds little blur."""
    poses_wc = se3.inverse(poses_cw.double()).numpy()
    seen = render(scene, poses_wc, k[0].double().numpy(), H, W, quality=Quality(supersample=2), coordinates=False)
    images = (seen.images * 255).round().to(torch.uint8)
    count = len(poses_cw)
    return {"images": images, "poses_cw": poses_cw, "intrinsics": k.repeat(count, 1), "depth": seen.depth}


@pytest.fixture(scope="module")
def clip(scene):
    path = random_path(scene, 1)
    poses_wc = torch.from_numpy(path.poses_wc(np.linspace(0, 0.4, 3)))
    return view(scene, se3.inverse(poses_wc).float())


@pytest.mark.parametrize("zoom", [1.0, 1.15])
def test_the_warped_clip_is_the_one_that_the_turned_cameras_render(scene, clip, zoom):
    turns = torch.deg2rad(torch.tensor([[8.0, -4.0, 0.0], [0.0, 5.0, 7.0], [-3.0, -8.0, -5.0]]))
    warped = turn_clip(clip, turns, zoom)
    rendered = view(scene, warped["poses_cw"], warped["intrinsics"][:1])
    known = ~warped["depth"].isnan()
    assert 0.75 < known.float().mean() < 0.99
    errors = [(one["images"].float() - rendered["images"]).abs().mean(1) for one in (warped, clip)]
    for frame, inside in enumerate(known):
        after, before = (error[frame][inside].mean() for error in errors)
        assert after < 3 and after < 0.25 * before, (frame, after, before)
    off = (warped["depth"] / rendered["depth"] - 1).abs()[known]
    assert off.median() < 5e-3 and off.quantile(0.9) < 0.02  # at the edges of bodies the nearest pixel may be another's


def test_the_poses_are_composed_on_the_left(clip):
    turns = torch.tensor([[0.1, -0.05, 0.02], [0.0, 0.1, 0.0], [-0.1, 0.0, 0.1]])
    turned = turn_clip(clip, turns)["poses_cw"]
    point = torch.tensor([0.3, -0.2, 4.0])
    before = se3.act(clip["poses_cw"], point)
    torch.testing.assert_close(se3.act(turned, point), so3.rotate(so3.exp(turns), before))
    centres = [se3.inverse(poses)[:, :3] for poses in (turned, clip["poses_cw"])]
    torch.testing.assert_close(*centres, rtol=1e-4, atol=1e-4)


def test_no_turn_changes_nothing_and_the_zoom_is_that_of_a_crop(clip):
    still = turn_clip(clip, torch.zeros(3, 3))
    assert (still["images"].int() - clip["images"].int()).abs().max() <= 1
    for name in ("poses_cw", "intrinsics", "depth"):
        torch.testing.assert_close(still[name], clip[name], rtol=1e-4, atol=1e-4)
    zoomed = turn_clip(clip, torch.zeros(3, 3), 1.25)
    window = crop_and_resize(clip, 1.25, 0.1 * W, 0.1 * H)
    torch.testing.assert_close(zoomed["intrinsics"], window["intrinsics"])
    assert (zoomed["images"].float() - window["images"].float()).abs().mean() < 1.5


@given(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.floats(1.0, 1.3))
@settings(max_examples=25, deadline=None)
def test_rays_keep_their_colours(a, b, c, zoom):
    """The column that a pixel came from is written in its colour."""
    columns = (2.0 * torch.arange(100)).round().to(torch.uint8).expand(1, 3, 80, 100)
    k = torch.tensor([[90.0, 92.0, 48.0, 41.0]])
    turn = torch.tensor([[a, b, c]])
    new = turn_clip({"images": columns, "poses_cw": se3.identity(1), "intrinsics": k}, turn, zoom)
    assert "depth" not in new
    fx, fy, cx, cy = new["intrinsics"][0].tolist()
    for u, v in ((50, 40), (30, 50), (65, 25)):
        ray = so3.rotate(so3.conjugate(so3.exp(turn[0])), torch.tensor([(u - cx) / fx, (v - cy) / fy, 1.0]))
        column = float(ray[0] / ray[2]) * 90 + 48
        if 0 <= column <= 99:
            assert float(new["images"][0, 0, v, u]) == pytest.approx(2 * column, abs=0.51)


def batch(count=3):
    """Clips of noise."""
    images = torch.randint(0, 256, (count, 4, 3, 24, 32), dtype=torch.uint8, generator=random_source(0))
    poses = se3.exp(0.1 * torch.randn(count, 4, 6, generator=random_source(1)))
    return {
        "images": images,
        "poses_cw": poses,
        "intrinsics": torch.tensor([30.0, 28.0, 15.5, 11.5]).repeat(count, 4, 1),
    }


def test_the_same_step_turns_the_same_and_clips_differ():
    clips = batch()
    clips["images"][1], clips["poses_cw"][1] = clips["images"][0], clips["poses_cw"][0]
    a, b, c = (turn_cameras(clips, ALWAYS, 3, step) for step in (7, 7, 8))
    for name in clips:
        assert torch.equal(a[name], b[name]) and a[name].dtype == clips[name].dtype
        assert a[name].shape == clips[name].shape and not torch.equal(a[name], c[name])
    assert not torch.equal(a["poses_cw"][0], a["poses_cw"][1])
    other = turn_cameras(clips, ALWAYS, 2**63 - 1, 7)  # seeds of 64 bits
    assert not torch.equal(a["images"], other["images"])


def test_the_probability_is_that_of_a_turn():
    clips = batch(1)
    never = turn_cameras(clips, Turns(probability=0.0), 0, 5)
    assert all(torch.equal(never[name], clips[name]) for name in clips)
    some = [turn_cameras(clips, Turns(probability=0.5), 0, step)["images"] for step in range(60)]
    assert 15 < sum(not torch.equal(images, clips["images"]) for images in some) < 45


def test_other_values_pass_and_reduced_precision_does_not_reach_the_rays():
    clips = batch() | {"number": torch.arange(3)}
    exact = turn_cameras(clips, ALWAYS, 0, 0)
    assert torch.equal(exact["number"], clips["number"])
    with torch.autocast("cpu", torch.bfloat16):
        mixed = turn_cameras(clips, ALWAYS, 0, 0)
    for name in clips:  # up to the last bits of two calls
        torch.testing.assert_close(mixed[name], exact[name], atol=1e-3, rtol=1e-5)


def test_walks_have_the_steps_asked_for_and_mean_zero():
    free = Turns(degrees=(1.0, 1.0), smoothness=(0.5, 0.5), limit=30.0)
    walks = torch.stack([random_walk(8, free, random_source(n)) for n in range(400)]).rad2deg()
    steps = walks.diff(dim=1)
    assert walks.mean(1).abs().max() < 1e-9
    assert steps.std().item() == pytest.approx(1, rel=0.05)
    correlation = (steps[:, 1:] * steps[:, :-1]).mean() / steps.square().mean()
    assert correlation.item() == pytest.approx(0.5, abs=0.07)
    steady = random_walk(8, replace(free, smoothness=(1.0, 1.0)), random_source(0)).diff(dim=0)
    torch.testing.assert_close(steady, steady[:1].expand_as(steady))
    assert random_walk(1, free, random_source(0)).abs().max() == 0


def test_walks_are_limited_and_of_many_sizes():
    walks = [random_walk(8, ALWAYS, random_source(n)) for n in range(200)]
    largest = torch.stack([walk.norm(dim=-1).max() for walk in walks]).rad2deg()
    assert largest.max() < 12 + 1e-6 and largest.min() < 0.6 and (largest > 11.9).any()
    steps = torch.stack([walk.diff(dim=0).square().mean().sqrt() for walk in walks]).rad2deg()
    assert steps.median().item() == pytest.approx(math.sqrt(0.2 * 4.0), rel=0.35)


@pytest.mark.parametrize(
    "change",
    [
        {"probability": 1.5},
        {"degrees": (0.0, 1.0)},
        {"degrees": (2.0, 1.0)},
        {"degrees": 1.0},
        {"smoothness": (0.0, 1.1)},
        {"smoothness": (0.0, math.nan)},
        {"limit": 90.0},
        {"zoom": 0.5},
    ],
)
def test_values_out_of_range_are_named(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        Turns(**change)
