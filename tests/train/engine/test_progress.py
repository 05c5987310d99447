"""Progress is told in steps."""

import sys

import pytest

from train.engine.progress import StepBar


@pytest.mark.long
def test_lines_count_from_the_state(tmp_path, runs, capsys):
    runs.fit(tmp_path, 1)
    capsys.readouterr()
    runs.fit(tmp_path, 4, runs.module(), tmp_path / "last.ckpt", callbacks=[StepBar()], enable_progress_bar=True,
             log_every_n_steps=2)  # fmt: skip
    lines = capsys.readouterr().out.strip().splitlines()
    lines = [line for line in lines if line.startswith("step")]
    assert [line.split("  ")[0] for line in lines] == ["step 1 + 2 of 3", "step 1 + 3 of 3"]
    assert all("loss" in line for line in lines)


def test_a_bar_on_a_terminal(tmp_path, runs, capsys, monkeypatch):
    runs.fit(tmp_path, 1)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    runs.fit(tmp_path, 3, runs.module(), tmp_path / "last.ckpt", callbacks=[StepBar()], enable_progress_bar=True)
    shown = capsys.readouterr().err
    assert "step 1 + 2 of 2" in shown and "Epoch" not in shown
