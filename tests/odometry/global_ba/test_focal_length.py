"""Focal length from the measurements of an archived walk."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import distort, undistort, undistorted_camera
from dvo.odometry.global_ba import focal_length
from dvo.odometry.global_ba.final_adjustment import adjust_segment
from dvo.odometry.global_ba.focal_length import find_focal, undistorted
from dvo.odometry.global_ba.rolling_shutter import Shutter
from tests.support import archived_walk as walks
from tests.support.archived_walk import INTRINSICS, ROWS, archived_walk


def walk_with(factor, noise=0.1, bend=0.0, resampled=None, **options):
    """Archived walk whose keyframes hold a focal length that is wrong by a factor, with noise in the measurements.

    Args:
        factor: of the focal length.
        noise: of the measurements, feature pixels.
        bend: of the lens that the images were made with.
        resampled: lens whose distortion was taken from the images before they were tracked.
        options: of the walk.
    """
    graph, _ = archived_walk(archived=False, **options)
    focal, centre = INTRINSICS[:2].numpy(), INTRINSICS[2:].numpy()

    def recorded(xy):
        if not bend:
            return xy
        lens = eucm(bend, 60) if bend > 0 else replace(eucm(0, 60), model="radtan", coefficients=(-bend / 2, 0, 0, 0))
        points = distort((xy.double().numpy() - centre) / focal, lens)
        if resampled is None:
            return torch.from_numpy(points * focal + centre).to(xy)
        points = undistort(points * focal[0] / resampled.fx, resampled)
        return torch.from_numpy(points * undistorted_camera(resampled).fx + centre).to(xy)

    graph.window.targets = recorded(graph.window.targets)
    centres = recorded(graph.window.patches[:, :2].movedim(1, -1)).movedim(-1, 1)
    graph.window.patches[:, :2] = centres
    g = torch.Generator().manual_seed(1)
    graph.window.targets += noise * torch.randn(graph.window.targets.shape, generator=g)
    for frame in graph.window.frames:
        frame.intrinsics[:2] *= factor
        if resampled is not None:
            frame.intrinsics[:2] = undistorted_camera(resampled).fx
    while len(graph.window):
        graph.archive_oldest()
    return graph


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.6, 0.9, 1.0, 1.5])
def test_the_focal_length_is_found_from_the_measurements(factor):
    graph = walk_with(factor, wrong=0.1)
    adjust_segment(graph, 0)
    before = graph.log.trajectory().poses_wc
    found = find_focal(graph, 0, Shutter(0.0, ROWS))
    assert np.array_equal(graph.log.trajectory().poses_wc, before)  # a look, no change
    assert np.exp(found.minimum.value) * factor == pytest.approx(1, abs=0.01)
    assert found.minimum.deviation < 0.06 and found.contrast > 0.02


def eucm(bend, size, focal=40.0):
    return Camera(focal, focal, size / 2, size / 2, size, size, "eucm", (bend, 1.0))


@given(bend=st.floats(0, 0.9), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_the_bend_is_a_lens_model(bend, x, y):
    ideal = np.array([[x, y]])
    seen = torch.from_numpy(distort(ideal, eucm(bend, 60)))
    np.testing.assert_allclose(undistorted(seen, bend).numpy(), ideal, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(("bend", "factor"), [(0.6, 1.4), (0.25, 1.0)])
def test_the_bend_of_the_lens_is_found_with_the_focal_length(bend, factor):
    graph = walk_with(factor, noise=0.03, bend=bend)
    adjust_segment(graph, 0)
    found = find_focal(graph, 0, Shutter(0.0, ROWS))
    assert found.bend.value == pytest.approx(bend, abs=0.05) and found.bend.deviation < 0.02
    assert np.exp(found.minimum.value) * factor == pytest.approx(1, abs=0.03)


@pytest.mark.long
@pytest.mark.parametrize("bend", [0.0, -0.2])
def test_a_lens_without_barrel_distortion_has_no_bend(bend):
    graph = walk_with(1.1, bend=bend)
    adjust_segment(graph, 0)
    found = find_focal(graph, 0, Shutter(0.0, ROWS))
    assert found.bend.value == 0


@pytest.mark.long
def test_images_without_their_distortion_tell_the_lens_that_they_were_recorded_with():
    """The distortion that was taken from them was half of that of the lens, and the focal length too long."""
    graph = walk_with(1.0, noise=0.03, bend=0.6, resampled=eucm(0.4, 60, focal=46.0))
    adjust_segment(graph, 0)
    found = find_focal(graph, 0, Shutter(0.0, ROWS), lens=eucm(0.4, 60, focal=46.0))
    assert found.bend.value == pytest.approx(0.6, abs=0.05)
    assert np.exp(found.minimum.value) * 46.0 == pytest.approx(40.0, rel=0.03)


@pytest.mark.slow
def test_a_rolling_shutter_has_to_be_corrected():
    graph = walk_with(1.0, noise=0.02, readout=0.06)
    adjust_segment(graph, 0, shutter=Shutter(0.06, ROWS))
    errors = [abs(find_focal(graph, 0, Shutter(readout, ROWS)).minimum.value) for readout in (0.0, 0.06)]
    assert errors[1] < 0.01 < errors[0]


def test_driving_straight_ahead_does_not_tell(monkeypatch):
    def ahead(times):
        zero = torch.zeros_like(times)
        return se3.exp(torch.stack([zero, zero, -times, zero, zero, zero], -1))

    monkeypatch.setattr(walks, "pose_at", ahead)
    graph = walk_with(0.9)
    adjust_segment(graph, 0)
    found = find_focal(graph, 0, Shutter(0.0, ROWS))
    assert found.contrast < 0.02 or found.minimum.deviation > 0.1


def test_few_frames_conclude_nothing():
    found = find_focal(walk_with(0.9, frames=12), 0, Shutter(0.0, ROWS))
    assert found.minimum.deviation == np.inf and found.contrast == 0 and found.minimum.value == 0


@pytest.mark.long
@pytest.mark.parametrize(("factor", "readout"), [(0.75, 0.0), (1.0, 0.0), (1.0, 0.06)])
def test_a_quick_look_tells_a_wrong_focal_length_from_a_right_one(factor, readout, monkeypatch):
    """Of a right one the coarse profile is enough; dropped frames may be left out."""
    monkeypatch.setattr(focal_length, "QUICK_FRAMES", 30)
    graph = walk_with(factor, dropped=tuple(range(1, 40, 2)), readout=readout)
    shutter = Shutter(readout, ROWS)
    adjust_segment(graph, 0, shutter=shutter)
    found = find_focal(graph, 0, shutter, beyond=0.12)
    if factor == 1:
        assert abs(found.minimum.value) < 0.04 and found.contrast == 0
    else:
        assert np.exp(found.minimum.value) * factor == pytest.approx(1, abs=0.02) and found.contrast > 0.02
