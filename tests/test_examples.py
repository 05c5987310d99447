"""The scripts of ``examples/`` run as they are, on few frames or steps."""

import ast
import dataclasses
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import dvo

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"


def run(*arguments, cwd):
    """Output of ``python ARGUMENTS``, which must succeed."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, env={**os.environ, "PYTHONPATH": path}, capture_output=True,
        text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_example_is_run_here():
    text = Path(__file__).read_text(encoding="utf-8")
    assert all(f'"{script.name}' in text for script in EXAMPLES.glob("*.py"))


@pytest.mark.long
def test_quick_start(tmp_path):
    out = run(EXAMPLES / "quick_start.py", "--frames", "16", "--out", "plot.png", cwd=tmp_path)
    assert "16 of 16 frames" in out and re.search(r"ATE \d", out)
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_track_arrays(tmp_path):
    assert "14 of 14 frames" in run(EXAMPLES / "track_arrays.py", "--frames", "14", cwd=tmp_path)


@pytest.mark.slow
def test_webcam(tmp_path, image_folder):
    """On recorded images: the program has no camera here."""
    calib = image_folder.parent / "calib.txt"
    out = run(EXAMPLES / "webcam.py", image_folder, "--calib", calib, cwd=tmp_path)
    assert len(re.findall(r"^ *\d+\.\d{3} s  (?:initialising|tracking|lost)", out, re.MULTILINE)) == 20
    assert re.search(r"^\d+ of 20 frames tracked", out, re.MULTILINE)


@pytest.mark.parametrize("name", ["webcam.py", "dvo_ros/dvo_ros/node.py", "dvo_ros/dvo_ros/base_motion.py"])
def test_live_examples_use_names_that_are_there(name):
    """Where there is no ROS: the names of dvo and of its frames and estimates exist."""
    tree = ast.parse((EXAMPLES / name).read_text(encoding="utf-8"))
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    public = {node.attr for node in used if node.value.id == "dvo"}
    assert "Estimate" in public or "Frame" in public
    assert public <= set(dvo.__all__)
    fields = {field.name for field in dataclasses.fields(dvo.Estimate)}
    assert {node.attr for node in used if node.value.id == "estimate"} <= fields
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        if ast.unparse(call.func) in ("dvo.Frame", "dvo.Camera"):
            inspect.signature(getattr(dvo, call.func.attr)).bind(*call.args, **{k.arg: k for k in call.keywords})


@pytest.mark.slow
def test_fine_tune(tmp_path):
    out = run(EXAMPLES / "fine_tune.py", "--steps", "2", "--out", "tuned.safetensors", cwd=tmp_path)
    assert "gives dvo-tuned" in out and len(re.findall(r"^step \d: loss \d", out, re.MULTILINE)) == 2


@pytest.mark.long
def test_bundle_adjustment_in_training(tmp_path):
    out = run(EXAMPLES / "bundle_adjustment_in_training.py", cwd=tmp_path)
    first, last = map(float, re.findall(r"third ([\d.]+)", out))
    assert last < 0.6 * first


@pytest.mark.long
def test_train_inertial(tmp_path):
    out = run(EXAMPLES / "train_inertial.py", cwd=tmp_path)
    first, last = map(float, re.findall(r"third ([\d.]+)", out))
    assert last < 0.7 * first


@pytest.mark.long
def test_own_odometry_alone(tmp_path):
    assert "ATE" in run(EXAMPLES / "own_odometry.py", cwd=tmp_path)


@pytest.mark.slow
def test_own_odometry_in_the_evaluation(tmp_path):
    pytest.importorskip("evo")
    rendered = {"seed": 3, "frames": 8, "height": 48, "width": 64, "fps": 10.0, "version": 3}
    suite = {"name": "short", "label": "a short clip", "sequences": [{"name": "short", "rendered": rendered}]}
    (tmp_path / "short.yaml").write_text(yaml.safe_dump(suite))
    system = f"{EXAMPLES / 'own_odometry.py'}:PhaseOdometry"
    run("-m", "eval", "run", "--suite", tmp_path / "short.yaml", "--systems", f"{system},null", "--seeds", "1",
        "--out", tmp_path / "out", "--threads", "1", cwd=ROOT)  # fmt: skip
    assert "PhaseOdometry" in (tmp_path / "out" / "results.csv").read_text()
