"""Revision of the first solution some frames after the initialisation."""

import torch

from dvo.ba.kernels import Kernel
from dvo.ba.restart import restart
from dvo.geometry import se3
from dvo.odometry.config import TrackerConfig
from dvo.odometry.final_adjustment import AdjustmentOptions
from dvo.odometry.initialisation import RESTARTS, leave_minimum
from tests.archived_walk import archived_walk, pose_at


def _reversed_window():
    """Window of six frames with the second solution of its measurements, and the true poses."""
    graph, _ = archived_walk(frames=6, interval=0.03, archived=False)
    window = graph.window
    true = pose_at(0.03 * torch.arange(6, dtype=torch.float64))
    window.poses_cw = true.float()
    measured = (window.intrinsics, window.targets, window.weights, window.ii, window.jj, window.kk)
    fixed = torch.arange(6) < 1
    window.poses_cw, window.patches, _ = restart(window.poses_cw, window.patches, measured, fixed, "reversed")
    return window, true.float()


def _error(poses, true):
    return float(se3.log(se3.relative(poses, true))[:, 3:].norm(dim=1).max())


def test_a_window_with_reversed_relief_is_started_anew():
    window, true = _reversed_window()
    assert _error(window.poses_cw, true) > 0.01
    assert leave_minimum(window, min(RESTARTS))
    assert _error(window.poses_cw, true) < 0.001 and window.poses_cw.dtype == window.patches.dtype == torch.float32
    before = window.poses_cw.clone(), window.patches.clone()
    assert not leave_minimum(window, min(RESTARTS))  # the right solution stays as it is
    assert torch.equal(window.poses_cw, before[0]) and torch.equal(window.patches, before[1])


def test_nothing_is_tried_at_other_frames():
    window, _ = _reversed_window()
    poses = window.poses_cw
    assert not any(leave_minimum(window, age) for age in range(1, 100) if age not in RESTARTS)
    assert window.poses_cw is poses


def test_settings_turn_kernel_and_restart_off():
    config = TrackerConfig(robust=0, restart=False)
    assert config.kernel == Kernel("none") and config.adjustment.restart_frames == 0
    assert TrackerConfig(robust=0.2).kernel == Kernel("cauchy", 0.2)
    assert TrackerConfig().adjustment == AdjustmentOptions()
