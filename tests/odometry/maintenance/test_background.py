"""Work beside tracking."""

import os
import sys
import threading

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.odometry.maintenance.background import Background, Steps, StepsAhead, all_steps
from dvo.odometry.maintenance.maintenance import MapMaintenance
from tests.support.forked import in_fork


def counted(number, taken):
    """Work of some steps before the result."""
    for k in range(number):
        taken.append(k)
        yield
    taken.append(torch.is_inference_mode_enabled())
    return "done"


@given(number=st.integers(0, 6), early=st.integers(0, 8))
def test_steps_are_taken_one_by_one_or_all_for_the_result(number, early):
    taken = []
    steps = Steps(counted(number, taken))
    for call in range(number + 1):
        if call == early:
            assert steps.result() == "done" and len(taken) == number + 1 and steps.step()
        elif call < early:
            assert len(taken) == call
            assert steps.step() == (call == number)
    assert steps.result() == "done"
    assert taken == [*range(number), True] and all_steps(counted(number, [])) == "done"


@settings(deadline=None)
@given(number=st.integers(0, 6), early=st.integers(0, 8))
def test_steps_ahead_end_with_the_frame_that_would_have_taken_the_last(number, early):
    taken, background = [], Background()
    steps, plain = StepsAhead(counted(number, taken), background), Steps(counted(number, []))
    for call in range(number + 1):
        if call == early:
            assert steps.result() == "done" and len(taken) == number + 1
        assert steps.step() == plain.step() and len(taken) > call
    assert steps.done and steps.step() and steps.result() == "done" and taken == [*range(number), True]


def test_a_thread_takes_steps_ahead_of_the_frames_and_is_waited_for():
    second, release = threading.Event(), threading.Event()

    def work():
        yield
        second.set()
        yield
        release.wait(60)
        return threading.get_ident()

    steps = StepsAhead(work(), Background())
    assert second.wait(60) and not steps.done
    assert not steps.step() and not steps.step()
    threading.Timer(0.05, release.set).start()
    assert steps.step() and steps.result() != threading.get_ident()


@pytest.mark.parametrize("build", [Steps, lambda work: StepsAhead(work, Background())], ids=["steps", "ahead"])
def test_an_error_of_a_step_is_raised_by_it(build):
    def fails():
        yield
        raise ValueError("no")

    steps = build(fails())
    assert not steps.step()
    with pytest.raises(ValueError, match="no"):
        steps.step()


def test_work_is_done_in_order_in_another_thread_without_gradients():
    background, order = Background(), []

    def work(number):
        order.append(number)
        return number, threading.get_ident(), torch.is_inference_mode_enabled()

    tasks = [background.start(lambda k=k: work(k)) for k in range(5)]
    results = [task.result() for task in tasks]
    assert order == [0, 1, 2, 3, 4] == [result[0] for result in results] and all(task.done for task in tasks)
    assert len({result[1] for result in results}) == 1 and results[0][1] != threading.get_ident()
    assert all(result[2] for result in results) and not torch.is_inference_mode_enabled()


def test_a_task_is_not_done_before_its_work():
    release = threading.Event()
    task = Background().start(lambda: release.wait(60))
    assert not task.done
    release.set()
    assert task.result() is True and task.done


def test_work_that_has_not_begun_is_taken_back():
    begun, release, background = threading.Event(), threading.Event(), Background()
    first = background.start(lambda: begun.set() or release.wait(60))
    second = background.start(lambda: pytest.fail("it was taken back"))
    assert begun.wait(60) and second.withdraw() and not first.withdraw()
    release.set()
    assert first.result() is True and not first.withdraw() and background.start(lambda: 3).result() == 3


def test_an_error_of_the_work_is_that_of_the_result():
    def fail():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        Background().start(fail).result()


def test_the_thread_gives_way_to_tracking():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        background = Background()
        assert background.start(torch.get_num_threads).result() == 1
        assert torch.get_num_threads() == 3
        later = []
        thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
        thread.start()
        thread.join()
        assert later == [3] and background.start(torch.get_num_threads).result() == 1
    finally:
        torch.set_num_threads(before)
    if sys.platform.startswith("linux"):
        own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        there = background.start(lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id())).result()
        assert there == min(own + 5, 19)


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_does_not_wait_for_the_thread():
    """It has none: what was begun is an error at once, what had ended is there, and new work gets a thread."""
    release, background = threading.Event(), Background()
    ended = background.start(lambda: 1)
    assert ended.result() == 1
    running = background.start(lambda: release.wait(60))
    waiting = background.start(lambda: 2)
    for task in (running, waiting):
        assert in_fork(lambda task=task: task.done) == "True"
        assert in_fork(task.result).startswith("DvoError: fork: this process was forked while a thread worked")
    assert in_fork(ended.result) == "1"
    assert in_fork(lambda: background.start(lambda: 3).result()) == "3"
    release.set()
    assert running.result() is True and waiting.result() == 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_does_not_wait_for_steps_ahead():
    release = threading.Event()

    def work():
        release.wait(60)
        yield

    steps = StepsAhead(work(), Background())
    assert in_fork(steps.step).startswith("DvoError: fork: this process was forked while a thread worked")
    release.set()
    assert not steps.step() and steps.step()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("real_time", [False, True])
def test_a_forked_process_does_not_wait_for_a_job(real_time):
    release, maintenance = threading.Event(), MapMaintenance(real_time=real_time)
    maintenance.job = maintenance.beside("search", lambda: release.wait(60), dict, 0)
    assert in_fork(lambda: maintenance.advance(None)).startswith("DvoError: fork: ")
    release.set()


def test_the_thread_ends_with_the_last_reference():
    before, background = set(threading.enumerate()), Background()
    background.start(lambda: None).result()
    (thread,) = set(threading.enumerate()) - before
    del background
    thread.join(20)
    assert not thread.is_alive()
