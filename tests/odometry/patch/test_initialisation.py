"""Revision of the first solution some frames after the initialisation."""

from types import SimpleNamespace

import pytest
import torch

from dvo.ba.kernels import Kernel
from dvo.ba.multistart import multistart, reversed_relief
from dvo.ba.options import COLD_UPDATES
from dvo.geometry import se3
from dvo.odometry.depth.depth_factor import MEASURED_SHARE, measured_share
from dvo.odometry.frames.content import NO_MATCH
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.patch import initialisation
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.initialisation import (
    CALM,
    initialise,
    initialise_related,
    leave_minimum,
    lose_unsupported,
    unsupported,
)
from dvo.odometry.patch.state import RESTART_AGES, TrackerState
from dvo.odometry.window.patch_window import StepSettings
from tests.support.archived_walk import archived_walk, pose_at

CONFIG = TrackerConfig(sigma=0.2, covariance_scale=1.0)  # of measurements whose weights are not those of a network


def _step(window):
    window.confidence = window.weights
    return SimpleNamespace(window=window, bounds=(60, 60), settings=StepSettings(Kernel("cauchy", 0.3)))


def _reversed_window(unit=0.0):
    """Window of six frames with the second solution of its measurements, and the true poses."""
    graph, _ = archived_walk(frames=6, interval=0.03, archived=False, unit=unit)
    window = graph.window
    true = pose_at(0.03 * torch.arange(6, dtype=torch.float64))
    window.poses_cw = true.float()
    (wrong,) = multistart(window.problem(), {"reversed": reversed_relief})
    window.poses_cw, window.patches = wrong.problem.poses_cw.float(), wrong.problem.patches.float()
    return window, true.float()


def _error(poses, true):
    return float(se3.log(se3.relative(poses, true))[:, 3:].norm(dim=1).max())


def test_a_window_with_reversed_relief_is_started_anew():
    window, true = _reversed_window()
    assert _error(window.poses_cw, true) > 0.01
    assert not leave_minimum(_step(window), CONFIG), "the measurements tell the two apart"
    assert _error(window.poses_cw, true) < 0.001 and window.poses_cw.dtype == window.patches.dtype == torch.float32
    before = window.poses_cw.clone(), window.patches.clone()
    assert not leave_minimum(_step(window), CONFIG)  # the right solution stays as it is
    assert torch.equal(window.poses_cw, before[0]) and torch.equal(window.patches, before[1])


def test_a_window_that_the_measurements_do_not_decide_is_ambiguous():
    """Errors of the size of the little parallax: the reversed relief fits about as well."""
    window, _ = _reversed_window()
    generator = torch.Generator().manual_seed(0)
    window.targets = window.targets + 0.5 * torch.randn(window.targets.shape, generator=generator)
    assert leave_minimum(_step(window), CONFIG)


def test_frames_at_which_a_second_solution_is_looked_for():
    def due(age: int, ambiguous: bool) -> bool:
        return TrackerState(torch.Generator(), tracked=age, ambiguous=ambiguous).restart_due

    assert {age for age in range(1, 200) if due(age, False)} == RESTART_AGES
    assert {age for age in range(33, 200) if due(age, True)} == set(range(40, 200, 8))


def test_nothing_is_tried_where_depths_are_measured():
    window, true = _reversed_window(unit=1.0)
    poses = window.poses_cw
    assert measured_share(window.measured) >= MEASURED_SHARE and _error(poses, true) > 0.01
    assert not leave_minimum(_step(window), CONFIG) and window.poses_cw is poses


def test_settings_turn_kernel_and_restart_off():
    config = TrackerConfig(robust=0, restart=False)
    assert config.kernel == Kernel("none") and config.adjustment.restart_frames == 0
    assert TrackerConfig(robust=0.2).kernel == Kernel("cauchy", 0.2)
    assert TrackerConfig().adjustment == AdjustmentOptions()


@pytest.mark.parametrize("unit", [0.0, 1.0])
@pytest.mark.parametrize("moving", [0, 6, 100])
def test_a_first_window_is_updated_until_it_has_settled(moving, unit):
    """A walk whose exact solution is shaken by the first updates; another start is judged by the flow of now."""
    graph, _ = archived_walk(frames=6, wrong=0.1, archived=False, unit=unit)
    window, updates, asked = graph.window, [], []
    right = pose_at(0.1 * torch.arange(6, dtype=torch.float64)).float()
    window.confidence = window.weights

    def step(fixed, damping):
        updates.append(damping)
        shake = torch.zeros(6, 6)
        shake[1:, 4] = 0.01 * (len(updates) % 2) * (len(updates) <= moving)
        window.poses_cw = se3.compose(se3.exp(shake), right)

    def revise():
        asked.append(len(updates))
        return SimpleNamespace(targets=window.targets[None], weights=window.weights[None])

    config = TrackerConfig()
    initialise(SimpleNamespace(window=window, step=step, revise=revise), config, 6)
    assert len(asked) == (not unit)
    settled = max(COLD_UPDATES, moving) + CALM
    assert len(updates) == min(settled, config.initial_updates)


def _turning_window(frames=7, found=4):
    """Graph whose window moves evenly; frames from one on have a pose that their measurements do not support."""
    graph, _ = archived_walk(frames=frames, interval=0.03, archived=False)
    window = graph.window
    true, later = pose_at(0.03 * torch.arange(frames, dtype=torch.float64)).float(), torch.arange(frames) >= found
    window.confidence = torch.where(later[window.ii] | later[window.jj], 0.0, 1.0)[:, None].expand_as(window.weights)
    window.poses_cw = torch.where(later[:, None], true[:1], true)
    return graph, true


def test_nothing_speaks_against_a_frame_whose_edges_have_left_the_window():
    window = _turning_window()[0].window
    assert unsupported(window, CONFIG) == [4, 5, 6]
    window.keep((window.jj != 5) | (window.ii >= 5))
    assert unsupported(window, CONFIG) == [4, 6]


def test_frames_that_a_first_solution_hardly_finds_begin_where_the_motion_leads_them(monkeypatch):
    (graph, true), starts = _turning_window(), []
    measured = graph.window.targets, graph.window.patches

    def solve(patch_window, *_):
        starts.append(_error(patch_window.window.poses_cw, true))
        if len(starts) > 1:
            window = patch_window.window
            window.confidence, window.poses_cw = torch.ones_like(window.confidence), true
            window.targets, window.patches = measured
        return True

    monkeypatch.setattr(initialisation, "initialise", solve)
    monkeypatch.setattr(initialisation, "drop_unrelated", lambda *_: False)
    assert unsupported(graph.window, CONFIG) == [4, 5, 6]
    assert initialise_related(graph, _step(graph.window), CONFIG, 0) and not unsupported(graph.window, CONFIG)
    assert len(starts) == 2 and starts[1] < 0.2 * starts[0]


def test_a_second_start_that_finds_no_more_frames_leaves_the_first_solution(monkeypatch):
    graph, _ = _turning_window()
    monkeypatch.setattr(initialisation, "initialise", lambda *_: True)
    monkeypatch.setattr(initialisation, "drop_unrelated", lambda *_: False)
    step, before = SimpleNamespace(window=graph.window), graph.window.snapshot()
    assert initialise_related(graph, step, CONFIG, 0)
    after = graph.window.snapshot()
    assert all(torch.equal(getattr(before, name), getattr(after, name)) for name in ("poses_cw", "patches", "hidden"))


def test_frames_of_the_first_window_that_nothing_supports_are_lost():
    graph, _ = _turning_window(found=7)
    window = graph.window
    into = (window.jj == 3) | (window.ii == 3)
    window.confidence = torch.where(into[:, None], 0.0, window.confidence)
    identifiers = [frame.identifier for frame in window.frames]
    lose_unsupported(graph, CONFIG)
    assert [frame.identifier for frame in window.frames] == [*identifiers[:3], *identifiers[4:]]
    lost = [record for record in graph.log.frames if record.lost]
    assert [record.reason for record in lost] == [NO_MATCH] and len(graph.log.frames) == 7
