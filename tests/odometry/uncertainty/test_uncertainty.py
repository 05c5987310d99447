"""Covariance and confidence of the newest pose: the plain dense marginal, its gauge, and what they leave alone."""

import gc
import math
import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dvo
from dvo.ba.blocks import POSES
from dvo.ba.covariance import size_gradient
from dvo.ba.layer.layer import BAOptions, make_problem
from dvo.ba.layer.reference import dense_rows
from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3
from dvo.map.measurements import SIGMA, depth_factors
from dvo.odometry.patch import tracker as tracker_module
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.protocol import Estimate, Status
from dvo.odometry.uncertainty import uncertainty
from dvo.odometry.uncertainty.displacement import confidence_of, flow_metric
from dvo.odometry.uncertainty.gauge import window_gauge
from dvo.odometry.uncertainty.uncertainty import UNKNOWN, LaterUncertainty, WindowMeasurements, newest_uncertainty
from dvo.synth.sequence import make_sequence

FAST = {"pixels": 160 * 120, "patches": 12, "lifetime": 5, "removal": 6, "initial_updates": 6, "restart": False}


def walk():
    size = {"height": 120, "width": 160, "fps": 15.0, "sensor": False}
    return list(make_sequence(61, frames=22, family="room", kind="handheld", speed=3.0, **size))


@pytest.fixture(scope="module")
def tracked():
    """A tracker after a walk and a black image, its step before that image, and its estimates."""
    odometry = dvo.load("small", **FAST)
    frames = walk()
    estimates = [odometry.track(frame) for frame in frames]
    step = copied(odometry.patch_window)
    black = replace(frames[-1], timestamp=frames[-1].timestamp + 0.1, image=np.zeros_like(frames[-1].image))
    return odometry, step, [*estimates, odometry.track(black)]


def copied(step, poses_cw=None, patches=None):
    """A step with a copy of its window, with other poses and patches."""
    w = step.window
    window = replace(w, frames=list(w.frames), poses_cw=w.poses_cw if poses_cw is None else poses_cw,
                     patches=w.patches if patches is None else patches)  # fmt: skip
    return SimpleNamespace(window=window, bounds=step.bounds, settings=step.settings)


def test_every_pose_has_a_covariance_and_nothing_else_has(tracked):
    odometry, _, estimates = tracked
    assert [e.covariance is None for e in estimates] == [e.status is not Status.TRACKING for e in estimates]
    assert estimates[0].status is Status.INITIALISING and estimates[-1].status is Status.LOST
    for e in estimates:
        if e.covariance is None:
            assert (e.confidence, e.reference, e.position_sigma, e.rotation_sigma) == (0.0, None, None, None)
            continue
        assert e.covariance.shape == (6, 6) and e.covariance.dtype == np.float64
        assert np.array_equal(e.covariance, e.covariance.T) and np.linalg.eigvalsh(e.covariance).min() > 0
        assert 0 < e.confidence <= 1 and e.reference < e.timestamp
        assert e.position_sigma == pytest.approx(math.sqrt(e.covariance[[0, 1, 2], [0, 1, 2]].sum()))
        assert e.rotation_sigma == pytest.approx(math.degrees(math.sqrt(e.covariance[[3, 4, 5], [3, 4, 5]].sum())))
        again = pickle.loads(pickle.dumps(e))
        assert np.array_equal(again.covariance, e.covariance) and again.reference == e.reference
    assert estimates[-2].reference in [frame.timestamp for frame in odometry.window.frames]


def information(step, factors=()):
    """Dense information matrix of the poses after the reference and all depths, float64, and the rows of the poses."""
    window, gauge = step.window, window_gauge(step.window.problem())
    options = BAOptions(fixed=gauge.reference + 1, bounds=step.bounds, kernel=step.settings.kernel)
    tensors = window.poses_cw, window.patches, window.intrinsics, window.targets, window.confidence
    edges = window.ii, window.jj, window.kk
    given = PatchProblem(*(x[None].double() for x in tensors), *edges, factors=factors)
    problem = make_problem(given, options, grouped=False)
    state, (_, w, jac_p, jac_l) = problem.state, dense_rows(problem)
    jacobian = torch.cat((jac_p, jac_l), -1)[0]
    hessian = jacobian.T @ (w[0, :, None] * jacobian)
    hessian += torch.diag(torch.cat((torch.full((state.size,), 1e-6), torch.full((jac_l.shape[-1],), 1e-4))))
    return hessian, state.rows(POSES, torch.arange(len(window)))


def test_it_is_the_marginal_of_the_whole_information_matrix(tracked):
    """The dense inverse, bordered with the gauge, in place of the eliminated depths."""
    _, step, estimates = tracked
    window, gauge = step.window, window_gauge(step.window.problem())
    constraint = size_gradient(window.poses_cw[None].double(), gauge.reference, gauge.members)
    hessian, rows = information(step)
    column = torch.zeros(len(hessian), 1, dtype=torch.float64)
    for member in gauge.members:
        column[rows[member], 0] = constraint[0, member]
    border = torch.cat((column.T, torch.zeros(1, 1)), 1)
    inverse = torch.linalg.inv(torch.cat((torch.cat((hessian, column), 1), border)))
    config = TrackerConfig()
    plain = config.sigma**2 * config.covariance_scale * inverse[rows[-1]][:, rows[-1]].numpy()
    scale = np.sqrt(np.outer(plain.diagonal(), plain.diagonal()))
    np.testing.assert_allclose(estimates[-2].covariance / scale, plain / scale, atol=2e-3)


def with_depths(step, share, error, scale=1.0):
    """The step with measured depths of a share of the patches, of a relative standard deviation, times a scale."""
    window, g = copied(step).window, torch.Generator().manual_seed(0)
    m = window.per_frame
    depth = window.patches[:, 2, 0, 0].unflatten(0, (-1, m))
    value = depth / scale * (1 + error * torch.randn(depth.shape, generator=g))
    weight = torch.where(torch.rand(depth.shape, generator=g) < share, (SIGMA / (error * value)) ** 2, 0.0)
    measured = torch.stack((value * (weight > 0), weight), -1)
    window.frames = [replace(frame, measured=x) for frame, x in zip(window.frames, measured, strict=True)]
    return SimpleNamespace(window=window, bounds=step.bounds, settings=step.settings)


@pytest.mark.parametrize(("share", "error"), [(0.8, 0.05), (0.1, 0.3)])
def test_measured_depths_are_in_it(tracked, share, error):
    """Information of the priors, their robust kernel included, in the inverse of the dense matrix; no scale is held."""
    step = with_depths(tracked[1], share, error, scale=1.1)
    hessian, rows = information(step, depth_factors(step.window.measured.double()))
    config = TrackerConfig()
    inverse = torch.linalg.inv(hessian)[rows[-1]][:, rows[-1]].numpy()
    plain = config.sigma**2 * config.covariance_scale * inverse
    found = newest_uncertainty(step, config.variance)
    scale = np.sqrt(np.outer(plain.diagonal(), plain.diagonal()))
    np.testing.assert_allclose(found.covariance / scale, plain / scale, atol=1e-6)
    without = newest_uncertainty(tracked[1], config.variance)
    tight = newest_uncertainty(with_depths(tracked[1], 1.0, 1e-4), config.variance)
    sizes = [np.trace(x.covariance[:3, :3]) for x in (tight, found)]
    assert sizes[0] < sizes[1], "better depths, a surer scale"
    assert np.trace(tight.covariance[3:, 3:]) < np.trace(without.covariance[3:, 3:])
    assert tight.reference == without.reference and 0 < found.confidence <= tight.confidence


def test_depths_that_are_not_measured_change_no_byte(tracked):
    found = newest_uncertainty(with_depths(tracked[1], 0.0, 0.05), TrackerConfig().variance)
    plain = newest_uncertainty(tracked[1], TrackerConfig().variance)
    assert found.covariance.tobytes() == plain.covariance.tobytes() and found.confidence == plain.confidence


@pytest.mark.long
def test_it_is_computed_when_it_is_read_with_the_same_bytes(tracked, monkeypatch):
    """After tracking went on, and whether or not others were read; nothing is computed for what nobody reads."""
    known = [e for e in tracked[2] if e.covariance is not None]  # read, whether or not another test did
    calls, marginal = [], uncertainty._marginal
    monkeypatch.setattr(uncertainty, "_marginal", lambda *given: calls.append(1) or marginal(*given))
    odometry = dvo.load("small", **FAST)
    estimates = [odometry.track(frame) for frame in walk()]
    odometry.finish()
    assert not calls
    late = [e for e in estimates if e.pose_wc is not None]
    assert len(known) == len(late)
    for before, after in reversed(list(zip(known, late, strict=True))):
        again = pickle.loads(pickle.dumps(after))
        for found in (after, again, replace(after, recovered=True)):
            assert found.covariance.tobytes() == before.covariance.tobytes()
            assert (found.confidence, found.reference) == (before.confidence, before.reference)
    assert len(calls) == len(late), "once each"


def test_what_has_been_read_holds_no_window(tracked):
    def held():
        gc.collect()
        return sum(type(one) is WindowMeasurements for one in gc.get_objects())

    before, later = held(), LaterUncertainty(WindowMeasurements.of(tracked[1]), TrackerConfig().variance)
    assert held() == before + 1
    assert later.confidence() == newest_uncertainty(tracked[1], TrackerConfig().variance).confidence
    assert held() == before


def test_scale_and_world_do_not_matter(tracked):
    """The tangent is in the camera, so another world changes nothing; another scale, the unit of the positions."""
    _, step, _ = tracked
    poses, patches = step.window.poses_cw, step.window.patches
    plain = newest_uncertainty(step, TrackerConfig().variance)
    scaled = torch.cat((4 * poses[:, :3], poses[:, 3:]), -1), torch.cat((patches[:, :2], patches[:, 2:] / 4), 1)
    units = np.diag([4.0, 4, 4, 1, 1, 1])
    found = newest_uncertainty(copied(step, *scaled), TrackerConfig().variance)
    tolerance = 1e-2 * math.sqrt(np.abs(plain.covariance).max())
    np.testing.assert_allclose(found.covariance, units @ plain.covariance @ units, rtol=2e-2, atol=tolerance**2)
    assert found.confidence == pytest.approx(plain.confidence, abs=1e-2)
    world = se3.exp(torch.tensor([3.0, -2, 1, 0.5, 1.0, -0.7])).expand_as(poses)
    found = newest_uncertainty(copied(step, se3.compose(poses, world)), TrackerConfig().variance)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=2e-2, atol=tolerance**2)
    wide = newest_uncertainty(step, TrackerConfig(sigma=0.122, covariance_scale=8.0).variance)
    factor = 4 * 8 / TrackerConfig().covariance_scale
    np.testing.assert_allclose(wide.covariance, factor * plain.covariance, rtol=1e-4)
    assert wide.confidence < plain.confidence


def test_the_gauge_leaves_out_frames_without_measurements(tracked):
    _, step, _ = tracked
    window = copied(step).window
    n = len(window)
    window.keep((window.ii > 1) & (window.jj > 1))
    gauge = window_gauge(window.problem())
    assert gauge.reference == 2 and gauge.members == tuple(range(3, n - 1))
    gradient = size_gradient(window.poses_cw[None], 2, range(3, n - 1))[0]
    assert (gradient[[0, 1, 2, n - 1]] == 0).all() and (gradient[3 : n - 1, :3] != 0).any(-1).all()
    window.keep(window.touching(n - 2) & window.touching(n - 1))
    step = SimpleNamespace(window=window, bounds=step.bounds, settings=step.settings)
    assert window_gauge(window.problem()) is None and newest_uncertainty(step, TrackerConfig().variance) is UNKNOWN


@pytest.mark.long
def test_no_pose_depends_on_it(tracked, monkeypatch):
    monkeypatch.setattr(tracker_module, "LaterUncertainty", lambda step, config, ambiguous: UNKNOWN)
    odometry = dvo.load("small", **FAST)
    for frame, estimate in zip(walk(), tracked[2], strict=False):
        found = odometry.track(frame)
        assert found.status is estimate.status and found.covariance is None
        assert found.pose_wc is None or found.pose_wc.tobytes() == estimate.pose_wc.tobytes()


def test_the_metric_is_the_displacement_in_the_image():
    intrinsics, size, depth = np.array([60.0, 62, 41, 29]), (80, 60), 2.5
    xi = 1e-4 * np.array([1.0, -2, 3, -1, 2, 1.5])
    u, v = np.meshgrid((np.arange(4) + 0.5) * 20, (np.arange(3) + 0.5) * 20)
    rays = np.stack([(u - 41) / 60, (v - 29) / 62, np.ones_like(u)], -1).reshape(-1, 3)
    moved = se3.act(se3.exp(torch.from_numpy(xi)), torch.from_numpy(depth * rays)).numpy()
    shift = 4 * intrinsics[:2] * (moved[:, :2] / moved[:, 2:] - rays[:, :2])  # 80x60 to 320x240
    expected = (shift**2).sum(1).mean()
    assert xi @ flow_metric(intrinsics, size, 1 / depth) @ xi == pytest.approx(expected, rel=1e-3)
    half = flow_metric(intrinsics / 2, (40, 30), 1 / depth)
    np.testing.assert_allclose(half, flow_metric(intrinsics, size, 1 / depth))


def test_the_confidence_is_a_probability():
    one = np.diag([1.0, 0, 0, 0, 0, 0])  # one degree of freedom: the normal distribution
    for sigma in (0.1, 0.5, 2.0):
        assert confidence_of(sigma**2 * np.eye(6), one) == pytest.approx(math.erf(0.5 / sigma / math.sqrt(2)))
    pair = np.diag([1.0, 1, 0, 0, 0, 0])  # two: Rayleigh's
    assert confidence_of(0.09 * np.eye(6), pair) == pytest.approx(1 - math.exp(-(0.25 / 0.09) / 2))
    draws = np.random.default_rng(0).normal(size=(100_000, 2)) * (0.4, 0.2)
    mixed = confidence_of(np.diag([0.16, 0.04, 1, 1, 1, 1]), pair)
    assert mixed == pytest.approx(((draws**2).sum(1) < 0.25).mean(), abs=0.02)
    assert confidence_of(np.diag([np.inf] * 6), one) == confidence_of(np.zeros((6, 6)), one) == 0.0


def test_an_odometry_without_one_leaves_it_out():
    estimate = Estimate(0.0, np.array([0.0, 0, 0, 0, 0, 0, 1]), Status.TRACKING)
    assert estimate.covariance is None and estimate.reference is None and estimate.rotation_sigma is None


@pytest.mark.slow
def test_a_window_may_have_a_second_solution_until_the_tracker_has_tried(monkeypatch):
    solved, solve = [], uncertainty.window_solutions
    monkeypatch.setattr(uncertainty, "window_solutions", lambda window: solved.append(1) or solve(window))
    frames, last = walk(), []
    for seed in (2, 4):  # with so few patches it is a matter of chance if one comparison is enough
        odometry, known = dvo.load("small", seed=seed, **FAST | {"restart": True}), []
        for frame in frames:
            estimate = odometry.track(frame)
            before = len(solved)
            if estimate.covariance is not None:
                known.append((odometry.state.ambiguous, len(solved) > before))
        assert known[:4] == [(True, True)] * 4 and all(ambiguous == tried for ambiguous, tried in known)
        last.append(known[-1])
    assert (False, False) in last
