"""The program: training, measurement, report."""

from dataclasses import replace

import pytest
import yaml

from dvo.core.errors import DvoError
from train.studies.family import study, training
from train.studies.family.config import FamilyConfig
from train.studies.family.records import Records
from train.studies.family.study import main, rehearsal, render_clips
from train.studies.family.training import training_clips


@pytest.fixture
def file(family, tmp_path):
    config = family()
    phases = [{"share": 0.5, "rate": 1e-3}, {"share": 0.5, "rate": 1e-3, "settings": {"both_ways": True}}]
    member = {"task": "deepvo", "batch": 2, "steps": 2, "phases": phases}
    form = {"count": 2, "families": ["planes"], "frames": 8, "size": [48, 64], "gaps": [1, 2]}
    content = {
        "folder": config.folder, "out": config.out, "seeds": [0], "frames": 3, "size": [48, 64], "clips": 3,
        "points": 1, "curve_sequences": 0, "held_out": form,
        "members": {"first": member, "second": {"task": "absent", "phases": phases}},
    }  # fmt: skip
    path = tmp_path / "family.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.slow
def test_a_study_runs_once_and_reports_again(file, monkeypatch, capsys):
    monkeypatch.setattr(study, "apart", lambda function, *arguments: function(*arguments))
    with pytest.raises(DvoError, match=r"family.yaml: members: second: task: no task 'absent'"):
        main(["--config", str(file)])
    main(["--config", str(file), "--members", "first"])
    page, picture = map(str.strip, capsys.readouterr().out.splitlines()[-2:])
    records = Records(FamilyConfig.read(file))
    rows = [(row["member"], row["sequence"]) for row in records.sequences.rows()]
    names = list(records.config.held_out.sequences())
    assert rows == [(member, name) for member in ("null", "first") for name in names]
    assert len(records.pairs.rows()) == 8 and training_clips(records.config).missing() == []
    with open(page, encoding="utf-8") as stream:
        text = stream.read()
    assert "| first | " in text and "| null | " in text
    # again: nothing is trained or measured; a sequence that is missing is measured with the weights that are there
    tables = {table.file: table.file.read_text() for table in records.tables if table.file.is_file()}
    monkeypatch.setattr(training, "fit", None)
    main(["--config", str(file), "--members", "first"])
    main(["--config", str(file), "--report"])
    assert {table: table.read_text() for table in tables} == tables
    with open(page, encoding="utf-8") as stream:
        assert stream.read() == text
    kept = records.sequences.file.read_text().splitlines(keepends=True)
    records.sequences.file.write_text("".join(kept[:-1]))
    main(["--config", str(file), "--members", "first"])
    assert len(records.sequences.file.read_text().splitlines()) == len(kept)


def test_bad_arguments_are_named(file):
    cases = {
        "no member 'third'": ["--members", "third"],
        "--rehearse": ["--rehearse", "0"],
        "no complete": ["--report"],
    }
    for message, arguments in cases.items():
        with pytest.raises(DvoError, match=message):
            main(["--config", str(file), *arguments])


def test_a_rehearsal_is_short_and_elsewhere(family):
    config = family(seeds=(3, 4), clips=500)
    short = rehearsal(config, 20.0)
    assert short.minutes == pytest.approx(1 / 3) and short.seeds == (3,) and len(short.held_out.sequences()) == 1
    assert short.folder != config.folder and short.out.startswith(short.folder) and short.clips < config.clips
    assert short.members == config.members and replace(short, minutes=config.minutes) != config


def test_clips_are_rendered_before_training(family, tmp_path):
    config = family(folder=str(tmp_path / "empty"), clips=2)
    assert training_clips(config).missing() == [0, 1]
    render_clips(config)
    assert training_clips(config).missing() == []
