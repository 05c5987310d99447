"""Chi-square of the weights: known for known errors, and zero for true measurements."""

import pytest
import torch

from dvo.odometry.load import load
from dvo.synth.sequence import make_sequence
from eval.benchmarks.true_positions import TruePositions
from eval.benchmarks.weight_calibration import Errors, Recorder, chi_of, main, table


def gaussian(sigma, count=20_000, wrong=0, seed=0):
    """Errors whose weights are inverse variances in units of ``sigma^-2``, and some gross ones."""
    generator = torch.Generator().manual_seed(seed)
    weights = 0.001 + 0.999 * torch.rand(count, generator=generator)
    residual = sigma / weights.sqrt() * torch.randn(count, generator=generator)
    residual[:wrong] = 10.0
    return Errors(residual.square(), weights, weights)


def test_sigma_is_found_and_makes_chi_square_one():
    chi = chi_of(gaussian(0.05))
    assert chi.sigma == pytest.approx(0.05, rel=0.02) and chi.robust_sigma == pytest.approx(0.05, rel=0.03)
    parts = [gaussian(0.05).between(low, high) for low, high in ((0, 0.2), (0.2, 0.7), (0.7, 1))]
    assert sum(len(part.weights) for part in parts) == 20_000
    assert all(chi_of(part).mean / 0.05**2 == pytest.approx(1, abs=0.06) for part in parts)


def test_wrong_matches_move_the_mean_and_not_the_median():
    chi = chi_of(gaussian(0.05, wrong=200))
    assert chi.sigma > 0.4 and chi.robust_sigma == pytest.approx(0.05, rel=0.05)


def test_the_table_reports_the_other_sequences_over_the_fitted_sigma():
    lines = table("network", gaussian(0.05), gaussian(0.1, seed=1))
    assert lines[0].startswith("network: sigma 0.05")
    entries, mean, robust = lines[2].split("|")[1].split()
    assert (
        entries == "20000" and float(mean) == pytest.approx(4, abs=0.2) and float(robust) == pytest.approx(4, abs=0.3)
    )
    assert chi_of(Errors.concatenate([])).count == 0


@pytest.mark.slow
def test_measurements_are_compared_with_the_truth():
    sequence = make_sequence(77, frames=32, height=192, width=256, fps=15.0, family="street", apart=True)
    depth = torch.stack([torch.as_tensor(sequence.rendering(i).depth[0]) for i in range(len(sequence))])
    truth = TruePositions(sequence, depth)
    odometry = load("small", final_adjustment=False, restart=False)
    recorder = Recorder(odometry, truth)
    for frame in sequence:
        odometry.track(frame)
    found = recorder.errors()
    network, aligned = found["network"], found["aligned"]
    assert 0.1 < len(aligned.weights) / len(network.weights) < 1
    torch.testing.assert_close(aligned.weights, 10 * aligned.confidence)
    assert 0.001 < chi_of(network).robust_sigma < 0.5
    exact, window = Recorder(odometry, truth), odometry.window
    with torch.inference_mode():
        window.targets = truth.find(window)[0]
        odometry.patch_window.finalise(torch.arange(len(window.kk)))
    true = exact.errors()["network"]
    assert len(true.squared) > 0 and true.squared.max() < 1e-8 < network.squared.max()


def test_recordings_and_unknown_suites_are_refused(capsys):
    assert main(["--suites", "validation"]) == 2
    assert "--suites: kitti00_120 is a recording. Name suites of rendered sequences" in capsys.readouterr().err
    assert main(["--suites", "plain,absent"]) == 2
    assert "absent" in capsys.readouterr().err
