"""Focal length from the measurements of an archived walk."""

import numpy as np
import pytest
import torch

from dvo.geometry import se3
from dvo.odometry.global_ba import focal_length
from dvo.odometry.global_ba.final_adjustment import adjust_segment
from dvo.odometry.global_ba.focal_length import find_focal
from dvo.odometry.global_ba.rolling_shutter import Shutter
from tests.support import archived_walk as walks
from tests.support.archived_walk import ROWS, archived_walk


def walk_with(factor, noise=0.1, **options):
    """Archived walk whose keyframes hold a focal length that is wrong by a factor, with noise in the measurements."""
    graph, _ = archived_walk(archived=False, **options)
    g = torch.Generator().manual_seed(1)
    graph.window.targets += noise * torch.randn(graph.window.targets.shape, generator=g)
    for frame in graph.window.frames:
        frame.intrinsics[:2] *= factor
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
