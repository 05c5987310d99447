"""Normalised errors: known for known errors; and the errors of poses, in the gauge of the covariance."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dvo.geometry import se3
from dvo.odometry.uncertainty import Gauge
from dvo.synth.sequence import make_sequence
from eval.benchmarks.covariance import (
    Errors,
    _beginning,
    confidence_table,
    line,
    main,
    measure,
    pose_error,
    scale_factor,
)


def gaussian(scale=1.0, count=4000, seed=0):
    """Errors of poses whose covariance is too small by a factor."""
    rng = np.random.default_rng(seed)
    root, found = rng.normal(size=(6, 6)), Errors(count)
    covariance = root @ root.T
    for xi in rng.normal(size=(count, 6)) @ root.T:
        found.add(np.sqrt(scale) * xi, covariance, 1e-3 * np.eye(6), 0.5)
    return found


def test_the_factor_is_found():
    right, wide = gaussian(), gaussian(9.0)
    for name in ("joint", "rotation", "position"):
        assert np.mean(getattr(right, name)) == pytest.approx(1, abs=0.06)
        assert np.mean(getattr(wide, name)) == pytest.approx(9, rel=0.06)
    assert scale_factor([right, wide]) == pytest.approx(3, rel=0.05)
    assert np.isnan(scale_factor([Errors()]))
    both = Errors.concatenate([right, wide])
    assert both.poses == len(both.joint) == len(both.confidence) == 8000
    robust = float(line("name", right).split("|")[1].split()[1])
    assert robust == pytest.approx(1, abs=0.06)
    assert line("lost", Errors(3)).split() == ["lost", "3", "0", "|"]


def test_shares_by_confidence():
    sure, unsure = Errors(2), Errors(2)
    metric, covariance = np.eye(6), np.eye(6)
    for size, confidence in ((0.4, 0.9), (0.6, 0.9)):
        sure.add(size * np.eye(6)[0], covariance, metric, confidence)
    unsure.add(0.9 * np.eye(6)[5], covariance, metric, 0.1)
    lines = list(confidence_table({"a": sure, "b": unsure}))
    first, fifth = (lines[k].replace("|", " ").split() for k in (1, 5))
    assert first[3:5] == ["1", "0.10"] and first[5] == "0.00"
    assert fifth[3:] == ["2", "0.90", "0.50", "0.500", "2", "0.50", "0", "nan"]


def test_the_error_of_a_pose_is_relative_and_in_the_scale_of_the_gauge():
    generator = torch.Generator().manual_seed(0)
    true = se3.exp(0.3 * torch.randn(5, 6, generator=generator, dtype=torch.float64))
    xi = torch.tensor([0.02, -0.01, 0.03, 0.01, 0.02, -0.03], dtype=torch.float64)
    found = true.clone()
    found[4] = se3.compose(se3.exp(xi), true[4])  # T_wc_true = T_wc Exp(xi)
    window, gauge = SimpleNamespace(poses_cw=found), Gauge(1, (2, 3))
    np.testing.assert_allclose(pose_error(window, gauge, true), xi.numpy(), atol=1e-12)
    world = se3.exp(torch.tensor([1.0, 2, 3, 0.4, 0.5, 0.6], dtype=torch.float64)).expand_as(true)
    metres = se3.compose(true, world)
    metres = torch.cat((7 * metres[:, :3], metres[:, 3:]), -1)
    np.testing.assert_allclose(pose_error(window, gauge, metres), xi.numpy(), atol=1e-12)


def test_a_sequence_is_measured_on_its_first_frames():
    walk = make_sequence(61, frames=40, family="room", kind="handheld", speed=3.0, height=120, width=160, fps=15.0)
    short = _beginning(walk, 18)
    assert len(short) == 18 and np.array_equal(short.frame(17).image, walk.frame(17).image)
    errors = measure(short, "small", 0)
    assert 5 < errors.poses <= 18 and len(errors.joint) == errors.poses
    assert np.median(errors.joint) < 20 and 0 < np.median(errors.displacement) < 5


@pytest.mark.parametrize("suites", ["plain,nothing", "validation"])
def test_bad_input_is_one_line(suites, capsys):
    assert main(["--suites", suites]) == 2
    assert capsys.readouterr().err.startswith("covariance: error: ")
