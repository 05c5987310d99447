"""One run in a process of its own, and failures of a system as a record, on twenty small images."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.core.processes import Ending
from dvo.data.trajectory import Trajectory, read_tum
from dvo.odometry.protocol import Break, Segment
from eval.execution.predict import (
    RECORD,
    TRAJECTORY,
    predict,
    predict_here,
    read_prediction,
    read_segments,
    without_empty,
)


@pytest.mark.long
def test_a_run_in_its_own_process(job):
    prediction = predict(job)
    assert prediction.status == "ok" and prediction.tracked == len(prediction.stamps) == 20
    assert prediction.resolution == "64x48" and prediction.fps and prediction.fps > 0
    assert prediction.peak_memory_mb and 10 < prediction.peak_memory_mb < 2000
    (segment,) = read_segments(job.folder)
    assert len(segment) == 20 and segment.joined_to is None
    assert read_prediction(job.folder) == prediction


def test_stride_feeds_fewer_frames(job):
    assert predict_here(replace(job, stride=3)).stamps == pytest.approx(10 + 0.3 * np.arange(7))


def test_time_limit(job):
    prediction = predict(replace(job, time_limit=0.01))
    assert prediction.status == "timeout" and "0.01 s" in prediction.reason


@pytest.mark.long
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
    assert read_segments(job.folder) == ()


def test_poses_that_are_not_finite(job, fake_odometry, systems):
    systems(bad=fake_odometry(motion=lambda t: np.full(7, np.nan if t > 11 else 0.5)))
    prediction = predict_here(replace(job, system="bad"))
    assert prediction.status == "invalid" and "9 poses are not finite" in prediction.reason
    assert read_segments(job.folder) == ()


def test_missing_data_is_a_status(job):
    prediction = predict_here(replace(job, sequence=replace(job.sequence, path="elsewhere")))
    assert prediction.status == "no data" and "elsewhere" in prediction.reason


def test_segments_and_breaks_are_stored(job, pieces, systems):
    gap = Break(10.6, 10.9, 2, "black image")
    systems(parts=pieces((0, 7), (9, 20), breaks=(gap,)))
    prediction = predict_here(replace(job, system="parts"))
    assert prediction.status == "ok" and prediction.tracked == 18
    assert prediction.segments == [{"rows": 7, "joined_to": None}, {"rows": 11, "joined_to": None}]
    assert prediction.breaks == [
        {"start": 10.6, "end": 10.9, "frames": 2, "reason": "black image", "new_segment": True}
    ]
    assert read_prediction(job.folder) == prediction
    first, second = read_segments(job.folder)
    assert (len(first), first.start, first.end) == (7, 10.0, pytest.approx(10.6))
    assert (len(second), second.start, second.end) == (11, pytest.approx(10.9), pytest.approx(11.9))
    whole = read_tum(Path(job.folder, TRAJECTORY))  # readable by any tool for TUM files
    assert len(whole) == 18 and (whole.poses_wc[7:] == second.trajectory.poses_wc).all()


def test_joined_segments_stay_joined(job, pieces, systems):
    systems(parts=pieces((0, 7), (9, 12), (14, 20), joined={2: 0}))
    predict_here(replace(job, system="parts"))
    assert [segment.joined_to for segment in read_segments(job.folder)] == [None, None, 0]


def test_a_record_without_segments_is_one_segment(job, pieces, systems):
    systems(parts=pieces((0, 7), (9, 20)))
    predict_here(replace(job, system="parts"))
    path = Path(job.folder, RECORD)
    record = json.loads(path.read_text())
    for name in ("segments", "breaks", "unseen"):
        del record[name]
    path.write_text(json.dumps(record))
    (only,) = read_segments(job.folder)
    assert len(only) == 18 and only.joined_to is None and read_prediction(job.folder).unseen == []


def test_a_record_of_another_trajectory_is_an_error(job, pieces, systems):
    systems(parts=pieces((0, 7), (9, 20)), other=pieces((0, 8), (9, 20)))
    predict_here(replace(job, system="parts"))
    path = Path(job.folder, RECORD)
    record = path.read_text()
    predict_here(replace(job, system="other"))
    path.write_text(record)
    with pytest.raises(DvoError, match=r"19 rows, but the record has 18"):
        read_segments(job.folder)


def test_a_frame_has_one_pose(job, pieces, systems):
    systems(parts=pieces((0, 12), (9, 20)))
    prediction = predict_here(replace(job, system="parts"))
    assert prediction.status == "invalid" and prediction.reason == "3 frames have more than one pose"
    assert read_segments(job.folder) == ()


def test_segments_are_in_order_of_time(job, pieces, systems):
    systems(parts=pieces((9, 20), (0, 7)))
    prediction = predict_here(replace(job, system="parts"))
    assert prediction.status == "invalid" and "order of time" in prediction.reason


def test_empty_segments_are_dropped():
    one = Trajectory(np.zeros(1), np.array([[0.0, 0, 0, 0, 0, 0, 1]]))
    none = Trajectory(np.zeros(0), np.zeros((0, 7)))
    given = [Segment(none, 0, 0), Segment(one, 0, 0), Segment(one, 1, 1, 0), Segment(one, 2, 2), Segment(one, 3, 3, 1)]
    assert [(s.start, s.joined_to) for s in without_empty(given)] == [(0, None), (1, None), (2, None), (3, 0)]
    given[2] = Segment(one, 1, 1)
    given[3] = Segment(one, 2, 2, 0)
    given[4] = Segment(one, 3, 3, 0)
    assert [(s.start, s.joined_to) for s in without_empty(given)] == [(0, None), (1, None), (2, None), (3, 2)]
    assert without_empty(given[1:4]) == tuple(given[1:4])


def test_frames_without_a_view_are_recorded(job, image_folder, pieces, systems):
    scene = cv2.GaussianBlur(cv2.imread(str(image_folder / "0000.png")), (0, 0), 3)
    scene = cv2.normalize(scene, None, 40, 200, cv2.NORM_MINMAX)
    for number in range(20):
        image = {4: 0, 5: 255}.get(number)
        if number != 17:  # that one stays noise
            cv2.imwrite(str(image_folder / f"{number:04d}.png"), scene if image is None else np.full_like(scene, image))
    systems(parts=pieces((0, 20)))
    assert predict_here(replace(job, system="parts")).unseen == pytest.approx([10.4, 10.5, 11.7])


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
