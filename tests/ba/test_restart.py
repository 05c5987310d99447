"""Restart of bundle adjustment: it leaves reversed reliefs and the motion of another body, and nothing else."""

import pytest
import torch

from dvo.ba.restart import STARTS, RestartOptions, better_start, equal_depths, restart, reversed_relief
from dvo.geometry import se3
from dvo.geometry.projection import reproject

FIXED = torch.arange(8) < 1


def scene(seed: int, shift: float = 0.15, rotation: float = 0.04, moving: float = 0.0):
    """Eight frames that see 60 points in front of the first ones; the share ``moving`` of the points goes its own way.

    Returns:
        True poses ``(8, 7)``, true patches ``(60, 3, 1, 1)`` and the measurements.
    """
    generator = torch.Generator().manual_seed(seed)
    twists = torch.randn(8, 6, generator=generator, dtype=torch.float64) * torch.tensor([shift] * 3 + [rotation] * 3)
    twists[0] = 0
    poses = se3.exp(twists)
    depth = 0.5 + torch.rand(60, generator=generator, dtype=torch.float64)
    centres = torch.rand(60, 2, generator=generator, dtype=torch.float64) * torch.tensor([80.0, 60.0])
    patches = torch.cat([centres, depth[:, None]], 1)[..., None, None]
    intrinsics = torch.tensor([70.0, 70, 40, 30], dtype=torch.float64).expand(8, 4)
    kk = torch.arange(60).repeat_interleave(8)
    ii, jj = kk // 20, torch.arange(8).repeat(60)
    kk, ii, jj = (x[ii != jj] for x in (kk, ii, jj))
    targets = reproject(poses[None], patches[None], intrinsics[None], ii, jj, kk).coords[0, :, 0, 0]
    walk = torch.tensor([1.5, 0.4], dtype=torch.float64) * (jj - ii)[:, None]
    targets = targets + walk * (kk % 20 < 20 * moving)[:, None]
    targets = targets + 0.05 * torch.randn(targets.shape, generator=generator, dtype=torch.float64)
    return poses, patches, (intrinsics, targets, torch.ones_like(targets), ii, jj, kk)


def rotation_error(poses, truth):
    return float(se3.log(se3.relative(truth, poses))[:, 3:].norm(dim=1).max())


@pytest.mark.parametrize("seed", range(4))
def test_a_reversed_relief_is_left(seed):
    poses, patches, measured = scene(seed, shift=0.06)
    wrong, relief, cost = restart(poses, patches, measured, FIXED, "reversed")
    assert rotation_error(wrong, poses) > 0.02  # a minimum of its own: iterations do not lead out of it
    found = better_start(wrong, relief, measured, FIXED)
    assert found is not None and rotation_error(found.poses_cw, poses) < 0.01
    assert restart(wrong, relief, measured, FIXED, found.start)[2] < 0.5 * cost


@pytest.mark.parametrize("seed", range(4))
def test_the_right_solution_is_kept(seed):
    poses, patches, measured = scene(seed)
    assert better_start(poses, patches, measured, FIXED) is None


@pytest.mark.parametrize("seed", range(4))
def test_the_motion_of_a_moving_body_is_left(seed):
    """Poses that follow a body with a third of the points, and depths that suit these poses."""
    poses, patches, measured = scene(seed, moving=0.35)
    along = poses.clone()
    along[:, 0] += torch.arange(8) * 0.02
    weights = torch.where((measured[-1] % 20 < 7)[:, None], 1.0, 0.01).to(poses).expand(-1, 2)
    wrong, relief, _ = restart(along, patches, (*measured[:2], weights, *measured[3:]), FIXED, "equal")
    assert rotation_error(wrong, poses) > 0.02
    found = better_start(wrong, relief, measured, FIXED, RestartOptions(iterations=30))
    assert found is not None and rotation_error(found.poses_cw, poses) < 0.7 * rotation_error(wrong, poses)


def test_starts_are_positive_and_keep_the_median():
    depths = torch.tensor([0.01, 0.5, 1.0, 1.5, 40.0]).view(5, 1, 1)
    for start in STARTS.values():
        values = start(depths)
        assert values.shape == depths.shape and (values > 0).all() and values.median() == 1
    assert reversed_relief(depths).flatten().tolist() == pytest.approx([1.99, 1.5, 1.0, 0.5, 0.1])
    assert (equal_depths(depths) == 1).all()
