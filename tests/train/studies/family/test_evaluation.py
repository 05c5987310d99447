"""Measurements on held-out sequences."""

import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, Segment, SparseMap, Status
from train.studies.family import evaluation
from train.studies.family.evaluation import errors_of, held_out_sequence, measure, straight_line
from train.studies.family.training import sequence_folder


def clip(config):
    name, options = next(iter(config.held_out.sequences().items()))
    return held_out_sequence(sequence_folder(config, name), options)


def test_a_sequence_is_rendered_once(family, monkeypatch):
    frames, truth = clip(family())
    assert len(frames) == len(truth) == 8 and frames[0].image.shape == (48, 64, 3)
    monkeypatch.setattr(evaluation, "make_sequence", None)
    again, _ = clip(family())
    assert all(np.array_equal(a.image, b.image) for a, b in zip(frames, again, strict=True))
    assert np.allclose([frame.timestamp for frame in frames], truth.timestamps, atol=1e-6)


class Oracle:
    """Knows the truth up to scale, and loses some frames."""

    name = "oracle"

    def __init__(self, truth, lost=()):
        self.truth, self.lost, self.seen = truth, lost, 0

    def track(self, frame):
        self.seen += 1
        if self.seen - 1 in self.lost:
            return Estimate(frame.timestamp, None, Status.LOST)
        return Estimate(frame.timestamp, self.truth.poses_wc[self.seen - 1], Status.TRACKING)

    def finish(self):
        kept = [k for k in range(self.seen) if k not in self.lost]
        poses = self.truth.poses_wc[kept] * [3, 3, 3, 1, 1, 1, 1]
        return Result(Trajectory(self.truth.timestamps[kept], poses), SparseMap(), self.seen, len(self.lost))


def test_measures_of_an_odometry_that_loses_a_frame(family):
    frames, truth = clip(family())
    found = measure(Oracle(truth, lost=(3,)), frames, truth, (1, 2))
    assert found.metrics.ate_percent < 1e-6 and found.segments == 1 and found.fps > 0
    assert np.flatnonzero(np.isinf(found.errors[1])).tolist() == [2, 3]
    assert np.flatnonzero(np.isinf(found.errors[2])).tolist() == [1, 3]
    assert len(found.pooled) == 7 + 6 and np.isfinite(found.pooled).sum() == 9
    columns = found.columns()
    assert (columns["frames"], columns["posed"]) == (8, 7) and columns["memory_mb"] > 10


def test_the_straight_line_and_nothing(family):
    _, truth = clip(family())
    line = errors_of(straight_line(truth), truth, (1,))
    assert line.metrics.rotation_error_ratio == pytest.approx(1) and np.isfinite(line.pooled).all()
    none = errors_of([], truth, (1,))
    assert np.isinf(none.pooled).all() and none.segments == 0 and np.isnan(none.metrics.ate_percent)
    far = Segment(Trajectory(truth.timestamps + 100, truth.poses_wc), 100.0, 101.0)
    assert np.isinf(errors_of([far], truth, (1,)).pooled).all()
