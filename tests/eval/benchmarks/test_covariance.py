"""Normalised errors: known for known errors; and the errors of poses, in the gauge of the covariance."""

import numpy as np
import pytest
import torch

from dvo.geometry import se3
from dvo.odometry.uncertainty.gauge import Gauge, relative_error
from dvo.synth.sequence import make_sequence
from eval.benchmarks import covariance
from eval.benchmarks.covariance import (
    FARTHEST,
    Errors,
    beginning,
    confidence_table,
    frames_of,
    line,
    main,
    measure,
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
    gauge = Gauge(1, (2, 3))
    np.testing.assert_allclose(relative_error(found, true, gauge), xi.numpy(), atol=1e-12)
    world = se3.exp(torch.tensor([1.0, 2, 3, 0.4, 0.5, 0.6], dtype=torch.float64)).expand_as(true)
    metres = se3.compose(true, world)
    metres = torch.cat((7 * metres[:, :3], metres[:, 3:]), -1)
    np.testing.assert_allclose(relative_error(found, metres, gauge), xi.numpy(), atol=1e-12)


def test_the_error_of_a_pose_in_metres_contains_that_of_the_scale():
    generator = torch.Generator().manual_seed(0)
    true = se3.exp(0.3 * torch.randn(5, 6, generator=generator, dtype=torch.float64))
    world = se3.exp(torch.tensor([1.0, 2, 3, 0.4, 0.5, 0.6], dtype=torch.float64)).expand_as(true)
    true = se3.compose(true, world)
    longer = torch.cat((1.1 * true[:, :3], true[:, 3:]), -1)
    gauge = Gauge(1, (2, 3))
    step = se3.relative(true[1], true[4])[:3]
    found = relative_error(longer, true, gauge, metric=True)
    np.testing.assert_allclose(found, [*(0.1 * step).tolist(), 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(relative_error(longer, true, gauge), np.zeros(6), atol=1e-12)


def walk(frames):
    size = {"height": 120, "width": 160, "fps": 15.0}
    return make_sequence(61, frames=frames, family="room", kind="handheld", speed=3.0, **size)


@pytest.mark.long
def test_frames_bring_what_the_scale_comes_from(monkeypatch):
    sequence = walk(2)
    plain, deep, pair = (list(frames_of(sequence, scale, 0.3))[1] for scale in ("none", "depth", "stereo"))
    assert plain.depth is None and plain.right is None and deep.right is None and pair.depth is None
    for frame in (deep, pair):
        assert np.array_equal(frame.image, plain.image) and frame.timestamp == plain.timestamp
    true = sequence.rendering(1).depth[0].numpy()
    np.testing.assert_array_equal(deep.depth, np.where((true > 0) & (true <= FARTHEST), true, np.nan))
    assert np.array_equal(pair.right.image, sequence.stereo(0.3).frame(1).image) and pair.right.baseline == 0.3
    monkeypatch.setattr(covariance, "FARTHEST", float(np.median(true)))
    assert 0.4 < np.isnan(next(frames_of(sequence, "depth")).depth).mean() < 0.6


@pytest.mark.slow
def test_a_sequence_in_metres_is_measured():
    for scale in ("depth", "stereo"):
        errors = measure(walk(16), "small", 0, scale)
        assert 5 < errors.poses == len(errors.joint)
        assert 0.01 < np.median(errors.joint) < 20, "far off if the scale of the window is not that of the truth"


def test_the_calibration_split_has_other_scenes_of_the_same_options(monkeypatch, capsys):
    calls = []

    def tracked(sequence, weights, seed, scale, baseline):
        calls.append((sequence, scale, baseline))
        return gaussian(count=3)

    monkeypatch.setattr(covariance, "make_sequence", lambda **options: options)
    monkeypatch.setattr(covariance, "beginning", lambda sequence, frames: sequence)
    monkeypatch.setattr(covariance, "measure", tracked)
    assert main(["--scale", "stereo"]) == main(["--scale", "stereo", "--split", "calibration", "--clips", "2"]) == 0
    printed = capsys.readouterr().out
    assert "stereo_fast clip 1 " in printed and "suite stereo_fast " in printed
    validation, calibration = calls[:3], calls[3:]
    assert [scale for _, scale, _ in calls] == ["stereo"] * 9 and {x[2] for x in calls} == {0.12}
    seeds = [[options["seed"] for options, _, _ in part] for part in (validation, calibration)]
    assert seeds[0] == [3000001000, 3000001001, 3000004000] and len(set(seeds[0] + seeds[1])) == 9
    for (one, _, _), (other, _, _) in zip(validation, calibration[::2], strict=True):
        assert {**one, "seed": 0} == {**other, "seed": 0} and "version" not in one and "baseline" not in one
    assert main(["--scale", "depth"]) == 0 and "depth" not in calls[-1][0]


@pytest.mark.long
def test_a_sequence_is_measured_on_its_first_frames():
    longer = walk(40)
    short = beginning(longer, 18)
    assert len(short) == 18 and np.array_equal(short.frame(17).image, longer.frame(17).image)
    errors = measure(short, "small", 0)
    assert 5 < errors.poses <= 18 and len(errors.joint) == errors.poses
    assert np.median(errors.joint) < 20 and 0 < np.median(errors.displacement) < 5


@pytest.mark.parametrize("suites", ["plain,nothing", "validation"])
def test_bad_input_is_one_line(suites, capsys):
    assert main(["--suites", suites]) == 2
    assert capsys.readouterr().err.startswith("covariance: error: ")
