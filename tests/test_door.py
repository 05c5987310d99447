"""The public names of the package."""

import doctest
import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import dvo

EXPECTED = [
    "Frame",
    "Camera",
    "Trajectory",
    "Estimate",
    "Result",
    "Odometry",
    "Status",
    "SparseMap",
    "ModelConfig",
    "TrackerConfig",
    "BAOptions",
    "BADamping",
    "BAResult",
    "bundle_adjust",
    "evaluate",
    "Metrics",
    "run",
    "se3",
    "losses",
    "ClipDataset",
    "load",
    "load_model",
    "open",
    "open_stream",
    "stream",
    "LiveFrames",
    "DvoError",
]


def test_names_resolve_and_are_announced():
    assert set(EXPECTED) <= set(dvo.__all__) <= set(dir(dvo))
    for name in dvo.__all__:
        assert getattr(dvo, name) is not None, name
        assert getattr(dvo, name).__doc__ or name == "__version__", name


def test_importing_the_package_imports_nothing_heavy():
    done = subprocess.run(
        [sys.executable, "-c", "import sys, dvo; print([m for m in ('torch', 'numpy', 'cv2') if m in sys.modules])"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == "[]"


def test_types_are_announced():
    assert (Path(dvo.__file__).parent / "py.typed").is_file()


@pytest.mark.parametrize(
    "name",
    [
        "Camera", "ClipDataset", "DvoError", "Estimate", "Frame", "LiveFrames", "Odometry", "Result", "TrackerConfig",
        "Trajectory", "base_trajectory", "bundle_adjust", "evaluate", "load_model", "stream",
    ],
)  # fmt: skip
def test_example_runs_by_itself(name):
    """With dvo, NumPy and torch imported, and no recording: as a reader would paste it."""
    names = {"dvo": dvo, "np": np, "torch": torch}
    example = doctest.DocTestParser().get_doctest(inspect.getdoc(getattr(dvo, name)), names, name, None, None)
    said: list[str] = []
    failed, tried = doctest.DocTestRunner().run(example, out=said.append)
    assert tried and not failed, "".join(said)
