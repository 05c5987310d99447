"""The signal-to-noise ratio of gradients."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from train.studies.snr import clip_gradients, compare, main, signal_to_noise, table
from train.tasks.patch_vo.variants import VARIANTS


def test_signal_and_noise_of_a_hand_computed_case():
    # mean (3, 4): signal 5; both samples are (0, 2) and (0, -2) away from it: noise 2
    assert signal_to_noise(np.array([[3.0, 6.0], [3.0, 2.0]])) == pytest.approx(2.5)
    assert signal_to_noise(np.ones((4, 3))) == float("inf")


@given(st.floats(0.01, 100.0), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_ratio_does_not_see_the_scale_of_the_loss(scale, seed):
    g = np.random.default_rng(seed).normal(1, 1, (12, 5))
    assert signal_to_noise(scale * g) == pytest.approx(signal_to_noise(g))


def test_the_comparison_finds_the_quieter_gradient():
    rng = np.random.default_rng(0)
    shared, noise = np.ones(8), rng.normal(0, 3, (60, 8))
    result = compare({"a": shared + noise, "b": shared + 0.3 * noise}, draws=100)
    assert result["b"].gain_low > 1 and result["b"].low < result["b"].snr < result["b"].high
    assert "raises" in table(result, 60)
    assert "lowers" in table(compare({"a": shared + 0.3 * noise, "b": shared + noise}, draws=100), 60)


def test_gradients_of_a_clip_differ_by_variant_and_leave_the_network_alone(runs):
    program = runs.module(initial=None)
    model = program.net
    found = clip_gradients(program.task, model, runs.batch(), seed=0)
    assert list(found) == list(VARIANTS)
    assert all(np.isfinite(g).all() and np.abs(g).max() > 0 and g.shape == (4 * 48,) for g in found.values())
    plain, weighted, *_ = found.values()
    assert not np.allclose(plain, weighted)
    assert all(p.grad is None for p in model.parameters())


@pytest.mark.long
def test_the_command_reads_a_training_state(tmp_path, runs, capsys):
    runs.fit(tmp_path, 1)
    main([str(tmp_path / "last.ckpt"), "--clips=2", "--frames=3", "--updates=2", "--patches=4", "--size", "48", "64"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in VARIANTS)
