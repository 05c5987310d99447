"""References that are no poses of the camera in a right-handed world."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import invert_poses
from dvo.metrics import other_convention

MIRROR_Z = np.array([1, 1, -1, -1, -1, 1, 1.0])


def walk(seed: int, height: float = 1.0) -> Trajectory:
    """Up a spiral staircase, with a camera that turns along; of no height it is a mirror image of itself."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 6, 60)
    positions = np.stack([np.cos(1.5 * t), rng.uniform(0.7, 1.3) * np.sin(1.5 * t), height * t / 4], 1)
    angles = np.stack([np.sin(t * a) for a in rng.uniform(0.3, 1.0, 3)], 1) / 2
    quaternions = np.concatenate([angles, np.ones((60, 1))], 1)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Trajectory(t, np.concatenate([positions, quaternions], 1))


@pytest.mark.parametrize("seed", range(5))
def test_inverted_and_mirrored_poses_are_told(seed: int) -> None:
    truth = walk(seed)
    noise = np.random.default_rng(seed).normal(scale=0.01, size=(60, 3))
    estimate = Trajectory(truth.timestamps, truth.poses_wc.copy())
    estimate.poses_wc[:, :3] = 0.3 * (truth.positions + noise)
    assert other_convention(estimate, truth) is None
    inverted = Trajectory(truth.timestamps, invert_poses(truth.poses_wc))
    assert "T_cw" in (other_convention(estimate, inverted) or "")
    mirrored = Trajectory(truth.timestamps, truth.poses_wc * MIRROR_Z)
    assert "left-handed" in (other_convention(estimate, mirrored) or "")


def test_what_no_convention_explains_is_not_told() -> None:
    truth = walk(1)
    wrong = Trajectory(truth.timestamps, truth.poses_wc.copy())
    wrong.poses_wc[:, :3] = np.random.default_rng(0).normal(size=(60, 3)).cumsum(0)
    assert other_convention(wrong, truth) is None
    flat = walk(3, 0.0)
    assert other_convention(flat, Trajectory(flat.timestamps, flat.poses_wc * MIRROR_Z)) is None
    few = Trajectory(truth.timestamps[:5], truth.poses_wc[:5])
    assert other_convention(few, Trajectory(few.timestamps, few.poses_wc * MIRROR_Z)) is None
