"""Observers of ``dvo run``: a failure costs nothing of the run, and a run that cannot begin leaves their files."""

from __future__ import annotations

import pytest

from dvo.cli import main
from dvo.viz.overlay import OverlayVideo
from tests.support.command_line import arguments, summary


@pytest.mark.parametrize("method", ["begin", "update", "finish", "close"])
def test_a_failure_costs_nothing_of_the_run(method, given, image_folder, tmp_path, monkeypatch, capsys):
    given()

    def fail(*_):
        raise RuntimeError("out of order")

    monkeypatch.setattr(OverlayVideo, method, fail)
    out = tmp_path / "out"
    assert main(arguments(image_folder, out, "--overlay", str(tmp_path / "a.mp4"), "--export", "tum")) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if "out of order" in line]
    assert len(warnings) == 1 and "--overlay ended by RuntimeError" in warnings[0]
    assert summary(out)["finished"] and summary(out)["frames"]["tracked"] == 20
    told = [warning for warning in summary(out)["warnings"] if "out of order" in warning]
    assert len(told) == 1 and told[0] in warnings[0]
    assert (out / "export" / "tum").is_dir()


def test_a_run_that_cannot_begin_leaves_the_video_as_it_was(image_folder, tmp_path):
    old, new = tmp_path / "old.mp4", tmp_path / "new.mp4"
    old.write_bytes(b"of yesterday")
    for file in (old, new):
        command = arguments(image_folder, tmp_path / "out", "--overlay", str(file), "--weights", "none")
        assert main(command) == 2
    assert old.read_bytes() == b"of yesterday" and not new.exists() and not (tmp_path / "out").exists()
