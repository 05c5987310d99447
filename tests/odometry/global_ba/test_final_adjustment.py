"""Final adjustment of a segment: dropped frames, wrong measurements, blocks."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.ba.multistart import multistart, reversed_relief
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.map.archive import ArchiveConfig
from dvo.metrics import evaluate
from dvo.odometry.global_ba.final_adjustment import (
    AdjustmentOptions,
    adjust_segment,
    extend_solution,
    extrapolated,
    thinned,
)
from dvo.session.session import run
from dvo.synth.sequence import make_sequence
from tests.support.archived_walk import archived_walk


@pytest.mark.long
@pytest.mark.parametrize("block", [600, 15])
@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_poses_and_scale_are_found_from_the_measurements(wrong, block):
    """Also with every sixth measurement wrong, and in blocks: the frames of the next one go along with the first."""
    graph, truth = archived_walk(wrong=wrong, dropped=(7, 8, 20, 30))
    assert evaluate(graph.log.trajectory(), truth).ate_percent > 1
    assert adjust_segment(graph, 0, AdjustmentOptions(block=block, overlap=5, iterations=40)) == 40
    found = evaluate(graph.log.trajectory(), truth)
    assert found.matched == 40 and found.ate_percent < 0.1 and found.rpe_rot_deg < 0.01
    assert graph.archive[8].anchor == 7 and graph.archive[7].anchor == 6  # still relative to the keyframes before
    again, _ = archived_walk(wrong=wrong, dropped=(7, 8, 20, 30))
    adjust_segment(again, 0, AdjustmentOptions(block=block, overlap=5, iterations=40))
    assert np.array_equal(again.log.trajectory().poses_wc, graph.log.trajectory().poses_wc)


def test_frames_whose_measurements_are_released_stay_and_hold_the_scale():
    whole = archived_walk()[0].archive
    size = sum(frame.patch_bytes for frame in whole) + sum(part.nbytes for part in whole.parts) // 2
    graph, truth = archived_walk(archive=ArchiveConfig(max_bytes=size, features=False))
    first = int(min(graph.archive.edges().source.min(), graph.archive.edges().target.min()))
    assert 5 < first < 30
    before = graph.log.trajectory()
    assert adjust_segment(graph, 0, AdjustmentOptions(overlap=4)) == 40
    after = graph.log.trajectory()
    held = first + 4
    assert np.array_equal(before.poses_wc[:held], after.poses_wc[:held])
    assert not np.isclose(before.poses_wc[held:], after.poses_wc[held:]).all()
    assert np.isfinite(after.poses_wc).all() and len(after) == len(truth)


def test_a_reversed_relief_is_left():
    """Frames of a short baseline that were tracked with the second solution get the first one."""
    for restart_frames, frames, exact in ((0, 6, False), (60, 6, True), (3, 6, True), (60, 30, True)):
        graph, truth = archived_walk(frames=frames, interval=0.18 / frames)
        part = graph.problem(True, 0)
        (wrong,) = multistart(part, {"reversed": reversed_relief})
        poses, patches = wrong.problem.poses_cw, wrong.problem.patches
        for i in range(frames):
            graph.correct(i, poses[i].numpy(), patches[8 * i : 8 * i + 8, 2, 0, 0].numpy())
        adjust_segment(graph, 0, AdjustmentOptions(restart_frames=restart_frames, iterations=30))
        found = evaluate(graph.log.trajectory(), truth)
        assert (found.rpe_rot_deg < 0.01) == exact


def test_a_segment_too_short_or_unknown_is_left_alone():
    graph, _ = archived_walk(frames=2)
    before = graph.log.trajectory().poses_wc
    assert adjust_segment(graph, 0) == 0 and adjust_segment(graph, 5) == 0
    assert np.array_equal(graph.log.trajectory().poses_wc, before)


@given(st.floats(0.3, 3.0), st.integers(3, 9))
def test_a_better_beginning_is_extended_to_later_frames(scale, first):
    """Of a solution in another unit, the rest follows the beginning in the right one, with an equal depth by frame."""
    generator = torch.Generator().manual_seed(first)
    true_cw = se3.exp(0.3 * torch.randn(12, 6, generator=generator, dtype=torch.float64))
    true_depths = 0.5 + torch.rand(12, 1, generator=generator, dtype=torch.float64).expand(12, 6)
    old_cw = torch.cat([scale * true_cw[:, :3], true_cw[:, 3:]], 1)
    poses, depths = extend_solution(old_cw, true_depths / scale, true_cw[:first], true_depths[:first, ::2])
    torch.testing.assert_close(se3.relative(true_cw, poses), se3.identity(dtype=torch.float64).expand(12, 7))
    torch.testing.assert_close(depths, true_depths)


@pytest.mark.slow
def test_frames_dropped_on_a_slow_walk_get_the_scale_of_the_whole():
    """Most frames of a slow walk are dropped; their poses are as exact as those of the keyframes."""
    clip = make_sequence(77, frames=40, height=144, width=192, fps=90.0, family="street", kind="handheld", apart=True)
    errors = []
    for final_adjustment in (False, True):
        done = run(dvo.load("small", seed=0, pixels=144 * 192, final_adjustment=final_adjustment), clip)
        errors.append(evaluate(done.result.trajectory, clip.groundtruth).ate_percent)
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.slow
def test_frames_of_a_slow_start_get_poses_of_their_own():
    """Before the initialisation a frame with little motion has the pose of the last keyframe; afterwards its own."""
    clip = make_sequence(77, frames=40, height=144, width=192, fps=90.0, family="street", kind="handheld", apart=True)
    shares, errors = [], []
    for final_adjustment in (False, True):
        done = run(dvo.load("small", seed=0, pixels=144 * 192, final_adjustment=final_adjustment), clip)
        rows = done.result.trajectory.poses_wc
        shares.append((np.diff(rows, axis=0) == 0).all(1).mean())
        errors.append(evaluate(done.result.trajectory, clip.groundtruth).rpe_rot_deg_rmse)
        assert len(rows) == 40
    assert shares[0] > 0.1 and shares[1] == 0
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize(
    "change", [{"kernels": ()}, {"iterations": 0}, {"block": 1}, {"tolerance": -1.0}, {"overlap": 2.5}]
)
def test_options_out_of_range_are_named(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        AdjustmentOptions(**change)


@given(st.integers(0, 999), st.floats(-3, 3))
def test_solutions_along_a_line_are_extrapolated_exactly(seed, ratio):
    g = torch.Generator().manual_seed(seed)
    first = se3.exp(torch.randn(4, 6, generator=g, dtype=torch.float64))
    twist, grown = (
        0.1 * torch.randn(4, 6, generator=g, dtype=torch.float64),
        0.3 * torch.rand(4, 5, generator=g).double(),
    )
    depths = 0.2 + torch.rand(4, 5, generator=g, dtype=torch.float64)

    def at(value):
        return se3.compose(se3.exp(value * twist), first), depths * torch.exp(value * grown)

    poses, found = extrapolated(*at(1.0), *at(0.0), ratio)
    wanted, wanted_depths = at(1.0 + ratio)
    assert se3.log(se3.relative(poses, wanted)).abs().max() < 1e-9
    torch.testing.assert_close(found, wanted_depths, atol=1e-9, rtol=1e-9)


@settings(max_examples=40)
@given(st.lists(st.booleans(), max_size=70), st.integers(1, 30))
def test_frames_are_thinned_to_a_number(kept, count):
    kept = torch.tensor(kept, dtype=torch.bool)
    chosen = thinned(kept, count)
    assert int(chosen.sum()) == min(count, len(kept))
    assert bool(chosen[kept].all() if int(kept.sum()) <= count else ~chosen[~kept].any())
