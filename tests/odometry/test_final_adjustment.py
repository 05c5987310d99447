"""Final adjustment of a segment: dropped frames, wrong measurements, blocks."""

import numpy as np
import pytest
import torch

import dvo
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.graph.archive import ArchiveConfig
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.window import Keyframe
from dvo.metrics import evaluate
from dvo.nets.patchifier import patch_coordinates
from dvo.odometry.final_adjustment import AdjustmentOptions, adjust_segment
from dvo.odometry.session import run
from dvo.synth.sequence import make_sequence

M, REACH = 8, 6  # patches of a frame; frames that an edge reaches


def walk(frames=40, wrong=0.0, dropped=range(0), archive=None):
    """Graph of a camera that walks along a wall, all archived with poses that drift in scale; and the true poses.

    Args:
        wrong: share of measurements that are off by some pixels.
        dropped: frames that are dropped.
    """
    g = torch.Generator().manual_seed(0)
    steps = torch.zeros(frames, 6, dtype=torch.float64)
    steps[1:, 0] = 0.1
    steps[1:] += 0.01 * torch.randn(frames - 1, 6, generator=g, dtype=torch.float64)
    poses = [se3.identity(dtype=torch.float64)]
    for step in steps[1:]:
        poses.append(se3.compose(se3.exp(step), poses[-1]))
    true = torch.stack(poses)
    centres = torch.randint(6, 54, (1, frames, M, 2), generator=g)
    depth = 0.3 + 0.4 * torch.rand(1, frames * M, generator=g)
    patches = patch_coordinates(centres, depth, 3)
    intrinsics = torch.tensor([40.0, 40.0, 30.0, 30.0])
    graph = KeyframeGraph(M, 3, 4, torch.device("cpu"), archive)
    drift = torch.linspace(1.0, 1.5, frames).double()
    for i in range(frames):
        part = slice(i * M, (i + 1) * M)
        frame = Keyframe(i, 0.1 * i, i, torch.zeros(M, 8, 3, 3), torch.zeros(M, 4), torch.zeros(M, 3), intrinsics)
        drifting = torch.cat([true[i, :3] * drift[i], true[i, 3:]]).float()
        graph.window.append(frame, drifting, patches[0, part])
        graph.log.add(0.1 * i, i)
    kk = torch.arange(frames * M).repeat_interleave(frames)
    jj = torch.arange(frames).repeat(frames * M)
    near = (kk // M != jj) & ((kk // M - jj).abs() <= REACH)
    kk, jj = kk[near], jj[near]
    graph.window.connect(kk, jj)
    seen = reproject(true[None].float(), patches, intrinsics.expand(1, frames, 4), kk // M, jj, kk).coords[0, :, 1, 1]
    bad = torch.rand(len(kk), generator=g) < wrong
    graph.window.targets = seen + bad[:, None] * torch.tensor([3.0, 1.0])
    graph.window.weights = torch.full((len(kk), 2), 0.5)
    for i in sorted(dropped, reverse=True):
        graph.drop(i)
    while len(graph.window):
        graph.archive_oldest()
    return graph, Trajectory(0.1 * np.arange(frames), se3.inverse(true).numpy())


@pytest.mark.parametrize("block", [600, 15])
@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_poses_and_scale_are_found_from_the_measurements(wrong, block):
    """Also with every sixth measurement wrong, and in blocks: the frames of the next one go along with the first."""
    graph, truth = walk(wrong=wrong, dropped=(7, 8, 20, 30))
    assert evaluate(graph.log.trajectory(), truth).ate_percent > 1
    assert adjust_segment(graph, 0, AdjustmentOptions(block=block, overlap=5, iterations=40)) == 40
    found = evaluate(graph.log.trajectory(), truth)
    assert found.matched == 40 and found.ate_percent < 0.1 and found.rpe_rot_deg < 0.01
    assert graph.archive[8].anchor == 7 and graph.archive[7].anchor == 6  # still relative to the keyframes before
    again, _ = walk(wrong=wrong, dropped=(7, 8, 20, 30))
    adjust_segment(again, 0, AdjustmentOptions(block=block, overlap=5, iterations=40))
    assert np.array_equal(again.log.trajectory().poses_wc, graph.log.trajectory().poses_wc)


def test_keyframes_whose_patches_are_released_stay_and_hold_the_scale():
    graph, _ = walk()
    size = graph.archive.nbytes
    graph, truth = walk(archive=ArchiveConfig(max_bytes=size * 3 // 4, features=False))
    released = [k.identifier for k in graph.archive if not len(k.inverse_depth)]
    before = graph.log.trajectory()
    solved = adjust_segment(graph, 0, AdjustmentOptions(overlap=4))
    after = graph.log.trajectory()
    held = len(released) + 4 if released else 1
    assert solved == 40 - len(released)
    assert np.array_equal(before.poses_wc[:held], after.poses_wc[:held])
    assert np.isfinite(after.poses_wc).all() and len(after) == len(truth)


def test_a_segment_too_short_or_unknown_is_left_alone():
    graph, _ = walk(frames=2)
    before = graph.log.trajectory().poses_wc
    assert adjust_segment(graph, 0) == 0 and adjust_segment(graph, 5) == 0
    assert np.array_equal(graph.log.trajectory().poses_wc, before)


def test_frames_dropped_on_a_slow_walk_get_the_scale_of_the_whole():
    """Most frames of a slow walk are dropped; their poses are as exact as those of the keyframes."""
    clip = make_sequence(77, frames=40, height=144, width=192, fps=30.0, family="street", kind="handheld", apart=True)
    errors = []
    for final_adjustment in (False, True):
        done = run(dvo.load("small", seed=0, pixels=144 * 192, final_adjustment=final_adjustment), clip)
        errors.append(evaluate(done.result.trajectory, clip.groundtruth).ate_percent)
    assert errors[1] < 0.8 * errors[0]
