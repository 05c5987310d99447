"""The study: paired arms, resumed runs, report."""

import json
from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from train.studies import study
from train.studies.config import StudyConfig
from train.studies.report import table, write_report


def small_study(folder, **changes):
    options = {
        "folder": str(folder), "out": str(folder / "report"), "frames": 4, "size": (48, 64), "updates": 3,
        "start_steps": 1, "steps": 2, "rates": (1e-3,), "seeds": (0,), "clips": 2, "validate_every": 1,
        "validation_clips": 1,
    }  # fmt: skip
    return StudyConfig(**(options | changes))


@pytest.mark.slow
def test_a_study_runs_resumes_and_reports(tmp_path, monkeypatch):
    config = small_study(tmp_path)
    names = list(config.arms)
    results = [study.run_arm(arm, 1e-3, 0, config) for arm in names]
    assert [row["step"] for row in results[0]["curve"]] == [0, 1, 2]
    assert results[0]["curve"][0] == results[1]["curve"][0] == results[2]["curve"][0]  # the same start
    assert results[0]["curve"][-1] != results[1]["curve"][-1]
    # a run that is done is read; one that stopped half way ends where it would have ended
    monkeypatch.setattr(study, "fit", None)
    assert study.run_arm(names[0], 1e-3, 0, config) == results[0]
    monkeypatch.undo()
    run = next(p for p in tmp_path.glob("V2V_weighting_rate*"))
    (run / "result.json").unlink()
    (run / "last.ckpt").unlink()
    real, stopped = study.fit, []

    def stops_early(folder, program, clips, steps, callbacks, save_every):
        stopped.append(folder)
        real(folder, program, clips, steps - 1, callbacks, save_every)
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "fit", stops_early)
    with pytest.raises(KeyboardInterrupt):
        study.run_arm(names[1], 1e-3, 0, config)
    monkeypatch.undo()
    again = study.run_arm(names[1], 1e-3, 0, config)
    assert again["curve"] == results[1]["curve"]
    report, picture = write_report(results, config)
    assert all(name in report.read_text() for name in names) and picture.stat().st_size > 10_000
    assert json.loads((run / "result.json").read_text())["arm"] == names[1]


@pytest.mark.slow
def test_arms_start_from_a_state_with_settings_and_clips_of_their_own(tmp_path):
    arms = {"all": {}, "random": {}, "still": {}}
    changes = {
        "state": str(tmp_path / "start.ckpt"), "arms": arms, "steps": 1,
        "settings": {"selection": "structure", "warmup_until": 0.0},
        "arm_settings": {"random": {"selection": "random"}}, "clip_options": {"movers": 1.0},
        "arm_clips": {"still": {"movers": 0.0}},
    }  # fmt: skip
    config = small_study(tmp_path / "study", **changes)
    common = {"model": config.model, "seed": 5, "updates": config.updates}
    program = study.task_program(config.task, common, **config.settings)
    study.fit(
        tmp_path, program, study.StudyClips(study.DiskClips(tmp_path, 0, 1, config, config.clip_options)), 1, [], 1
    )
    (tmp_path / "last.ckpt").rename(config.state)
    curves = [study.run_arm(arm, 1e-3, 0, config)["curve"] for arm in arms]
    assert curves[0][0] == curves[1][0] == curves[2][0]  # judged with the same settings on the same clips
    assert curves[0][1] != curves[1][1] and curves[0][1] != curves[2][1]
    trained = {folder.name for folder in (tmp_path / "study" / "clips").iterdir()}
    assert sum("movers-0" in name for name in trained) == 1 and len(trained) == 3
    with pytest.raises(DvoError, match="state"):
        study.run_arm("all", 1e-3, 0, small_study(tmp_path / "other", **changes | {"model": "small"}))
    with pytest.raises(DvoError, match="no such arm"):
        small_study(tmp_path, arm_clips={"absent": {}})


def test_a_study_with_unknown_settings_is_refused(tmp_path):
    file = tmp_path / "study.yaml"
    file.write_text("stpes: 3")
    with pytest.raises(DvoError, match="stpes"):
        StudyConfig.read(file)
    file.write_text("{steps: 3, size: [48, 64]}")
    assert StudyConfig.read(file).size == (48, 64)


def test_the_table_compares_by_the_measures_of_the_configuration(tmp_path):
    config = small_study(tmp_path, arms={"A": {}, "B": {}}, measures={"turn": "turn error (deg)"})
    results = [
        {
            "arm": arm,
            "rate": 1e-3,
            "seed": 0,
            "skipped": 0,
            "curve": [{"step": s, "turn": e} for s, e in enumerate(errors)],
        }
        for arm, errors in (("A", (4.0, 2.0)), ("B", (2.0, 1.0)))
    ]
    head, rule, first, second = table(results, config).splitlines()
    assert len({row.count("|") for row in (head, rule, first, second)}) == 1
    assert "turn error after the last step" in head and "| 2.0000 [2.0000-2.0000] |" in first
    assert "+50.0 [+50.0, +50.0] | 0 |" in second


def test_ratios_are_medians_and_other_measures_means(tmp_path, monkeypatch):
    measured = iter([{"a": 1.0, "b_ratio": 1.0}, {"a": 2.0, "b_ratio": 2.0}, {"a": 6.0, "b_ratio": 9.0}])

    class Measures:
        def measure(self, net, batch, seed):
            return next(measured)

    clips = study.DiskClips(tmp_path, 0, 3, small_study(tmp_path))
    monkeypatch.setattr(study.DiskClips, "__getitem__", lambda self, index: {"images": np.zeros(1)})
    assert study.validation_error(Measures(), None, clips) == {"a": 3.0, "b_ratio": 2.0}


@pytest.mark.parametrize(
    ("text", "message"),
    [("steps: many", "steps: must be a whole number, got 'many'"), ("steps: 0", "steps: out of range"),
     ("size: 96", "size: must be a list"), ("size: [96]", "size: must be a list of 2"), ("- steps", "got a list"),
     ("rates: [1.0, x]", r"rates\[1\]: must be a number"), ("seeds: [yes]", r"seeds\[0\]: must be a whole number"),
     ("arms: [DPVO]", "arms: must be a table"), ("arms: {DPVO: 3}", "arms: DPVO: must be a table"),
     ("title: 2024-13-45", "not a date"), ("steps: [", "not valid YAML"), ("a: &a [*a]", "within its own anchor")],
)  # fmt: skip
def test_settings_of_a_wrong_type(text, message, tmp_path):
    file = tmp_path / "study.yaml"
    file.write_text(text)
    with pytest.raises(DvoError, match=message) as error:
        StudyConfig.read(file)
    assert str(error.value).startswith(f"{file}: ")


def test_the_study_of_the_checkout_can_be_read():
    config = StudyConfig.read(Path(__file__).resolve().parents[3] / "configs" / "train" / "study.yaml")
    assert config.rates == (4e-4, 2e-3) and list(config.arms) == ["DPVO", "V2V weighting", "V2V weighting + balance"]


def test_the_report_tells_clips_of_an_arm_and_has_short_lines(tmp_path):
    config = small_study(
        tmp_path, arms={"A": {}, "B": {}}, arm_clips={"B": {"movers": 0.0}}, about="word " * 60,
        measures={"turn": "turn"}, out=str(tmp_path / "report"),
    )  # fmt: skip
    curve = [{"step": 0, "turn": 2.0}, {"step": 1, "turn": 1.0}]
    results = [
        {"arm": arm, "rate": 1e-3, "seed": 0, "skipped": 0, "curve": curve, "seconds_a_step": 1.0} for arm in "AB"
    ]
    page, _ = write_report(results, config)
    text = page.read_text(encoding="utf-8")
    assert "random numbers;\nthe clips of `B` have `movers: 0.0`. Errors" in text
    assert max(len(line) for line in text.splitlines() if not line.startswith("|")) <= 128
