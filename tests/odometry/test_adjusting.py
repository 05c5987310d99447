"""Global adjustments of a tracker on a walk there and back: after a loop, from a map file, and on request."""

import threading
from dataclasses import replace

import numpy as np
import pytest

import dvo
from dvo.metrics import evaluate
from dvo.odometry.adjuster import Adjusting
from dvo.odometry.loop_work import Correcting, Searching
from tests.odometry import test_loop_closure as closing

film, OPTIONS = closing.film, closing.OPTIONS


@pytest.fixture(scope="module")
def saved(film, tmp_path_factory):
    """Map files during the first correction and after it, each with the number of frames by then."""
    odometry, found = dvo.load("small", device="cpu", **closing.SHORT), {}
    odometry.loops.finder.options = OPTIONS
    for count, frame in enumerate(film[0], 1):
        odometry.track(frame)
        state = "correcting" if isinstance(odometry.loops.work, Correcting) else ""
        state = "closed" if odometry.loops.corrections and odometry.loops.work is None else state
        if state and state not in found:
            found[state] = tmp_path_factory.mktemp("maps") / f"{state}.dvo", count
            odometry.save(found[state][0])
        if state == "closed":
            break
    return found


def continued(file):
    """Tracker of a map file that searches no further, and adjusts nine frames after a correction."""
    loaded = dvo.load_map(file)
    loaded.loops.finder.options = replace(OPTIONS, adjust_delay=9)
    loaded.loops.wait, loaded.loops.adjuster.after_loop = 1000, True
    return loaded


def test_a_world_is_adjusted_after_a_loop_and_goes_on_from_a_file(film, saved, tmp_path):
    file, count = saved["correcting"]
    loaded, begun, errors = continued(file), 0, []
    for number in range(count, count + 16):
        before, made = loaded.current().trajectory, list(loaded.loops.adjuster.records)
        loaded.track(film[0][number])
        if isinstance(loaded.loops.work, Adjusting) and not begun:
            begun = number
        elif begun and number == begun + 3:
            loaded.save(tmp_path / "adjusting.dvo")
        if loaded.loops.adjuster.records != made:
            assert number == begun + 9
            errors = [evaluate(rows, film[1]).ate_percent for rows in (before, loaded.current().trajectory)]
    assert errors[1] < errors[0]
    (record,) = loaded.loops.adjuster.records
    assert record.cause == "loop" and record.accepted and record.cost < record.cost_before and record.keyframes > 20
    assert (record.begun, record.applied) == (film[0][begun].timestamp, film[0][begun + 9].timestamp)
    again = continued(tmp_path / "adjusting.dvo")
    assert again.loops.work.left == 6
    for frame in film[0][begun + 4 : count + 16]:
        again.track(frame)
    assert np.array_equal(again.current().trajectory.poses_wc, loaded.current().trajectory.poses_wc)
    assert again.loops.information()["adjustments"] == loaded.loops.information()["adjustments"]
    assert [x.measurement.tolist() for x in again.loops.loops] == [x.measurement.tolist() for x in loaded.loops.loops]


def test_an_adjustment_on_request(film, saved):
    """It waits, and lowers cost and error; in real time it is done beside tracking, and no frame waits for it."""
    file, count = saved["closed"]
    loaded, release = continued(file), threading.Event()
    before = evaluate(loaded.current().trajectory, film[1]).ate_percent
    (record,) = loaded.adjust()
    assert record.accepted and record.cost < record.cost_before
    assert record.cause == "request" and record.begun == record.applied == film[0][count - 1].timestamp
    after = evaluate(loaded.current().trajectory, film[1]).ate_percent
    assert after < before
    assert loaded.track(film[0][count]).status is dvo.Status.TRACKING
    loaded.config, loaded.loops.real_time = replace(loaded.config, real_time=True), True
    loaded.loops.work = Searching(loaded.loops._background.start(lambda: release.wait(60) and None))
    assert loaded.adjust() == () and loaded.loops.adjuster.wanted == [0]
    loaded.track(film[0][count + 1])
    assert isinstance(loaded.loops.work, Searching)
    release.set()
    assert loaded.loops.work.task.result() is None
    loaded.track(film[0][count + 2])
    assert isinstance(loaded.loops.work, Adjusting) and not loaded.loops.adjuster.wanted
    assert loaded.loops.work.task.result() is not None
    loaded.track(film[0][count + 3])
    assert len(loaded.loops.adjuster.records) == 2 and loaded.loops.work is None
    assert [entry["cause"] for entry in loaded.current().info["adjustments"]] == ["request"] * 2


@pytest.mark.slow
def test_adjustments_after_loops_are_the_same_each_time(film):
    options = replace(OPTIONS, adjust_delay=6)
    one, two = (closing.track(film[0], options, adjust_after_loop=True)[2] for _ in range(2))
    assert len(one.info["adjustments"]) >= 2 and all(entry["accepted"] for entry in one.info["adjustments"])
    assert one.trajectory.poses_wc.tobytes() == two.trajectory.poses_wc.tobytes()
    assert evaluate(one.trajectory, film[1]).ate_percent < 0.5
