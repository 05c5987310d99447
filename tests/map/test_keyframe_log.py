"""Keyframe log: frames relative to keyframes, keyframes that are removed, the trajectory at the end."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.geometry import se3
from dvo.geometry.poses import pose_matrices
from dvo.map.keyframe_log import KeyframeLog


def poses(seed: int, count: int) -> np.ndarray:
    generator = torch.Generator().manual_seed(seed)
    return se3.exp(torch.randn(count, 6, generator=generator, dtype=torch.float64)).numpy()


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_reanchoring_keeps_every_frame_in_place(seed):
    """Three keyframes; the middle one goes twice over, and its frames stay where they were."""
    at = poses(seed, 3)
    kept, thinned = KeyframeLog(), KeyframeLog()
    for log in (kept, thinned):
        for time, anchor in ((0.0, 0), (0.1, 1), (0.2, 1), (0.3, 2)):
            log.add(time, anchor)
    for number in range(3):
        kept.set_pose(number, at[number])
    relative = [se3.relative(torch.from_numpy(at[i]), torch.from_numpy(at[i + 1])).numpy() for i in (0, 1)]
    thinned.reanchor(2, 1, relative[1])
    thinned.reanchor(1, 0, relative[0])
    thinned.set_pose(0, at[0])
    a, b = kept.trajectory(), thinned.trajectory()
    assert a.timestamps.tolist() == b.timestamps.tolist() == [0.0, 0.1, 0.2, 0.3]
    same = se3.log(se3.compose(torch.from_numpy(a.poses_wc), se3.inverse(torch.from_numpy(b.poses_wc))))
    assert same.abs().max() < 1e-9 and thinned.keyframes == 1


def test_lost_frames_and_those_without_a_keyframe_have_no_row():
    log = KeyframeLog()
    for time in (0.0, 0.1, 0.2):
        log.add(time, 0)
    log.frames[1].lost = True
    log.add(0.3, 7)
    assert len(log.trajectory()) == 0
    log.set_pose(0, np.array([0.0, 0, 0, 0, 0, 0, 1]))
    assert log.trajectory().timestamps.tolist() == [0.0, 0.2]


def test_an_empty_log():
    points, colors = KeyframeLog().points()
    assert len(KeyframeLog().trajectory()) == 0 and points.shape == colors.shape == (0, 3)


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_matrices_and_vectors_give_one_trajectory(seed):
    """Frames placed relative to keyframes that move and go: the same in both forms of a pose."""
    at = poses(seed, 5)
    logs = []
    for form in (np.asarray, pose_matrices):
        log = KeyframeLog()
        for time in range(4):
            log.add(float(time))
        log.set_pose(0, form(at[0]))
        log.set_pose(2, form(at[2]))
        for frame, anchor in ((0, 0), (1, 0), (2, 2), (3, 2)):
            log.place(frame, anchor, form(at[frame]))
        log.reanchor(2, 0)
        log.set_pose(0, form(at[4]))
        logs.append(log)
    a, b = (log.trajectory() for log in logs)
    same = se3.log(se3.compose(torch.from_numpy(a.poses_wc), se3.inverse(torch.from_numpy(b.poses_wc))))
    assert same.abs().max() < 1e-9 and logs[0].keyframes == 1
    first, moved, last = (pose_matrices(at[row]) for row in (0, 4, 3))
    np.testing.assert_allclose(logs[1].pose(3), last @ np.linalg.inv(first) @ moved, atol=1e-9)


def test_a_frame_without_anchor_has_no_pose_until_it_is_placed():
    log = KeyframeLog()
    log.add(0.0).lost = True
    assert log.pose(0) is None and len(log.trajectory()) == 0
    log.set_pose(4, np.eye(4))
    log.place(-1, 4, np.eye(4))
    assert not log.frames[0].lost and len(log.trajectory()) == 1
