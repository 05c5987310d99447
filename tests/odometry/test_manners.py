"""Odometries in programs of others: their settings of torch and NumPy, copies, printed objects, misspelt names."""

import contextlib
import copy
import pickle
from functools import cache

import numpy as np
import pytest
import torch

import dvo
from dvo.core.context import own_context
from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import poses_from_matrices
from dvo.odometry.protocol import Estimate, Result, Segment, SparseMap, Status
from tests.support.tiny_tracker import frames, plain, run, tracker

SYSTEMS = ("keyframe", "klt-pnp", "direct", "monoslam")
IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])


@contextlib.contextmanager
def default_dtype():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


CONTEXTS = {
    "dtype": default_dtype,
    "device": lambda: torch.device("meta"),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "errors": lambda: np.errstate(all="raise"),
}


@pytest.fixture(scope="module")
def alone():
    """Estimates and result of the shipped network in a program without settings of its own."""
    return run(dvo.load("small"), frames(10))


@pytest.mark.long
@pytest.mark.parametrize("name", CONTEXTS)
def test_the_settings_of_the_program_change_no_byte(alone, name):
    expected, result = alone
    with CONTEXTS[name]():
        estimates, within = run(dvo.load("small"), frames(10))
        assert [e.confidence for e in estimates] == [e.confidence for e in expected], "computed when it is read"
        assert torch.get_default_dtype() is (torch.float64 if name == "dtype" else torch.float32), "it is restored"
    assert within.trajectory.poses_wc.tobytes() == result.trajectory.poses_wc.tobytes()


def poses_of(system):
    """Poses of a few frames, as bytes."""
    return run(dvo.load(system), frames(6))[1].trajectory.poses_wc.tobytes()


@cache
def poses_alone(system):
    return poses_of(system)


@pytest.mark.long
@pytest.mark.parametrize("name", CONTEXTS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_systems_without_weights_do_not_mind_either(system, name):
    expected = poses_alone(system)
    with CONTEXTS[name]():
        assert poses_of(system) == expected


def test_an_own_context_restores_everything():
    with default_dtype(), torch.device("meta"), torch.autocast("cpu"), np.errstate(all="raise"):
        with own_context():
            assert torch.zeros(1).dtype is torch.float32 and torch.zeros(1).device.type == "cpu"
            assert not torch.is_autocast_enabled("cpu") and np.geterr()["divide"] == "warn"
        assert torch.zeros(1).dtype is torch.float64 and torch.zeros(1).device.type == "meta"
        assert torch.is_autocast_enabled("cpu") and np.geterr()["divide"] == "raise"


@pytest.mark.parametrize("build", [tracker, *(lambda name=name: dvo.load(name) for name in (*SYSTEMS, "msckf"))])
@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_an_odometry_is_not_copied(build, duplicate):
    with pytest.raises(DvoError, match="is not copied or pickled"):
        duplicate(build())


def test_results_and_estimates_are_copied():
    estimates, result = plain(10)
    assert repr(copy.deepcopy(result)) == repr(result) and repr(copy.deepcopy(estimates[-1])) == repr(estimates[-1])


def test_what_is_printed_is_short():
    estimates, result = plain(10)
    shown = [*estimates, result, *result.segments, tracker(), *map(dvo.load, (*SYSTEMS, "msckf"))]
    assert all(len(repr(one)) < 120 and "\n" not in repr(one) and " at 0x" not in repr(one) for one in shown)
    assert repr(result).startswith("Result(10 of 10 frames tracked, 1 segment, ")
    assert "initialising, too few keyframes" in repr(estimates[0])
    empty = Result(Trajectory(np.zeros(0), np.zeros((0, 7))), SparseMap(), 0, 0)
    assert repr(empty) == "Result(0 of 0 frames tracked, 0 segments, 0 map points)"
    assert "joined to 0" in repr(Segment(empty.trajectory, 1.0, 2.0, joined_to=0))


def test_the_matrix_of_an_estimate():
    pose = np.array([1.0, 2, 3, 0, 0, np.sin(0.2), np.cos(0.2)])
    matrix = Estimate(0.0, pose, Status.TRACKING).matrix
    assert matrix.shape == (4, 4) and np.allclose(matrix[:3, 3], pose[:3]) and np.allclose(matrix[3], [0, 0, 0, 1])
    assert np.allclose(poses_from_matrices(matrix), pose)
    assert Estimate(0.0, None, Status.LOST).matrix is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"pathces": 3}, "did you mean 'patches'"),
        ({"preset": "acurate"}, "did you mean 'accurate'"),
        ({"patches": "many"}, "patches: must be a whole number"),
        ({"zzz": 1}, "Use one of pixels"),
    ],
)
def test_settings_are_checked_before_the_weights_are_read(options, said, monkeypatch):
    monkeypatch.setattr("dvo.odometry.load.load_weights", lambda *args: pytest.fail("they were read"))
    with pytest.raises(DvoError, match=f"(?i){said}"):
        dvo.load("small", **options)
    for name in ("droid", "deepvo", "tartanvo"):
        with pytest.raises(DvoError, match="preset"):
            dvo.load(name, preset="quick")


def test_a_name_that_is_nearly_one():
    with pytest.raises(DvoError, match="Did you mean 'small'"):
        dvo.load("smal")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here")
def test_a_device_that_is_not_there():
    with pytest.raises(DvoError, match="device: 'cuda' cannot be used"):
        dvo.load(device="cuda")
