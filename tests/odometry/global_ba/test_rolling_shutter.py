"""Correction of measurements for a rolling shutter, and the readout time that explains the measurements."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.kernels import VARIABLE
from dvo.geometry import se3
from dvo.metrics import evaluate
from dvo.odometry.global_ba.final_adjustment import adjust_segment
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter
from dvo.odometry.global_ba.self_calibration import adjust_segments, find_readout, profile_minimum
from dvo.synth.render.rolling import row_offsets
from tests.support.archived_walk import ROWS, M, archived_walk, pose_at


def test_rows_are_read_at_the_times_that_the_renderer_reads_them():
    rows = np.arange(240)
    found = Shutter(0.03, 60).offsets(torch.from_numpy(rows / 4))
    np.testing.assert_allclose(found, row_offsets(rows, 240, 0.03), atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(-0.02, 0.02))
def test_a_constant_twist_is_followed_exactly(seed, offset):
    g = torch.Generator().manual_seed(seed)
    twist = 0.5 * torch.randn(6, generator=g, dtype=torch.float64)
    times = torch.cumsum(0.02 + 0.05 * torch.rand(9, generator=g, dtype=torch.float64), 0)
    poses = se3.exp(times[:, None] * twist)
    track = PoseTrack.through(times, poses)
    frames = torch.arange(9)
    moved = se3.compose(track.motion(frames, torch.full((9,), offset, dtype=torch.float64)), poses)
    wanted = se3.exp((times + offset)[:, None] * twist)
    assert se3.log(se3.relative(moved, wanted)).abs().max() < 1e-9


@pytest.mark.parametrize("count", [1, 2, 3, 12])
def test_a_swaying_camera_is_followed_between_its_frames(count):
    times = 0.1 * torch.arange(count, dtype=torch.float64)
    track = PoseTrack.through(times, pose_at(times))
    offsets = torch.full((count,), 0.02, dtype=torch.float64)
    moved = se3.compose(track.motion(torch.arange(count), offsets), track.poses_cw)
    error = se3.log(se3.relative(moved, pose_at(times + 0.02))).norm(dim=1)
    assert error.max() < {1: 0.1, 2: 2e-3, 3: 5e-4}.get(count, 2e-5)


def test_a_tremor_between_frames_is_followed_by_a_gyroscope_and_not_by_the_poses():
    def shaken(times):
        angle = 0.01 * torch.sin(2 * np.pi * 8.0 * times)
        turn = torch.stack([angle, -0.5 * angle, 0.2 * angle], -1)
        return se3.compose(se3.exp(torch.cat([torch.zeros_like(turn), turn], -1)), pose_at(times))

    def turns(times, offsets):
        moved = torch.from_numpy(times)[:, None] + torch.from_numpy(offsets)
        from_frame = se3.relative(shaken(torch.from_numpy(times))[:, None].expand(*moved.shape, 7), shaken(moved))
        found = se3.log(from_frame)[..., 3:].numpy()
        found[:2] = np.nan  # without samples
        return found

    times = 0.05 * torch.arange(20, dtype=torch.float64)
    offsets = torch.full((20,), 0.012, dtype=torch.float64)
    errors = []
    for shutter in (None, Shutter(0.03, ROWS), Shutter(0.03, ROWS, turns)):
        track = PoseTrack.through(times, shaken(times), shutter)
        moved = se3.compose(track.motion(torch.arange(20), offsets), track.poses_cw)
        errors.append(se3.log(se3.relative(moved, shaken(times + offsets)))[:, 3:].norm(dim=1))
    assert torch.equal(errors[0], errors[1])
    torch.testing.assert_close(errors[2][:2], errors[0][:2], rtol=1e-6, atol=1e-9)
    assert errors[2][2:].max() < 0.05 * errors[0][2:].max()


def test_the_trajectory_of_a_rolling_shutter_is_exact_with_its_readout_time():
    errors = []
    for readout in (0.0, 0.03, 0.06):
        graph, truth = archived_walk(readout=0.06)
        adjust_segment(graph, 0, shutter=Shutter(readout, ROWS))
        errors.append(evaluate(graph.log.trajectory(), truth).ate_percent)
    assert errors[1] < 0.6 * errors[0] and errors[2] < 0.01 * errors[0]


@pytest.mark.long
@pytest.mark.parametrize("wrong", [0.0, 0.1])
@pytest.mark.parametrize("readout", [0.0, 0.025, 0.06])
def test_the_readout_time_is_found_from_the_measurements(readout, wrong):
    graph, truth = archived_walk(readout=readout, wrong=wrong)
    adjust_segment(graph, 0)
    before = graph.log.trajectory().poses_wc
    found = find_readout(graph, 0, ROWS)
    assert np.array_equal(graph.log.trajectory().poses_wc, before)  # a look, no change
    assert abs(found.value - readout) < 0.001
    assert found.gain == 0 if readout == 0 else found.gain > (0.01 if wrong else 0.9)


def test_the_readout_time_of_the_camera_wins_and_both_are_told():
    told, _ = archived_walk(readout=0.06)
    assert adjust_segments(told, [0], Shutter(0.05, ROWS), True) == {"readout": 0.05, "readout_from": "camera"}
    graph, truth = archived_walk(readout=0.06)
    assert adjust_segments(graph, [0], Shutter(0.0, ROWS), False) == {"readout": 0.0, "readout_from": "none"}
    distorted = evaluate(graph.log.trajectory(), truth).ate_percent
    info = adjust_segments(graph, [0], Shutter(0.0, ROWS), True)
    assert info["readout_from"] == "images" and info["readout"] == pytest.approx(0.06, abs=0.004)
    assert evaluate(graph.log.trajectory(), truth).ate_percent < 0.2 * distorted
    assert adjust_segments(graph, [], Shutter(0.0, ROWS), True) == {"readout": 0.0, "readout_from": "none"}


def test_few_frames_conclude_nothing():
    graph, _ = archived_walk(frames=12, readout=0.06)
    assert find_readout(graph, 0, ROWS).gain == 0


@settings(max_examples=30)
@given(st.floats(-0.9, 0.9), st.floats(0.1, 10))
def test_the_minimum_of_a_parabola_is_exact(centre, curvature):
    found = profile_minimum(lambda x: 1 + curvature * (x - centre) ** 2, 0.0, 0.2, -1.2, 1.2, 1)
    assert found.value == pytest.approx(centre, abs=1e-6) and np.isfinite(found.deviation)


def test_a_minimum_at_the_end_of_the_range_has_no_deviation():
    found = profile_minimum(lambda x: 2 - x, 0.0, 0.25, 0.0, 1.0, 1)
    assert found.value == 1.0 and found.deviation == np.inf and found.gain == pytest.approx(0.5)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.floats(-0.08, 0.08), st.booleans(), st.floats(0, 3))
def test_measurements_are_corrected_by_a_kernel_as_by_its_twin(seed, readout, empty, turn):
    g = torch.Generator().manual_seed(seed)
    graph, _ = archived_walk(frames=9)
    part = graph.problem(True, 0)
    part = part.edges(torch.rand(len(part.kk), generator=g) < (0.0 if empty else 0.5))
    twists = torch.randn(9, 6, generator=g, dtype=torch.float64) * torch.tensor([0.3, 0.3, 0.3, turn, turn, turn])
    poses, depths = se3.exp(twists), 0.05 + torch.rand(9, M, generator=g, dtype=torch.float64)
    track = PoseTrack.through(0.1 * torch.arange(9, dtype=torch.float64), poses)
    found = []
    for choice in ("numba", "torch"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(VARIABLE, choice)
            found.append(as_global_shutter(part, poses, depths, torch.arange(9), track, Shutter(readout, ROWS)))
    for name in ("patches", "targets"):
        torch.testing.assert_close(*(getattr(p, name) for p in found), atol=1e-7, rtol=1e-7)
