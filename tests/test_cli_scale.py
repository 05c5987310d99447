"""Metric scale on the command line: sources, settings, and what is printed and written."""

import json
import shutil

import cv2
import numpy as np
import pytest

import dvo
from dvo.cli import build_parser, main
from dvo.commands.report import describe_scale
from dvo.commands.scale import scale_settings


def parsed(*options):
    return build_parser().parse_args(["run", "clip", *options])


def test_options_become_the_setting_of_the_odometry():
    assert scale_settings(parsed()) == {}
    assert scale_settings(parsed("--height", "1.6")) == {"scale": {"height": 1.6}}
    assert scale_settings(parsed("--depth", "d")) == scale_settings(parsed("--depth")) == {"scale": {"depth": True}}
    assert scale_settings(parsed("--right", "r")) == scale_settings(parsed("--right")) == {"scale": {"stereo": True}}
    found = scale_settings(parsed("--distance", "0", "2", "1.5", "--distance", "1", "3", "2"))
    assert found == {"scale": {"distances": [[0.0, 2.0, 1.5], [1.0, 3.0, 2.0]]}}
    config = dvo.TrackerConfig(**found)
    assert config.scale.distances[1] == (1.0, 3.0, 2.0)


@pytest.mark.parametrize(
    "options",
    [
        ("--height", "1", "--depth", "d"),
        ("--right", "--depth"),
        ("--baseline", "0"),
        ("--height", "-1"),
        ("--distance", "0", "1"),
    ],
)
def test_options_that_exclude_each_other_or_are_no_lengths(options, capsys):
    with pytest.raises(SystemExit):
        parsed(*options)
    assert "dvo run: error" in capsys.readouterr().err


def test_the_source_of_the_scale_is_described():
    entry = {"segment": 0, "source": "depth", "factor": 1.0, "deviation": 0.0123, "observations": 50}
    text = describe_scale({"source": "depth", "unit": "metres", "segments": [entry]})
    assert text == "poses and map are in metres, from depth images (scale known to 1.2 %)"
    lost = {"segment": 1, "source": "none", "factor": None, "deviation": None, "observations": 0, "problem": "no plane"}
    both = describe_scale({"source": "height", "unit": "metres", "segments": [{**entry, "source": "height"}, lost]})
    assert both.endswith("the height of the camera (scale known to 1.2 %); but segment 1: no plane")
    none = describe_scale({"source": "height", "unit": "arbitrary", "segments": [lost]})
    assert none == "no metric scale from the height of the camera: segment 1: no plane"


@pytest.fixture
def clip(tmp_path):
    """Sequence in the layout of TUM RGB-D: a camera that moves along a wall at 2 m, 0.05 m a frame."""
    rng = np.random.default_rng(0)
    wall = cv2.resize(
        rng.integers(0, 255, (30, 90, 3), dtype=np.uint8), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC
    )
    folder = tmp_path / "seq"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rows, truth = [], []
    for k in range(16):
        stamp = f"{k / 10:.6f}"
        cv2.imwrite(str(folder / "rgb" / f"{stamp}.png"), wall[:, 4 * k : 4 * k + 160])
        cv2.imwrite(str(folder / "depth" / f"{stamp}.png"), np.full((120, 160), 10000, np.uint16))
        rows.append(f"{stamp} rgb/{stamp}.png")
        truth.append(f"{stamp} {0.05 * k} 0 0 0 0 0 1")
    (folder / "rgb.txt").write_text("\n".join(rows))
    (folder / "groundtruth.txt").write_text("\n".join(truth))
    (folder / "calib.txt").write_text("160 160 79.5 59.5")
    return folder


SETTINGS = ["--set", "pixels=19200", "--set", "estimate_readout=false", "--device", "cpu"]


@pytest.mark.long
def test_a_run_with_depth_is_in_metres(clip, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", str(clip), "--out", str(out), *SETTINGS, "--depth"]) == 0
    printed = capsys.readouterr().out
    assert "poses and map are in metres, from depth images" in printed and "after SE(3) alignment" in printed
    facts = json.loads((out / "run.json").read_text())
    assert facts["info"]["scale"]["source"] == "depth" and facts["metrics"]["alignment"] == "se3"
    moved = np.loadtxt(out / "trajectory.txt")[[0, -1], 1:4]
    assert np.linalg.norm(moved[1] - moved[0]) == pytest.approx(0.75, rel=0.02)
    assert (out / "cloud.ply").stat().st_size > 1000


@pytest.mark.long
def test_a_run_with_right_images_is_in_metres(clip, tmp_path, capsys):
    """The right camera 0.1 m beside the left one sees what that one sees two frames later."""
    names = sorted(file.name for file in (clip / "rgb").iterdir())
    (clip / "right").mkdir()
    for name, later in zip(names[:-2], names[2:], strict=True):
        shutil.copy(clip / "rgb" / later, clip / "right" / name)
    out = tmp_path / "out"
    options = ["--out", str(out), *SETTINGS, "--right", "right"]
    assert main(["run", str(clip), *options]) == 2
    assert "--baseline: is not known" in capsys.readouterr().err
    assert main(["run", str(clip), *options, "--baseline", "0.1"]) == 0
    printed = capsys.readouterr().out
    assert "poses and map are in metres, from stereo images" in printed and "after SE(3) alignment" in printed
    facts = json.loads((out / "run.json").read_text())
    assert facts["info"]["scale"]["source"] == "stereo" and facts["metrics"]["alignment"] == "se3"
    moved = np.loadtxt(out / "trajectory.txt")[[0, -1], 1:4]
    assert np.linalg.norm(moved[1] - moved[0]) == pytest.approx(0.75, rel=0.02)
    assert not (out / "cloud.ply").exists()


@pytest.mark.long
def test_a_run_with_a_distance_is_in_metres_and_one_that_is_not_covered_is_told(clip, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", str(clip), "--out", str(out), *SETTINGS, "--distance", "0.2", "1.2", "0.5"]) == 0
    rows = np.loadtxt(out / "trajectory.txt")
    assert np.linalg.norm(rows[12, 1:4] - rows[2, 1:4]) == pytest.approx(0.5, rel=1e-4)
    assert not (out / "cloud.ply").exists()
    capsys.readouterr()
    assert main(["run", str(clip), "--out", str(out), "--overwrite", *SETTINGS, "--distance", "5", "6", "1"]) == 0
    printed = capsys.readouterr().out
    assert "no metric scale from known distances" in printed and "after Sim(3) alignment" in printed


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (("--depth", "nothing"), "no such file or folder"),
        (("--depth-scale", "1000"), "no depth images"),
        (("--tsdf",), "no depth images"),
        (("--baseline", "0.1"), "no right images"),
        (("--right",), "no right images of its own"),
        (("--right", "nothing", "--baseline", "0.1"), "no such file or folder"),
        (("--weights", "nothing", "--height", "1"), "nothing"),
    ],
)
def test_bad_options_are_one_line(clip, tmp_path, capsys, options, match):
    assert main(["run", str(clip), "--out", str(tmp_path / "out"), *options]) == 2
    assert match in capsys.readouterr().err
