"""ATE and RPE of random trajectories against evo; those of real ones are in ``tests/metrics/test_metrics.py``."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import compose_poses, pose_from, se3_exp
from dvo.metrics import evaluate

pytestmark = pytest.mark.peers


def pair(seed: int) -> tuple[Trajectory, Trajectory]:
    """A random walk, and an estimate of it in another frame and scale, with noise, gaps, and times a little off."""
    rng = np.random.default_rng(seed)
    pose, poses = np.array([0.0, 0, 0, 0, 0, 0, 1]), []
    for _ in range(80):
        pose = compose_poses(pose, pose_from(*se3_exp(np.r_[rng.normal(0.1, 0.05, 3), rng.normal(0, 0.05, 3)])))
        poses.append(pose)
    truth = Trajectory(10 + 0.1 * np.arange(80), np.stack(poses))
    world = pose_from(*se3_exp(rng.normal(0, 1, 6)))
    noise = np.stack([pose_from(*se3_exp(0.02 * rng.normal(size=6))) for _ in poses])
    estimate = compose_poses(compose_poses(world, truth.poses_wc), noise)
    estimate[:, :3] *= 0.4
    kept = np.sort(rng.choice(80, 65, replace=False))
    return truth, Trajectory(truth.timestamps[kept] + rng.uniform(-0.004, 0.004, 65), estimate[kept])


@pytest.mark.long
@pytest.mark.parametrize("align", ["none", "scale", "se3", "sim3"])
@pytest.mark.parametrize("gap", [1, 5])
@pytest.mark.parametrize("seed", range(3))
def test_evo(align: str, gap: int, seed: int) -> None:
    evo_trajectory = pytest.importorskip("evo.core.trajectory", reason="evo is in the extra 'eval'")
    from evo.core import metrics, sync
    from evo.core.units import Unit

    truth, estimate = pair(seed)
    reference, track = (
        evo_trajectory.PoseTrajectory3D(t.poses_wc[:, :3], np.roll(t.poses_wc[:, 3:], 1, axis=1), t.timestamps)
        for t in (truth, estimate)
    )
    reference, track = sync.associate_trajectories(reference, track, max_diff=0.01)
    track = copy.deepcopy(track)
    if align != "none":
        track.align(reference, correct_scale=align != "se3", correct_only_scale=align == "scale")
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((reference, track))
    ours = evaluate(estimate, truth, align, rpe_gap=gap)
    assert ours.matched == 65 and ours.ate_rmse == pytest.approx(
        ate.get_statistic(metrics.StatisticsType.rmse), rel=1e-8
    )
    for relation, median, rmse in (
        (metrics.PoseRelation.translation_part, ours.rpe_trans, ours.rpe_trans_rmse),
        (metrics.PoseRelation.rotation_angle_deg, ours.rpe_rot_deg, ours.rpe_rot_deg_rmse),
    ):
        rpe = metrics.RPE(relation, delta=gap, delta_unit=Unit.frames, all_pairs=True)
        rpe.process_data((reference, track))
        assert median == pytest.approx(rpe.get_statistic(metrics.StatisticsType.median), rel=1e-6)
        assert rmse == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
