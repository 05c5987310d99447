"""``dvo run --save-map``: the map is written at the end, and nothing else depends on it; ``dvo run --map``."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import dvo
from dvo.cli import main
from dvo.core.errors import DvoError
from tests.support.command_line import arguments, summary
from tests.support.fake_odometry import FakeOdometry, curve


class SavingOdometry(FakeOdometry):
    """A fake that can be saved."""

    def save(self, file):
        if self.frames[-1].index == 7:
            raise DvoError("cannot be written (No space left on device)", file=file)
        Path(file).write_text(f"{len(self.frames)} frames")


@pytest.mark.long
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


LOCALISED = {"from": 10.4, "to": 3.0, "inliers": 0.614, "edges": 432}


class LocalisedOdometry(SavingOdometry):
    """A fake of a new recording in a map."""

    localised: dict | None = LOCALISED

    def finish(self):
        done = super().finish()
        return replace(done, info={**done.info, "localised": self.localised})


@pytest.fixture
def in_map(monkeypatch):
    """A fake that ``dvo.load_map`` returns; its ``asked`` holds the arguments."""
    odometry = LocalisedOdometry(curve)

    def load_map(file, **asked):
        odometry.asked = {"file": file, **asked}
        return odometry

    monkeypatch.setitem(vars(dvo), "load_map", load_map)
    return odometry


def test_a_new_recording_in_a_map(in_map, image_folder, tmp_path, capsys):
    both = str(tmp_path / "both.dvo")
    more = ("--map", "old.dvo", "--seed", "3", "--set", "updates=2", "--save-map", both)
    assert main(arguments(image_folder, tmp_path / "out", *more)) == 0
    assert in_map.asked == {"file": "old.dvo", "device": torch.device("cpu"), "weights": None,
                            "seed": 3, "updates": 2}  # fmt: skip
    line = "localised at 10.40 s (61 % of 432 measurements are inliers) in the world of the map"
    assert line in capsys.readouterr().out.splitlines() and Path(both).read_text() == "20 frames"
    written = summary(tmp_path / "out")
    assert written["map"] == "old.dvo" and written["info"]["localised"] == LOCALISED
    assert written["segments"][0]["in_map"] is False
    assert main(arguments(image_folder, tmp_path / "two", "--map", "old.dvo", "--weights", "w.safetensors")) == 0
    assert in_map.asked["weights"] == "w.safetensors"


def test_a_recording_that_is_not_recognised(in_map, image_folder, tmp_path, capsys):
    in_map.localised = None
    assert main(arguments(image_folder, tmp_path / "out", "--map", "old.dvo")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "not recognised in the map: the poses have a world and a scale of their own" in lines
    assert summary(tmp_path / "out")["info"]["localised"] is None


def test_no_map_and_wrong_settings_for_it(image_folder, tmp_path, capsys):
    for more, match in ((("--map", "none.dvo"), "no such file"),
                        (("--map", "a.dvo", "--set", "new_recording=1"), "not a setting")):  # fmt: skip
        assert main(arguments(image_folder, tmp_path / "out", *more)) == 2
        assert match in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_pure_odometry_on_request(monkeypatch, image_folder, tmp_path):
    """``--no-loops`` is the setting ``loops=False``; without it the setting is left to the weights."""
    asked = []
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: asked.append(options) or FakeOdometry(curve))
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    assert main(arguments(image_folder, tmp_path / "two", "--no-loops")) == 0
    assert "loops" not in asked[0] and asked[1]["loops"] is False


def test_no_map_means_none(given, image_folder, tmp_path, capsys):
    given()
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    assert summary(tmp_path / "out")["map"] is None and "the map" not in capsys.readouterr().out
