"""A clip through a fisheye lens, from the files to the trajectory."""

import numpy as np
import pytest

import dvo
from dvo.cli import main
from tests.support.command_line import errors, summary
from tests.support.fisheye_clip import write_clips


@pytest.mark.slow
def test_a_fisheye_clip_is_tracked_as_its_pinhole_clip(tmp_path, capsys):
    folders = write_clips(tmp_path / "clips")
    images = [next(iter(dvo.open(folder, start="20f"))).image.astype(int) for folder in folders]
    assert np.abs(images[0] - images[1]).mean() < 4  # the same view, but for two interpolations
    for folder in folders:
        assert main(["run", str(folder), "--out", str(tmp_path / folder.name), "--device", "cpu"]) == 0
    fisheye, pinhole = (summary(tmp_path / folder.name) for folder in folders)
    assert fisheye["frames"]["tracked"] == pinhole["frames"]["tracked"] == 40
    assert pinhole["metrics"]["ate_percent"] < 0.6
    assert fisheye["metrics"]["ate_percent"] < 2 * pinhole["metrics"]["ate_percent"] + 0.2
    said = [line for line in errors(capsys.readouterr().err) if "fisheye" in line]
    assert len(said) == 1 and "98 x 81 degrees of 108 x 81 degrees" in said[0]
