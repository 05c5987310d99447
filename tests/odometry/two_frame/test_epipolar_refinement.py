"""Refinement of the motion of two views: exact flows, the plain minimum, outliers, pure rotation, degenerate flows."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from dvo.core.errors import DvoError
from dvo.geometry import so3
from dvo.losses.two_frame import true_flow
from dvo.odometry.two_frame.epipolar_refinement import (
    RefinementOptions,
    epipolar_residuals,
    flow_rays,
    motion_cost,
    refine_motion,
    refinement_step,
)

CAMERA = torch.tensor([24.0, 25.0, 19.0, 15.5], dtype=torch.float64)


def views(seed, length=0.1, turn=0.05, outliers=0.0):
    """Flow of a rough scene, and the motion ``T_ab`` that made it, with a translation of length one."""
    source = torch.Generator().manual_seed(seed)
    depth = 1 + 2 * torch.rand(1, 30, 40, generator=source, dtype=torch.float64)
    direction = torch.nn.functional.normalize(torch.randn(1, 3, generator=source, dtype=torch.float64), dim=-1)
    rotation = so3.exp(turn * torch.randn(1, 3, generator=source, dtype=torch.float64).clamp(-1.5, 1.5))
    flow, _ = true_flow(depth, torch.cat([length * direction, rotation], -1), CAMERA[None])
    wrong = torch.rand(30, 40, generator=source) < outliers
    flow = torch.where(wrong, 6 * torch.randn(flow.shape, generator=source, dtype=torch.float64), flow)
    return flow[0], torch.cat([direction, rotation], -1)[0]


def errors(found, true):
    """Degrees between the directions, and between the rotations."""
    turn = so3.angle(so3.multiply(so3.conjugate(true[3:]), found[3:]))
    angle = torch.linalg.cross(found[:3], true[:3]).norm().atan2(found[:3] @ true[:3])
    return float(angle.rad2deg()), float(turn.rad2deg())


def near(true, seed, by=0.02):
    """A start some degrees from the truth."""
    source = torch.Generator().manual_seed(seed)
    a, b = torch.randn(2, 3, generator=source, dtype=torch.float64)
    return torch.cat([true[:3] + 0.2 * a, so3.multiply(so3.exp(by * b), true[3:])])


def tangents(pose):
    """Two unit vectors perpendicular to the translation of a pose and to each other."""
    return torch.linalg.svd(pose[None, :3]).Vh[1:]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_flow_gives_the_motion(seed):
    flow, true = views(seed)
    found = refine_motion(flow, [near(true, seed)], CAMERA, RefinementOptions(iterations=30, parallax=0.0))
    assert found[:3].norm() == pytest.approx(1) and found[3:].norm() == pytest.approx(1)
    assert max(errors(found, true)) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_wrong_flows_do_not_decide(seed):
    flow, true = views(seed, length=0.4, outliers=0.3)
    start = near(true, seed, 0.01)
    robust = errors(refine_motion(flow, [start], CAMERA), true)
    squares = errors(refine_motion(flow, [start], CAMERA, RefinementOptions(scale=1e3)), true)
    assert robust[0] < min(5, 0.5 * squares[0]) and robust[1] < min(0.5, 0.5 * squares[1])


@pytest.mark.long
def test_the_cost_is_least_where_a_plain_search_finds_it():
    """The same cost, minimised by scipy without derivatives from the same start."""
    flow, true = views(3)
    flow = flow + 0.1 * torch.randn(flow.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    options, start = RefinementOptions(iterations=50, points=2000), near(true, 3)
    rays, basis = flow_rays(flow, CAMERA, 2000), tangents(start)

    def cost(x):
        turned = so3.multiply(so3.exp(torch.from_numpy(x[:3])), start[3:])
        direction = torch.nn.functional.normalize(start[:3] / start[:3].norm() + torch.from_numpy(x[3:]) @ basis, dim=0)
        return motion_cost(rays, turned, direction, options)

    plain = minimize(cost, np.zeros(5), method="Nelder-Mead", options={"maxiter": 4000, "xatol": 1e-7, "fatol": 1e-7})
    found = refine_motion(flow, [start], CAMERA, options)
    assert motion_cost(rays, found[3:], found[:3], options) <= plain.fun * (1 + 1e-4)


@pytest.mark.slow
def test_steps_use_the_derivatives_of_the_cost():
    """Without damping and weights (a wide scale), the gradient is that of half the sum of squares."""
    flow, true = views(6)
    start, options = near(true, 6), RefinementOptions(scale=1e3, parallax=2.0)
    direction, rays = torch.nn.functional.normalize(start[:3], dim=0), flow_rays(flow, CAMERA, 2000)
    basis = tangents(start)

    def residuals(x):
        turned = so3.multiply(so3.exp(x[:3]), start[3:])
        moved = torch.nn.functional.normalize(direction + x[3:] @ basis, dim=0)
        distance, left, _ = epipolar_residuals(rays.start, rays.end, turned, moved)
        return torch.cat([distance, options.parallax * left.flatten()])

    zero = torch.zeros(5, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(residuals, zero)
    plain = -torch.linalg.lstsq(jacobian, residuals(zero)[:, None]).solution[:, 0]
    rotation, moved = refinement_step(rays, start[3:], direction, options, 0.0)
    torch.testing.assert_close(
        so3.log(so3.multiply(rotation, so3.conjugate(start[3:]))), plain[:3], atol=1e-6, rtol=1e-4
    )
    wanted = torch.nn.functional.normalize(direction + plain[3:] @ basis, dim=0)
    torch.testing.assert_close(moved, wanted, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_flows_of_no_weight_do_not_count(seed):
    """A large part of the flow is wrong in the same way, which no robust cost finds out."""
    flow, true = views(seed)
    flow[:, :, 16:] = views(seed + 100, turn=0.1)[0][:, :, 16:]
    weights = torch.ones(30, 40)
    weights[:, 16:] = 0
    options, start = RefinementOptions(iterations=30, parallax=0.0), near(true, seed)
    weighted, equal = (errors(refine_motion(flow, [start], CAMERA, options, weights=w), true) for w in (weights, None))
    assert max(weighted) < 0.2 and equal[1] > 1
    cut = flow.clone()
    cut[:, :, 16:] = torch.nan  # pixels that are not finite are left out
    without = refine_motion(cut, [start], CAMERA, options)
    torch.testing.assert_close(refine_motion(flow, [start], CAMERA, options, weights=weights), without)


def test_a_weight_of_two_counts_a_pixel_twice():
    flow, true = views(7, outliers=0.2)
    options, start = RefinementOptions(points=300), near(true, 7)  # every second row and column
    twice = torch.ones(30, 40)
    twice[::4] = 2
    rays = flow_rays(flow, CAMERA, 300, twice)
    again = torch.cat([torch.arange(300), torch.arange(300)[rays.weights == 2]])
    plain = type(rays)(rays.start[again], rays.end[again], torch.ones(len(again)).double(), rays.focal)
    direction = torch.nn.functional.normalize(start[:3], dim=0)
    assert len(again) == 460 and (rays.weights == 2).sum() == 160
    motion = start[3:], direction, options
    assert motion_cost(rays, *motion) == pytest.approx(motion_cost(plain, *motion))
    for found, wanted in zip(*(refinement_step(r, *motion, 0.0) for r in (rays, plain)), strict=True):
        torch.testing.assert_close(found, wanted)


def test_residuals_are_distances_from_epipolar_lines():
    """To first order: the length of the least move of both ends that puts them on one epipolar plane."""
    flow, true = views(5)
    rays = flow_rays(flow, CAMERA, 10_000)
    distance, _, ahead = epipolar_residuals(rays.start, rays.end, true[3:], true[:3])
    assert ahead.all() and distance.abs().max() < 1e-9
    moved = rays.end.clone()
    moved[:, :2] += 1e-5 * torch.randn(moved[:, :2].shape, generator=torch.Generator().manual_seed(0))
    matrix = torch.tensor([[0.0, -true[2], true[1]], [true[2], 0.0, -true[0]], [-true[1], true[0], 0.0]])
    essential = matrix.double() @ so3.matrix(true[3:])
    lines = rays.start @ essential, moved @ essential.mT
    plain = (lines[0] * moved).sum(-1) / (lines[0][:, :2].square() + lines[1][:, :2].square()).sum(-1).sqrt()
    distance, _, _ = epipolar_residuals(rays.start, moved, true[3:], true[:3])
    torch.testing.assert_close(distance.abs(), plain.abs(), atol=1e-10, rtol=1e-5)


def test_a_camera_that_turns_is_found_to_turn():
    flow, true = views(2, length=0.0)
    assert errors(refine_motion(flow, [near(true, 2)], CAMERA, RefinementOptions(iterations=50)), true)[1] < 0.05


def test_the_translation_keeps_the_side_of_the_start():
    flow, true = views(1)
    opposite = torch.cat([-true[:3], true[3:]])
    assert errors(refine_motion(flow, [true], CAMERA), true)[0] < 1
    assert errors(refine_motion(flow, [opposite], CAMERA), true)[0] > 179


def test_the_better_of_two_starts_is_taken():
    flow, true = views(4)
    far = torch.cat([true[[1, 2, 0]], so3.exp(torch.tensor([0.5, -0.6, 0.4], dtype=torch.float64))])
    both = refine_motion(flow, [far, near(true, 4)], CAMERA)
    assert torch.equal(both[3:], refine_motion(flow, [near(true, 4), far], CAMERA)[3:])
    assert min(errors(both, true)[0], 180 - errors(both, true)[0]) < 1 and errors(both, true)[1] < 1


def test_flows_that_say_nothing_leave_the_start():
    start = torch.tensor([0.0, 0.6, 0.8, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    nothing = torch.full((2, 30, 40), torch.nan, dtype=torch.float64)
    torch.testing.assert_close(refine_motion(nothing, [start], CAMERA), start)
    still = refine_motion(torch.zeros(2, 30, 40), [start], CAMERA)
    assert torch.isfinite(still).all() and errors(still, start)[1] < 0.05
    resting = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert torch.isfinite(refine_motion(torch.zeros(2, 30, 40), [resting], CAMERA)).all()


@pytest.mark.parametrize("change", [{"iterations": 0}, {"scale": 0.0}, {"parallax": -1.0}, {"points": 1}])
def test_settings_out_of_range_are_named(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        RefinementOptions(**change)
