"""Speeds side by side: what is timed, what is counted, and the rows of the table."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Result, SparseMap
from eval.benchmarks import speed, timed_run
from eval.benchmarks.speed import compare, find_sequences, main, run_once, table, values
from eval.benchmarks.timed_run import CallCounter, Job, Timed, counted, kinds_of, timed
from tests.support.tiny_tracker import SMALL, frames, tracker


@pytest.mark.long
def test_a_run_in_a_process_of_its_own(tmp_path, image_folder, sequence):
    found = run_once(Job("null", sequence, str(tmp_path), frames=12))
    assert len(found.track_ms) == 12 and min(found.track_ms) > 0 and found.tracked == 1
    assert 10 < found.peak_mb < 3000 and found.finish_ms > 0 and found.ate_m >= 0 and not found.calls


def test_systems_take_turns_and_one_that_fails_is_told(tmp_path, sequence, suite, monkeypatch, capsys):
    order = []

    def run(job):
        order.append((job.system, job.count))
        if job.system == "direct":
            raise DvoError("failed: out of memory", field=job.system, remedy="buy some")
        return Timed([10.0] * 3 + [50.0 * len(order)], 1.0, 2.0, 100.0 * len(order), 0.01, 0.5, 1.0, {"all": 7.0})

    monkeypatch.setattr(speed, "run_once", run)
    monkeypatch.setattr("eval.systems.peers.colmap.missing", lambda: "not here")
    rows = compare(["null", "direct", "klt-pnp", "colmap"], [(suite, sequence)], tmp_path, 4, 2)
    assert order == [("null", True), ("direct", True), ("klt-pnp", True), ("null", False), ("klt-pnp", False)]
    assert list(rows) == [("clip", "null"), ("clip", "klt-pnp")]
    out = capsys.readouterr().out
    assert "colmap: not here" in out and "clip, direct: failed: out of memory" in out
    text = table(rows).splitlines()
    assert len(text) == 4 and {line.count("|") for line in text} == {text[0].count("|")}
    assert "| clip | null | " in text[2] and "| – | – | – | 7 |" in text[2]


def test_a_row_has_the_medians_of_the_rounds():
    rounds = [
        Timed([1e3 * k, 1e3 * k, 2e3 * k], k, k, mb, 0.01 * k, k, 1.0, calls)
        for k, mb, calls in ((1.0, 30.0, {"all": 5.0, "keyframe": 9.0}), (4.0, 50.0, {}), (2.0, 40.0, {}))
    ]
    found = values(rounds)
    assert found["frames/s"] == pytest.approx(3 / 8) and found["p50"] == 2000 and found["max"] == 4000
    assert found["cpu"] == found["finish"] == found["ATE cm"] == 2 and found["MB"] == 50
    assert (found["all"], found["keyframe"]) == (5, 9) and "dropped" not in found


def test_time_that_a_peer_waits_for_the_camera_does_not_count(monkeypatch):
    clock = SimpleNamespace(perf_counter=lambda: clock.now, process_time=lambda: clock.now / 2, now=0.0)
    monkeypatch.setattr(timed_run, "time", clock)

    class Peer:
        waited = 0.0

        def track(self, frame):
            clock.now += frame
            self.waited += frame - 0.25

        def finish(self):
            clock.now += 3
            return "result"

    result, seconds, processor, finish = timed(Peer(), [1.0, 2.0])
    assert (result, processor, finish) == ("result", 1.5, 3.0) and seconds == pytest.approx([0.25, 0.25])


def test_calls_of_aten_are_counted_also_without_gradients():
    with CallCounter() as counter, torch.inference_mode():
        x = torch.ones(3)
        x.add_(x)
        assert (counter.calls, counter.computing) == (2, 2)
        x[1:].unsqueeze(0).to(torch.float32).numpy()  # views, and what gives what it was given
        assert counter.calls > 4 and counter.computing == 2
        torch.stack((x, x)).unbind()
    assert counter.computing == 3


@pytest.mark.long
def test_calls_by_kind_of_frame():
    odometry = tracker(replace(SMALL, keyframe_motion=1e9))  # the first keyframe of three stays
    found = counted(odometry, frames(12))
    kinds = kinds_of(odometry, [False] * 12)
    assert set(kinds) == {"keyframe", "dropped"} == set(found) - {"all", "computing"}
    share = kinds.count("keyframe") / 12
    assert found["all"] == pytest.approx(share * found["keyframe"] + (1 - share) * found["dropped"])
    assert found["dropped"] > 50 and 0 < found["computing"] < found["all"]


def test_kinds_of_lost_repeated_and_aligned_frames():
    def record(anchor, lost=False):
        return SimpleNamespace(anchor=anchor, lost=lost)

    archive = {k: SimpleNamespace(anchor=anchor) for k, anchor in enumerate([None, 0, 0])}
    log = SimpleNamespace(frames=[record(0), record(0), record(None, lost=True), record(1), record(2)])
    odometry = SimpleNamespace(graph=SimpleNamespace(log=log, archive=archive))
    assert kinds_of(odometry, [False, False, False, False, True]) == ["keyframe", "", "", "dropped", "aligned"]


@pytest.mark.long
def test_sequences_by_name_and_folder(tmp_path, capsys):
    (suite, sequence), (axis, rendered) = find_sequences(["tum_fr1_rpy_60", "loop_validation_0"])
    assert (suite.name, sequence.name) == ("validation", "tum_fr1_rpy_60")
    assert axis.name == "loop" and rendered.rendered is not None
    with pytest.raises(DvoError, match="no_such"):
        find_sequences(["no_such"])
    assert main(["--sequences", "no_such"]) == 2 and "no_such" in capsys.readouterr().err


def test_no_error_where_nothing_was_tracked():
    truth = Trajectory(np.arange(3.0), np.tile([0.0, 0, 0, 0, 0, 0, 1], (3, 1)))
    nothing = Result(Trajectory(np.zeros(0), np.zeros((0, 7))), SparseMap(), 3, 3)
    fed = [SimpleNamespace(timestamp=float(k)) for k in range(3)]
    assert np.isnan(timed_run.errors_of(nothing, truth, fed).ate_rmse)
