"""One run in a process of its own, and failures of a system as a record, on twenty small images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eval.execution.predict import predict, predict_here, read_prediction, read_trajectory
from eval.execution.process import Ending


def test_a_run_in_its_own_process(job):
    prediction = predict(job)
    assert prediction.status == "ok" and prediction.tracked == len(prediction.stamps) == 20
    assert prediction.resolution == "64x48" and prediction.fps and prediction.fps > 0
    assert prediction.peak_memory_mb and 10 < prediction.peak_memory_mb < 2000
    assert len(read_trajectory(job.folder)) == 20
    assert read_prediction(job.folder) == prediction


def test_stride_feeds_fewer_frames(job):
    assert predict_here(replace(job, stride=3)).stamps == pytest.approx(10 + 0.3 * np.arange(7))


def test_time_limit(job):
    prediction = predict(replace(job, time_limit=0.01))
    assert prediction.status == "timeout" and "0.01 s" in prediction.reason


def test_death_of_the_process(job, tmp_path):
    prediction = predict(replace(job, system=f"{tmp_path / 'dying.py'}:Dies"))
    assert prediction.status == "unavailable"
    (tmp_path / "dying.py").write_text(
        "import os, signal, sys\n"
        "def Dies():\n"
        "    print('last words', file=sys.stderr, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGSEGV)\n"
    )
    prediction = predict(replace(job, system=f"{tmp_path / 'dying.py'}:Dies"))
    assert prediction.status == "crashed" and prediction.reason == "killed by SIGSEGV last words"


def test_exception_of_a_system(job, fake_odometry, systems, boom):
    systems(bad=fake_odometry(at_frame={7: boom}))
    prediction = predict_here(replace(job, system="bad"))
    assert prediction.status == "crashed" and prediction.reason.startswith("RuntimeError: boom")
    assert len(read_trajectory(job.folder)) == 0


def test_poses_that_are_not_finite(job, fake_odometry, systems):
    systems(bad=fake_odometry(motion=lambda t: np.full(7, np.nan if t > 11 else 0.5)))
    prediction = predict_here(replace(job, system="bad"))
    assert prediction.status == "invalid" and "9 poses are not finite" in prediction.reason
    assert len(read_trajectory(job.folder)) == 0


def test_missing_data_is_a_status(job):
    prediction = predict_here(replace(job, sequence=replace(job.sequence, path="elsewhere")))
    assert prediction.status == "no data" and "elsewhere" in prediction.reason


def test_worker_has_the_threads_of_its_job_and_waits_passively(job, monkeypatch):
    given = {}

    def run(command, environment, seconds, log):
        given.update(environment)
        return Ending(1, "")

    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("eval.execution.predict.run_limited", run)
    assert predict(replace(job, threads=3)).status == "crashed"
    assert given["OMP_NUM_THREADS"] == given["MKL_NUM_THREADS"] == given["OPENBLAS_NUM_THREADS"] == "3"
    assert given["OMP_WAIT_POLICY"] == "PASSIVE"
