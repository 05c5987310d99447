"""Depths of patches from depth images, and their noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.map.measurements import SIGMA
from dvo.nets.alignment.alignment import align_patches
from dvo.odometry.depth.patch_depth import checked_depth, followed_planes, variance_of_inverse
from dvo.odometry.depth.scale_options import ScaleOptions
from dvo.odometry.patch.tracker import PatchOdometry
from tests.support.tiny_tracker import SMALL, frames, tracker

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)


def textured(height=48, width=64, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)


def test_windows_on_two_surfaces_or_on_unknown_ones_have_no_depth():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 40:] = 4.0
    depth[10, 10] = 50.0  # a single wrong pixel
    depth[26:48, :20] = np.nan
    depth[40, 50] = 0.0
    centres = np.array([[10, 10], [38, 20], [50, 20], [10, 34], [50, 40], [62, 46], [100, 20]], float)
    found, slopes = followed_planes(depth, textured(), centres)
    np.testing.assert_allclose(found, [2, np.nan, 4, np.nan, 4, 4, np.nan], rtol=1e-5)
    np.testing.assert_allclose(slopes, 0, atol=1e-6)


@given(
    st.tuples(st.floats(-0.008, 0.008), st.floats(-0.008, 0.008)),
    st.sampled_from([0.5, 1.0, 2.0, 3.0]),
    st.integers(0, 99),
)
@settings(max_examples=20, deadline=None)
def test_planes_are_found_whatever_the_texture(slopes, scale, seed):
    """At the centre of a window, from depth images of any size."""
    size = round(48 * scale), round(64 * scale)
    y, x = ((np.arange(count) + 0.5) / scale - 0.5 for count in size)
    inverse = 0.4 + slopes[0] * (x[None] - 32) + slopes[1] * (y[:, None] - 24)
    centres = np.array([[8.0, 8.0], [32.0, 24.0], [44.0, 32.0]])
    found, relative = followed_planes((1 / inverse).astype(np.float32), textured(seed=seed), centres)
    true = 0.4 + (centres - [32, 24]) @ slopes
    flat = np.hypot(*slopes) < 0.003  # a steep one is rejected where its inverse depth is small
    assert np.isfinite(found).all() or not flat
    known = np.isfinite(found)
    np.testing.assert_allclose(1 / found[known], true[known], rtol=5e-3)
    np.testing.assert_allclose((relative * true[:, None])[known], np.tile(slopes, (known.sum(), 1)), atol=6e-4)


def test_what_changes_on_a_line_alone_tells_no_slope_across_it():
    """The plane is right beside the line, where its grey levels are."""
    inverse = np.repeat(np.linspace(0.3, 0.5, 64)[None], 48, 0)
    line = np.full((48, 64), 100)
    line[:, 34] = 200
    found, slopes = followed_planes((1 / inverse).astype(np.float32), line, np.array([[30.0, 20.0]]))
    assert (1 + 4 * slopes[0, 0]) / found[0] == pytest.approx(inverse[20, 34], rel=2e-3)


def waves(x, y, seed=0):
    """Smooth texture at any place, of a third of the contrast above the 24th row."""
    rng = np.random.default_rng(seed)
    turns, phases = rng.uniform(0.2, 0.6, (20, 2)) * rng.choice([-1, 1], (20, 2)), rng.uniform(0, 7, 20)
    grey = sum(np.sin(a * x + b * y + c) for (a, b), c in zip(turns, phases, strict=True))
    return 128 + 8 * grey * np.where(y < 24, 1 / 3, 1)


def test_the_plane_is_the_parallax_that_the_alignment_of_grey_levels_finds():
    """Two strips of different texture move by different flows; the window with the slope of the plane, by its depth."""
    x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    inverse = np.where(y < 24, 0.50, 0.53)
    images = torch.from_numpy(np.stack([waves(x, y), waves(x - 10 * (inverse - 0.5), y)]))
    one, centre = torch.tensor([0]), torch.tensor([[30.0, 24.0]], dtype=torch.float64)
    metres, slopes = followed_planes((1 / inverse).astype(np.float32), images[0].numpy(), centre.numpy())
    warps = torch.eye(2, dtype=torch.float64)[None].clone()
    warps[0, 0] += torch.from_numpy(10 * slopes[0] / metres[0])
    found = align_patches(images, one, one + 1, centre, centre, warps)
    assert slopes[0, 1] > 0.003
    assert float(found.positions[0, 0] - 30) == pytest.approx(10 * (1 / metres[0] - 0.5), abs=0.02)


def test_the_noise_is_that_of_the_sensor_and_a_relative_one():
    options = ScaleOptions(depth=True, depth_error=1e-4)
    metres = np.array([0.4, 1.0, 3.0])
    deviation = np.sqrt(variance_of_inverse(metres, options)) * metres**2
    wanted = 0.0012 + 0.0019 * (metres - 0.4) ** 2  # Nguyen et al. 2012
    np.testing.assert_allclose(deviation, wanted, rtol=1e-2)
    relative = ScaleOptions(depth=True, depth_error=0.02, depth_base=0, depth_quadratic=0)
    np.testing.assert_allclose(variance_of_inverse(metres, relative), (0.02 / metres) ** 2)


@pytest.mark.parametrize(
    "depth", [np.ones((48, 63), np.float32), np.ones((48, 64), np.uint16), np.ones((48, 64, 1), np.float32)]
)
def test_a_depth_of_another_form_is_refused(depth):
    frame = Frame(7, 0.0, np.zeros((48, 64, 3), np.uint8), CAMERA, depth=depth)
    with pytest.raises(DvoError, match="frame 7: depth.*metres"):
        checked_depth(frame)


@pytest.mark.parametrize("size", [(96, 72), (192, 144)])
def test_the_window_holds_the_depths_of_its_patches(size):
    """The working image has 96x72 pixels; depth has the size of the frame."""
    width, height = size
    config = replace(SMALL, scale=ScaleOptions(depth=True), keyframe_motion=0.0)
    odometry: PatchOdometry = tracker(config)
    x = np.arange(width, dtype=np.float32) * (96 / width)
    depth = np.repeat(1 / (0.3 + 0.002 * x)[None], height, 0)  # a plane
    frame = frames(1, size=size)[0]
    odometry.track(replace(frame, depth=depth))
    measured = odometry.window.frames[0].measured.numpy()
    centres = odometry.window.patches[:, 0, 1, 1].numpy() * 4
    np.testing.assert_allclose(measured[:, 0], 0.3 + 0.002 * centres, atol=0.006)  # of a point of the window
    metres = 1 / measured[:, 0].astype(float)
    np.testing.assert_allclose(measured[:, 1], SIGMA**2 / variance_of_inverse(metres, config.scale), rtol=1e-4)
    np.testing.assert_array_equal(odometry.window.patches[:, 2, 1, 1].numpy(), measured[:, 0])


@pytest.mark.long
def test_depth_that_is_not_asked_for_is_not_read_and_changes_no_byte():
    def refuse():
        raise AssertionError("depth was read")

    images = frames(10)
    poses = []
    for clip in (images, [replace(f, depth=None) for f in images]):
        odometry = tracker()
        for frame in clip:
            if clip is images:
                object.__setattr__(frame, "depth", refuse)
            odometry.track(frame)
        poses.append(odometry.finish())
    assert np.array_equal(poses[0].trajectory.poses_wc, poses[1].trajectory.poses_wc)
    assert "scale" not in poses[0].info and not poses[0].metric


@pytest.mark.long
def test_frames_without_depth_are_tracked_as_without_the_option():
    """Without a single measured depth every byte is the same, and the scale is told as unknown."""
    results = []
    for scale in (ScaleOptions(), ScaleOptions(depth=True)):
        odometry = tracker(replace(SMALL, scale=scale))
        for frame in frames(10):
            odometry.track(frame)
        results.append(odometry.finish())
    assert np.array_equal(results[0].trajectory.poses_wc, results[1].trajectory.poses_wc)
    assert not results[1].metric
    assert results[1].info["scale"]["unit"] == "arbitrary"
