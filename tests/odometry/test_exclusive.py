"""Calls of an odometry from another thread, while a frame is tracked."""

import os
import threading
from dataclasses import replace

import numpy as np
import pytest

import dvo
from dvo.odometry.exclusive import METHODS, UNLOCKED, exclusive
from dvo.odometry.load import build_odometry
from dvo.odometry.patch.tracker import PatchOdometry
from tests.support.forked import in_fork
from tests.support.tiny_members import MEMBERS, SETTINGS, frames, network

SOON = 0.3  # seconds in which a call that does not wait is done


def tracked(images, call=None):
    """Odometry that has tracked images, and what a call from another thread has given.

    It is made in the middle of the frame before the last one, at the selection of its patches, and must wait for the
    end of that frame.
    """
    odometry = build_odometry(network("patch_vo"), seed=1, **SETTINGS["patch_vo"])
    outcomes = []
    for frame in images[:-2]:
        odometry.track(frame)
    thread = threading.Thread(target=lambda: outcomes.append(None if call is None else call(odometry)))
    select, waited = odometry.select, []

    def interrupted(*arguments, **keywords):
        odometry.select = select
        thread.start()
        thread.join(SOON)
        waited.append(thread.is_alive())
        return select(*arguments, **keywords)

    if call is not None:
        odometry.select = interrupted
    odometry.track(images[-2])
    if call is not None:
        thread.join()
        assert waited == [True]
    odometry.track(images[-1])
    return odometry, *outcomes


@pytest.mark.long
def test_the_result_so_far_is_that_between_two_frames():
    images = frames(3)
    (alone,), (odometry, result) = tracked(images), tracked(images, PatchOdometry.current)
    (expected,) = tracked(images[:-1])
    poses = result.trajectory.poses_wc
    assert len(poses) > 3 and np.array_equal(poses, expected.current().trajectory.poses_wc)
    assert result.frames_read == len(images) - 1
    assert np.array_equal(odometry.finish().trajectory.poses_wc, alone.finish().trajectory.poses_wc)


@pytest.mark.long
def test_a_map_saved_by_another_thread_is_that_between_two_frames(tmp_path):
    images = frames(3)
    odometry, _ = tracked(images, lambda odometry: odometry.save(tmp_path / "map.dvo"))
    loaded = dvo.load_map(tmp_path / "map.dvo", weights=network("patch_vo"))
    assert loaded.current().frames_read == len(images) - 1
    assert np.array_equal(odometry.finish().trajectory.poses_wc, tracked(images)[0].finish().trajectory.poses_wc)


def test_a_new_beginning_waits_for_the_frame():
    odometry, _ = tracked(frames(3), PatchOdometry.reset)
    assert odometry.current().frames_read == 1, "of the frame after it"


@pytest.mark.long
@pytest.mark.parametrize("member", MEMBERS)
def test_every_odometry_finishes_a_frame_first(member):
    """The image of the last frame is read within ``track``, and meanwhile another thread asks for the result."""
    odometry = build_odometry(network(member), **SETTINGS.get(member, {}))
    images, waited, counts = frames(3), [], []
    thread = threading.Thread(target=lambda: counts.append(odometry.current().frames_read))

    class Interrupted:
        def __array__(self, *_, **__):
            thread.start()
            thread.join(SOON)
            waited.append(thread.is_alive())
            return images[2].image

    for frame in (*images[:2], replace(images[2], image=Interrupted())):
        odometry.track(frame)
    thread.join()
    assert waited == [True] and counts == [3]


@pytest.mark.parametrize("member", MEMBERS)
def test_every_public_method_is_exclusive(member):
    cls = type(build_odometry(network(member), **SETTINGS.get(member, {})))
    public = {name for name, value in vars(cls).items() if callable(value) and not name.startswith("_")}
    assert public <= {*METHODS, *UNLOCKED} and {"track", "finish", "current", "reset"} <= public


def test_two_objects_do_not_wait_for_each_other():
    @exclusive
    class Meeting:
        def track(self, barrier):
            barrier.wait(10)  # raises if the other one does not come

    barrier = threading.Barrier(2)
    thread = threading.Thread(target=Meeting().track, args=(barrier,))
    thread.start()
    Meeting().track(barrier)
    thread.join()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_does_not_wait_for_a_thread_that_it_does_not_have(monkeypatch):
    # In a process where torch has computed with several threads, that is refused first.
    monkeypatch.setattr("dvo.odometry.exclusive.use_threads", lambda: None)
    begun, release = threading.Event(), threading.Event()

    @exclusive
    class Slow:
        def track(self):
            begun.set()
            return release.wait(60)

        def current(self):
            return "now"

    slow = Slow()
    assert in_fork(slow.current) == "'now'"
    thread = threading.Thread(target=slow.track)
    thread.start()
    begun.wait(60)
    try:
        assert in_fork(slow.current).startswith("DvoError: fork: this process was forked while another thread used")
    finally:
        release.set()
        thread.join()
    assert in_fork(slow.current) == "'now'"
