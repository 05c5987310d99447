"""Jobs of a map: applied at a stated frame, one after the other, and told as one message."""

import threading

import pytest
import torch

from dvo.odometry.maintenance.background import Steps
from dvo.odometry.maintenance.maintenance import MapMaintenance


class Owner:
    """Keeps what it is told, and begins the jobs that it is given."""

    def __init__(self, *jobs):
        self.jobs, self.told, self.ended = list(jobs), [], []

    def moved(self, units):
        self.told.append(dict(units))

    def next_job(self, ended, at_once):
        self.ended.append((ended.kind, at_once))
        return self.jobs.pop(0)() if self.jobs else None


def counting(count, result):
    def steps():
        for _ in range(count):
            yield
        return result

    return steps()


def test_a_job_beside_tracking_is_applied_at_its_frame_however_soon_it_is_done():
    maintenance, owner = MapMaintenance(), Owner()
    maintenance.job = maintenance.beside("correction", lambda: 2.0, lambda scale: {3: scale}, 4)
    maintenance.job.task.result()
    assert [maintenance.advance(owner) for _ in range(5)] == [False, False, False, True, False]
    assert owner.told == [{3: 2.0}] and owner.ended == [("correction", False)] and maintenance.job is None


def test_in_real_time_it_is_applied_when_it_is_there():
    maintenance, owner, release = MapMaintenance(real_time=True), Owner(), threading.Event()
    maintenance.job = maintenance.beside("correction", lambda: release.wait(60), lambda _: {1: 0.5}, 1)
    assert maintenance.occupies_core and maintenance.waits
    assert not any(maintenance.advance(owner) for _ in range(3))
    release.set()
    maintenance.job.task.result()
    assert not maintenance.waits and maintenance.advance(owner) and owner.told == [{1: 0.5}]


def test_steps_are_taken_with_the_frames():
    maintenance, owner, found = MapMaintenance(steps=2), Owner(), []
    maintenance.job = maintenance.in_steps("search", counting(4, "loop"), lambda loop: found.append(loop) or {})
    counts = 0
    while maintenance.job is not None:
        assert not maintenance.advance(owner) and not maintenance.occupies_core
        counts += 1
    assert counts == 3 and found == ["loop"] and not owner.told


@pytest.mark.parametrize("cores, thread", [(1, False), (2, True)])
def test_the_thread_takes_steps_ahead_if_it_has_a_core(monkeypatch, cores, thread):
    """The result is taken at the same frame, and at once where it is waited for."""
    monkeypatch.setattr("dvo.core.context.available_cores", lambda: cores * torch.get_num_threads())
    maintenance, owner, found, where = MapMaintenance(steps=2), Owner(), [], []

    def steps():
        for _ in range(4):
            where.append(threading.get_ident() != threading.main_thread().ident)
            yield
        return "loop"

    for at_once, frames in ((False, 3), (True, 1)):
        job = maintenance.in_steps("search", steps(), lambda loop: found.append(loop) or {}, ahead=True)
        maintenance.job, counts = job, 0
        while maintenance.job is not None:
            assert not maintenance.advance(owner, at_once) and not maintenance.occupies_core
            counts += 1
        assert counts == frames
    assert found == ["loop", "loop"] and where == [thread] * 8
    assert isinstance(maintenance.in_steps("search", steps(), found.append).task, Steps)


def test_the_thread_helps_if_it_has_a_core_and_no_job(monkeypatch):
    cores = [torch.get_num_threads() + 1]
    monkeypatch.setattr("dvo.core.context.available_cores", lambda: cores[0])
    maintenance = MapMaintenance()
    assert maintenance.helper(threading.get_ident).result() != threading.get_ident()
    maintenance.job = maintenance.beside("correction", lambda: None, lambda _: {}, 1)
    assert maintenance.helper is None
    maintenance.job, cores[0] = None, torch.get_num_threads()
    assert maintenance.helper is None


def test_what_follows_is_waited_for_too():
    maintenance = MapMaintenance()
    owner = Owner(
        lambda: maintenance.beside("adjustment", lambda: None, lambda _: {}, 9),
        lambda: maintenance.beside("correction", lambda: None, lambda _: {7: 1.5}, 9),
    )
    maintenance.job = maintenance.in_steps("search", counting(3, None), lambda _: {})
    assert maintenance.drain(owner) and maintenance.job is None and not maintenance.drain(owner)
    assert owner.ended == [("search", True), ("adjustment", True), ("correction", True)] and owner.told == [{7: 1.5}]


def test_a_job_that_another_one_begins_comes_before_the_next():
    maintenance = MapMaintenance()
    owner = Owner(lambda: pytest.fail("the correction is in progress"))

    def found(_):
        maintenance.job = maintenance.beside("correction", lambda: None, lambda _: {}, 1)
        return {}

    maintenance.job = maintenance.in_steps("search", counting(0, None), found)
    maintenance.advance(owner)
    assert maintenance.job.kind == "correction" and not owner.ended


def test_a_job_that_fails_is_over():
    maintenance, owner = MapMaintenance(), Owner()
    maintenance.job = maintenance.beside("adjustment", lambda: 1 / 0, lambda _: {}, 1)
    with pytest.raises(ZeroDivisionError):
        maintenance.advance(owner)
    assert maintenance.job is None and not maintenance.advance(owner)
