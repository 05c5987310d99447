"""Global adjustments of a tracker on a walk there and back: after a loop, and on request."""

import threading
from dataclasses import replace

import numpy as np
import pytest

import dvo
from dvo.metrics import evaluate
from dvo.odometry.global_ba.graph_adjustment import AdjustmentLimits
from dvo.odometry.maintenance.background import Background
from dvo.odometry.maintenance.maintenance import Job
from tests.support.loop_walk import OPTIONS, SHORT, there_and_back, until


@pytest.fixture(scope="module")
def film():
    return there_and_back(40)


def kind(loops):
    """Kind of the job in progress; None without one."""
    return None if loops.maintenance.job is None else loops.maintenance.job.kind


def adjusting(film, state):
    """Tracker in a state that searches no further, and adjusts nine frames after a correction; the frames by then."""
    odometry, count = until(film, state)
    odometry.loops.adjuster.limits = AdjustmentLimits(delay=9)
    odometry.loops.wait, odometry.loops.adjuster.after_loop = 1000, True
    return odometry, count


@pytest.mark.slow
def test_a_world_is_adjusted_after_a_loop(film, tmp_path):
    """Saving in the meantime changes nothing, and tells the adjustments that were made."""
    trajectories = []
    for saves in (True, False):
        odometry, count = adjusting(film, lambda loops: kind(loops) == "correction")
        begun, waited, applied, errors = 0, 0, 0, []
        for number in range(count, count + 16):
            before, made = odometry.current().trajectory, list(odometry.loops.adjuster.records)
            odometry.track(film[0][number])
            waited += bool(begun and odometry.aligner.age == 0)  # a frame that was aligned alone takes no part
            if kind(odometry.loops) == "adjustment" and not begun:
                begun = number
            elif begun and number == begun + 3 and saves:
                odometry.save(tmp_path / "adjusting.dvo")
            if odometry.loops.adjuster.records != made:
                assert waited == 9
                applied = number
                errors = [evaluate(rows, film[1]).ate_percent for rows in (before, odometry.current().trajectory)]
        assert errors[1] < errors[0]
        (record,) = odometry.loops.adjuster.records
        assert record.cause == "loop" and record.accepted and record.cost < record.cost_before
        assert record.keyframes > 20
        assert (record.begun, record.applied) == (film[0][begun].timestamp, film[0][applied].timestamp)
        trajectories.append(odometry.current().trajectory.poses_wc)
        odometry.save(tmp_path / "adjusted.dvo")
        told = dvo.load_map(tmp_path / "adjusted.dvo").finish().info["adjustments"]
        assert told == odometry.current().info["adjustments"] and len(told) == 1
    assert np.array_equal(*trajectories)
    assert dvo.load_map(tmp_path / "adjusting.dvo").finish().info["adjustments"] == []


@pytest.mark.slow
def test_an_adjustment_on_request(film):
    """It waits, and lowers cost and error; in real time it is done beside tracking, and no frame waits for it."""
    loaded, count = adjusting(film, lambda loops: loops.corrections > 0 and loops.maintenance.job is None)
    release = threading.Event()
    before = evaluate(loaded.current().trajectory, film[1]).ate_percent
    (record,) = loaded.adjust()
    assert record.accepted and record.cost < record.cost_before
    assert record.cause == "request" and record.begun == record.applied == film[0][count - 1].timestamp
    after = evaluate(loaded.current().trajectory, film[1]).ate_percent
    assert after < before
    assert loaded.track(film[0][count]).status is dvo.Status.TRACKING
    loaded.config, loaded.loops.maintenance.real_time = replace(loaded.config, real_time=True), True
    loaded.loops.maintenance.job = Job("search", Background().start(lambda: release.wait(60) and None), lambda _: {})
    assert loaded.adjust() == () and loaded.loops.adjuster.wanted == [0]
    loaded.track(film[0][count + 1])
    assert kind(loaded.loops) == "search"
    release.set()
    assert loaded.loops.maintenance.job.task.result() is None
    loaded.track(film[0][count + 2])
    assert kind(loaded.loops) == "adjustment" and not loaded.loops.adjuster.wanted
    assert loaded.loops.maintenance.job.task.result() is not None
    loaded.track(film[0][count + 3])
    assert len(loaded.loops.adjuster.records) == 2 and loaded.loops.maintenance.job is None
    assert [entry["cause"] for entry in loaded.current().info["adjustments"]] == ["request"] * 2


@pytest.mark.slow
def test_adjustments_after_loops_are_the_same_each_time(film):
    def tracked():
        odometry = dvo.load("small", device="cpu", loop=OPTIONS, **SHORT, adjust_after_loop=True)
        odometry.loops.adjuster.limits = AdjustmentLimits(delay=6)
        for frame in film[0]:
            odometry.track(frame)
        return odometry.finish()

    one, two = tracked(), tracked()
    assert len(one.info["adjustments"]) >= 2 and all(entry["accepted"] for entry in one.info["adjustments"])
    assert one.trajectory.poses_wc.tobytes() == two.trajectory.poses_wc.tobytes()
    assert evaluate(one.trajectory, film[1]).ate_percent < 0.5
