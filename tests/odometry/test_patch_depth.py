"""Depths of patches from depth images, and their noise."""

from dataclasses import replace

import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.odometry.depth_factor import SIGMA
from dvo.odometry.patch_depth import checked_depth, sample_depth, variance_of_inverse
from dvo.odometry.scale_options import ScaleOptions
from dvo.odometry.tracker import PatchOdometry
from tests.odometry.test_tracker import SMALL, frames, tracker

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)


def test_the_median_of_the_known_pixels_is_sampled_away_from_edges():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 4.0
    depth[10, 10] = 50.0  # a single wrong pixel
    depth[30:34, 8:13] = np.nan
    depth[40, 50] = 0.0
    positions = np.array([[10, 10], [31, 20], [50, 20], [10, 31], [50, 40], [62, 46], [100, 20]], float)
    found = sample_depth(depth, positions, 2)
    np.testing.assert_array_equal(found, [2, np.nan, 4, np.nan, 4, 4, np.nan])


def test_a_slanted_surface_is_no_edge():
    rows = np.linspace(2.0, 3.0, 48, dtype=np.float32)
    depth = np.repeat(rows[:, None], 64, 1)
    assert sample_depth(depth, np.array([[30.0, 20.0]]), 1)[0] == pytest.approx(rows[20])


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
def test_the_window_holds_the_depths_at_the_centres(size):
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
    np.testing.assert_allclose(measured[:, 0], 0.3 + 0.002 * centres, atol=0.0012)
    metres = 1 / measured[:, 0].astype(float)
    np.testing.assert_allclose(measured[:, 1], SIGMA**2 / variance_of_inverse(metres, config.scale), rtol=1e-4)
    np.testing.assert_array_equal(odometry.window.patches[:, 2, 1, 1].numpy(), measured[:, 0])


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
