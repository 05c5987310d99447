"""``dvo run --save-map``: the map is written at the end, and nothing else depends on it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

import dvo
from dvo.cli import main
from dvo.errors import DvoError
from tests.command_line import arguments, summary
from tests.conftest import FakeOdometry, curve


class SavingOdometry(FakeOdometry):
    """A fake that can be saved."""

    def save(self, file):
        if self.frames[-1].index == 7:
            raise DvoError("cannot be written (No space left on device)", file=file)
        Path(file).write_text(f"{len(self.frames)} frames")


@pytest.mark.parametrize("stopped", [None, signal.SIGINT, signal.SIGTERM])
def test_a_map_is_saved_at_the_end_and_after_an_interruption(stopped, monkeypatch, image_folder, tmp_path):
    at_frame = {} if stopped is None else {8: lambda: os.kill(os.getpid(), stopped)}
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: SavingOdometry(curve, at_frame=at_frame))
    file = tmp_path / "maps" / "a.dvo"
    code = main(arguments(image_folder, tmp_path / "out", "--save-map", str(file)))
    assert code == {None: 0, signal.SIGINT: 130, signal.SIGTERM: 143}[stopped]
    assert file.read_text() == ("20 frames" if stopped is None else "9 frames")
    written = summary(tmp_path / "out")
    assert written["map_file"] == str(file.resolve()) and written["finished"] is True


def test_a_map_that_cannot_be_saved_costs_no_other_result(monkeypatch, image_folder, tmp_path, capsys):
    at_frame = {7: lambda: os.kill(os.getpid(), signal.SIGTERM)}
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: SavingOdometry(curve, at_frame=at_frame))
    file = tmp_path / "a.dvo"
    assert main(arguments(image_folder, tmp_path / "out", "--save-map", str(file))) == 2
    written = summary(tmp_path / "out")
    assert written["map_file"] is None and written["finished"] is False and written["frames"]["tracked"] == 8
    assert "No space left" in capsys.readouterr().err and (tmp_path / "out" / "trajectory.txt").exists()


def test_a_place_for_the_map_is_checked_before_tracking(given, monkeypatch, image_folder, tmp_path, capsys):
    odometry = given()
    assert main(arguments(image_folder, tmp_path / "out", "--save-map", str(tmp_path / "a.dvo"))) == 2
    assert "no map that can be saved" in capsys.readouterr().err and not odometry.frames
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: SavingOdometry(curve))
    for place in (tmp_path, image_folder.parent / "calib.txt" / "a.dvo"):
        assert main(arguments(image_folder, tmp_path / "out", "--save-map", str(place))) == 2
        assert "--save-map" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
