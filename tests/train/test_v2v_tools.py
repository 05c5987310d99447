"""The signal-to-noise tool, the study and the breakdown of a step."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.errors import DvoError
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import training_schedule
from dvo.nets.config import preset
from train.studies import breakdown, study
from train.studies.snr import DPVO, V2V, VARIANTS, clip_gradients, compare, signal_to_noise, table


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
    result = compare({DPVO: shared + noise, V2V: shared + 0.3 * noise}, draws=100)
    assert result[V2V].gain_low > 1 and result[V2V].low < result[V2V].snr < result[V2V].high
    assert "raises" in table(result, 60)
    assert "lowers" in table(compare({DPVO: shared + 0.3 * noise, V2V: shared + noise}, draws=100), 60)


def test_gradients_of_a_clip_differ_by_variant_and_leave_the_network_alone(runs):
    torch.manual_seed(0)
    model = PatchVO(preset("tiny"))
    stages = training_schedule(4, model.config.training_patches, 3, self_edges=False)
    found = clip_gradients(model, runs.batch(), stages, seed=0)
    assert set(found) == set(VARIANTS)
    assert all(np.isfinite(g).all() and np.abs(g).max() > 0 and g.shape == (4 * 48,) for g in found.values())
    assert not np.allclose(found[DPVO], found[V2V])
    assert all(p.grad is None for p in model.parameters())


def small_study(folder, **changes):
    options = {
        "folder": str(folder), "out": str(folder / "report"), "frames": 4, "size": (48, 64), "updates": 3,
        "start_steps": 1, "steps": 2, "rates": (1e-3,), "seeds": (0,), "clips": 2, "validate_every": 1,
        "validation_clips": 1,
    }  # fmt: skip
    return study.StudyConfig(**(options | changes))


@pytest.mark.slow
def test_a_study_runs_resumes_and_reports(tmp_path, monkeypatch):
    config = small_study(tmp_path)
    names = list(config.arms)
    results = [study.run_arm(arm, 1e-3, 0, config) for arm in names]
    assert [row["step"] for row in results[0]["curve"]] == [0, 1, 2]
    assert results[0]["curve"][0] == results[1]["curve"][0] == results[2]["curve"][0]  # the same start
    assert results[0]["curve"][-1] != results[1]["curve"][-1]
    # a run that is done is read; one that stopped half way ends where it would have ended
    monkeypatch.setattr(study, "_train", None)
    assert study.run_arm(names[0], 1e-3, 0, config) == results[0]
    monkeypatch.undo()
    run = next(p for p in tmp_path.glob("V2V_weighting_rate*"))
    (run / "result.json").unlink()
    (run / "last.ckpt").unlink()
    real, stopped = study._train, []

    def stops_early(folder, program, clips, steps, callbacks, save_every):
        stopped.append(folder)
        real(folder, program, clips, steps - 1, callbacks, save_every)
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "_train", stops_early)
    with pytest.raises(KeyboardInterrupt):
        study.run_arm(names[1], 1e-3, 0, config)
    monkeypatch.undo()
    again = study.run_arm(names[1], 1e-3, 0, config)
    assert again["curve"] == results[1]["curve"]
    from train.studies.report import write_report

    report, picture = write_report(results, config)
    assert all(name in report.read_text() for name in names) and picture.stat().st_size > 10_000
    assert json.loads((run / "result.json").read_text())["arm"] == names[1]


def test_a_study_with_unknown_settings_is_refused(tmp_path):
    file = tmp_path / "study.yaml"
    file.write_text("stpes: 3")
    with pytest.raises(DvoError, match="stpes"):
        study.StudyConfig.read(file)
    file.write_text("{steps: 3, size: [48, 64]}")
    assert study.StudyConfig.read(file).size == (48, 64)


def test_the_breakdown_names_where_the_time_goes(runs):
    seconds = breakdown.measure(runs.module(), runs.data().clips(), 1, steps=1, warm=0)
    parts = [name for name, _, _ in (*breakdown.FORWARD, *breakdown.LOSS, *breakdown.BACKWARD)]
    assert all(seconds[name] > 0 for name in parts)
    assert seconds["forward and loss"] + seconds["backward"] <= seconds["step"]
    inner = sum(seconds[name] for name, _, _ in (*breakdown.FORWARD, *breakdown.LOSS))
    assert inner <= seconds["forward and loss"]
    assert "bundle adjustment, backward" in breakdown.table(seconds)
