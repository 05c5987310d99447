"""Second solutions of a window, their probabilities, and what they add to the uncertainty of a pose."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dvo.ba.kernels import Kernel
from dvo.ba.multistart import PRESENT, Solution, multistart, reversed_relief
from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.uncertainty import uncertainty
from dvo.odometry.uncertainty.displacement import TOLERANCE
from dvo.odometry.uncertainty.gauge import Gauge, relative_error, window_gauge
from dvo.odometry.uncertainty.second_solution import INDEPENDENT, second_solutions, window_solutions
from dvo.odometry.uncertainty.uncertainty import LaterUncertainty, WindowMeasurements, newest_uncertainty, window_metric
from dvo.odometry.window.patch_window import StepSettings
from tests.support.archived_walk import archived_walk, pose_at

SIZE = 60, 60
GAUGE = Gauge(0, (1, 2))
COVARIANCE = 1e-5 * np.eye(6)
METRIC = np.diag([100.0**2] * 6)  # a displacement of 0.5 pixels is an error of 0.005


def line(*last):
    """Poses of a solution: four frames a metre apart, the last one moved by a tangent."""
    poses = se3.identity(4, dtype=torch.float64)
    poses[:, 0] = -torch.arange(4.0)
    moved = se3.compose(se3.exp(torch.tensor([*last, 0, 0, 0], dtype=torch.float64)), poses[3])
    return torch.cat([poses[:3], moved[None]])


def solution(cost, *last, start="reversed"):
    none, edges = torch.zeros(0, 2), torch.zeros(0, dtype=torch.long)
    problem = PatchProblem(line(*last), torch.zeros(0, 3, 1, 1), torch.ones(4, 4), none, none, edges, edges, edges)
    return Solution(start, problem, cost)


def test_probabilities_follow_the_costs():
    now = solution(1.0, 0, 0, 0, start=PRESENT)
    for cost in (0.5, 1.0, 1.3, 1.7):
        (other,) = second_solutions([now, solution(cost, 0.1, 0, 0)], GAUGE, COVARIANCE, METRIC)
        likelihood = cost ** (-INDEPENDENT / 2)
        assert other.probability == pytest.approx(likelihood / (1 + likelihood))
        truth = se3.exp(torch.from_numpy(other.error))  # T_wc_other = T_wc Exp(xi)
        there = se3.compose(se3.inverse(now.problem.poses_cw[3]), truth)
        np.testing.assert_allclose(there, se3.inverse(line(0.1, 0, 0)[3]), atol=1e-12)
    assert second_solutions([now], GAUGE, COVARIANCE, METRIC) == []
    assert second_solutions([now, solution(2.0, 0.1, 0, 0)], GAUGE, COVARIANCE, METRIC) == []
    (sure,) = second_solutions([now, solution(0.0, 0.1, 0, 0)], GAUGE, COVARIANCE, METRIC)
    (unsure,) = second_solutions([solution(0.0, 0, 0, 0), solution(0.0, 0.1, 0, 0)], GAUGE, COVARIANCE, METRIC)
    assert sure.probability == pytest.approx(1) and unsure.probability == 0.5
    huge = solution(1e30, 0, 0, 0, start=PRESENT)  # the ratio of the costs is not a number that can be stored
    assert second_solutions([huge, solution(0.0, 0.1, 0, 0)], GAUGE, COVARIANCE, METRIC)[0].probability == 1


def test_solutions_that_agree_are_one():
    near, far = 0.8 * TOLERANCE / 100, 4 * TOLERANCE / 100
    now = solution(1.0, 0, 0, 0, start=PRESENT)
    assert second_solutions([now, solution(1.0, near, 0, 0)], GAUGE, COVARIANCE, METRIC) == []
    close = [now, solution(1.2, far + near, 0, 0), solution(1.1, far, 0, 0)]
    found = second_solutions(close, GAUGE, COVARIANCE, METRIC)
    assert len(found) == 1 and found[0].probability == pytest.approx(1 / (1 + 1.1 ** (INDEPENDENT / 2)))
    two = second_solutions([now, solution(1.2, 0, far, 0), solution(1.1, far, 0, 0)], GAUGE, COVARIANCE, METRIC)
    assert len(two) == 2 and two[0].probability > two[1].probability
    loose = np.diag([far**2 / 20, *[1e-5] * 5])  # of standard deviations of a quarter of the distance
    assert second_solutions([now, solution(1.0, far, 0, 0)], GAUGE, loose, METRIC) == []
    assert len(second_solutions([now, solution(1.0, far, 0, 0)], GAUGE, loose / 2, METRIC)) == 1
    broken = solution(0.1, 0, 0, math.nan)
    assert second_solutions([now, broken], GAUGE, COVARIANCE, METRIC) == []
    assert second_solutions([now, solution(math.nan, far, 0, 0)], GAUGE, COVARIANCE, METRIC) == []
    flat = np.diag([1e-5, 1e-5, 0, 0, 0, 0])  # as good as no covariance; never an error
    assert len(second_solutions([now, solution(1.0, far, 0, 0)], GAUGE, flat, METRIC)) == 1


NOISE = 0.2  # of the measurements, pixels


def ambiguous_step(seed=0):
    """Window of a short walk at its reversed relief, as the step of a tracker, and the true poses."""
    graph, _ = archived_walk(frames=6, interval=0.02, archived=False)
    window, generator = graph.window, torch.Generator().manual_seed(seed)
    window.targets = window.targets + NOISE * torch.randn(window.targets.shape, generator=generator)
    window.confidence = window.weights
    truth = pose_at(0.02 * torch.arange(6, dtype=torch.float64))
    (wrong,) = multistart(window.problem().with_values(poses_cw=truth.float()), {"reversed": reversed_relief})
    window.poses_cw, window.patches = wrong.problem.poses_cw.float(), wrong.problem.patches.float()
    return SimpleNamespace(window=window, bounds=SIZE, settings=StepSettings(Kernel("cauchy", 0.3))), truth


def test_a_window_is_solved_as_its_problem_is():
    """The solution from the reversed relief is that of the whole patches."""
    step, _ = ambiguous_step()
    w = step.window
    found = {solution.start: solution for solution in window_solutions(WindowMeasurements.of(step).problem)}
    (whole,) = multistart(w.problem(), {"reversed": reversed_relief})
    assert found["reversed"].cost == pytest.approx(whole.cost, rel=1e-2)
    torch.testing.assert_close(found["reversed"].problem.poses_cw, whole.problem.poses_cw, atol=2e-3, rtol=0)


def test_covariance_and_confidence_are_those_of_the_mixture():
    step, _ = ambiguous_step()
    window, gauge = WindowMeasurements.of(step), window_gauge(step.window.problem())
    plain = newest_uncertainty(step, TrackerConfig().variance)
    mixed = newest_uncertainty(step, TrackerConfig().variance, ambiguous=True)
    others = second_solutions(window_solutions(window.problem), gauge, plain.covariance, window_metric(window))
    assert others and mixed.reference == plain.reference
    share = 1 - sum(other.probability for other in others)
    expected = share * plain.covariance
    for other in others:
        there = SimpleNamespace(**(vars(step) | {"window": replace(
            step.window, poses_cw=other.solution.problem.poses_cw.float(),
            patches=other.solution.problem.patches.float().expand_as(step.window.patches))}))  # fmt: skip
        own = newest_uncertainty(there, TrackerConfig().variance).covariance
        expected = expected + other.probability * (own + np.outer(other.error, other.error))
    np.testing.assert_allclose(mixed.covariance, expected, rtol=1e-6)
    assert mixed.confidence == pytest.approx(share * plain.confidence)
    later = LaterUncertainty(WindowMeasurements.of(step), TrackerConfig().variance, ambiguous=True)
    assert np.array_equal(later.covariance(), mixed.covariance) and later.confidence() == mixed.confidence


@pytest.mark.parametrize("seed", range(3))
def test_the_true_pose_is_within_the_covariance_of_a_wrong_solution(seed):
    step, truth = ambiguous_step(seed)
    error = relative_error(step.window.poses_cw, truth, window_gauge(step.window.problem()))
    config = TrackerConfig(sigma=NOISE, covariance_scale=1.0)
    plain, mixed = (newest_uncertainty(step, config.variance, ambiguous) for ambiguous in (False, True))
    before, after = (float(error @ np.linalg.solve(x.covariance, error)) / 6 for x in (plain, mixed))
    assert before > 20 and after < 2
    assert mixed.confidence < plain.confidence


def test_nothing_is_solved_where_there_is_one_solution(monkeypatch):
    monkeypatch.setattr(uncertainty, "window_solutions", lambda window: pytest.fail("solved"))
    assert newest_uncertainty(ambiguous_step()[0], TrackerConfig().variance).covariance is not None
