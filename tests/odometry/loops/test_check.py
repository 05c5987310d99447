"""Decision about a match of two visits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.geometry import se3
from dvo.odometry.loops.check import Limits, is_loop, median_inverse_depth
from dvo.odometry.loops.joint_window import Match

OPTIONS = Limits(inliers=0.4, weak_inliers=0.12, translation=0.2, rotation=3.0, scale=0.1)
DEPTH = 5.0


@dataclass(frozen=True)
class Archived:
    identifier: int
    inverse_depth: np.ndarray = field(default_factory=lambda: np.array([0.1, 1 / DEPTH, 3.0]))


@dataclass(frozen=True)
class Wanted:
    new: int = 11


@dataclass(frozen=True)
class Visits:
    """Pair with what the decision reads."""

    present_cw: torch.Tensor | None
    old: tuple[Archived, ...] = (Archived(1), Archived(2), Archived(3))
    new: tuple[Archived, ...] = (Archived(10), Archived(11), Archived(12))
    candidate: Wanted = Wanted()
    joins: bool = False


def judged(
    inliers, turn=0.0, shift=0.0, scale=1.0, other_world=False, corners=False, present=(0.3, -0.2, 1.0, 0.4, 0.1, -0.3)
):
    """Decision for a later visit, found turned (degrees) and moved (median depths) against its present pose.

    In another world there is none, or that of corners.
    """
    present = se3.exp(torch.tensor(present, dtype=torch.float64))
    change = torch.tensor([0, 0, shift * DEPTH, 0, 0, 0], dtype=torch.float64)
    angle = torch.tensor([0, 0, 0, 0, math.radians(turn), 0], dtype=torch.float64)
    poses = se3.identity(6, dtype=torch.float64).clone()
    poses[4] = se3.compose(se3.exp(change), se3.compose(se3.exp(angle), present))  # the second of the newer group
    known = None if other_world and not corners else present
    return is_loop(Match(inliers, poses, scale, None, None), Visits(known, joins=other_world), OPTIONS)


def test_many_inliers_suffice():
    assert judged(0.4, turn=120.0, shift=3.0, scale=0.2)
    assert judged(0.4, other_world=True)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ({"inliers": 0.12}, {"inliers": 0.119}),
        ({"turn": 2.9}, {"turn": 3.1}),
        ({"shift": -0.19}, {"shift": -0.21}),
        ({"scale": 1.09}, {"scale": 1.11}),
        ({"scale": 1 / 1.09}, {"scale": 1 / 1.11}),
        ({"other_world": False}, {"other_world": True}),
    ],
)
def test_with_few_inliers_the_present_pose_has_to_agree(right, wrong):
    assert judged(**{"inliers": 0.3, **right}) and not judged(**{"inliers": 0.3, **wrong})


def test_corners_tell_the_pose_closely_and_the_scale_roughly():
    ahead = {"inliers": 0.2, "other_world": True, "corners": True}
    assert judged(**ahead, scale=1.45) and judged(**ahead, scale=1 / 1.45) and not judged(**ahead, scale=1.55)
    assert judged(**ahead, turn=2.9) and not judged(**ahead, turn=3.1)
    assert judged(**ahead, shift=0.19) and not judged(**ahead, shift=0.21)


@given(st.tuples(*[st.floats(-2, 2)] * 6), st.floats(-0.3, 0.3), st.floats(-5, 5))
def test_the_world_that_the_poses_are_told_in_does_not_count(present, shift, turn):
    near_limit = abs(abs(shift) - OPTIONS.translation) < 1e-6 or abs(abs(turn) - OPTIONS.rotation) < 1e-6
    assert near_limit or judged(0.2, turn, shift, present=present) == judged(0.2, turn, shift)


def test_what_is_not_a_number_is_no_loop():
    assert not judged(math.nan) and not judged(0.3, scale=math.nan) and not judged(0.3, shift=math.nan)


def test_released_patches_tell_no_depth():
    assert median_inverse_depth(Archived(1)) == pytest.approx(1 / DEPTH)
    assert math.isnan(median_inverse_depth(Archived(1, np.zeros(0))))
