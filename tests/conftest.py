"""Fixtures that several rooms share."""

from __future__ import annotations

import gc
import os
import resource
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dvo  # decides how threads wait, before torch is imported

# isort: split
import cv2
import numpy as np
import pytest
import torch
from hypothesis import settings

from dvo.data.files.root import data_root as find_data_root
from dvo.data.trajectory import Trajectory, write_tum
from tests.support.command_line import without_plots
from tests.support.fake_odometry import FakeOdometry, curve


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Lift a limit of the size of files that a test has set, before pytest writes its result to a file of its own."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        return (yield)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


REPOSITORY = Path(__file__).resolve().parent.parent
CORE = ("geometry", "ba", "nets", "map", "data", "metrics", "eval/scoring")
"""Rooms whose tests are the marker ``core``, but for those that are slow or long."""
FOLDERS = tuple(f"{REPOSITORY / 'tests' / room}{os.sep}" for room in CORE)

# Python compiles what many processes of the tests import once, as it does numba's kernels.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Numba's messages of errors that it meets while it looks for types cost a twentieth of the time in colour.
os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Device of the tests with the marker ``gpu``."""
    parser.addoption("--device", default="", help="of the tests with the marker gpu: cpu, cuda, cuda:N")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With ``-m core`` alone, other rooms are not even imported."""
    path = f"{collection_path}{os.sep}"
    other = config.option.markexpr == "core" and not any(path.startswith(f) or f.startswith(path) for f in FOLDERS)
    return True if other else None


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Iterator[None]:
    """Mark the tests of the core rooms, before they are chosen by their markers."""
    for item in items:
        is_quick = not any(item.get_closest_marker(name) for name in ("slow", "long"))
        if is_quick and str(item.path).startswith(FOLDERS):
            item.add_marker(pytest.mark.core)
    yield
    gc.collect()
    gc.freeze()  # all that was imported: the collector need not go through it again and again


# The same examples on every run; no deadline, because machines are shared.
settings.register_profile("dvo", deadline=None, derandomize=True)
settings.load_profile("dvo")


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Bit equality needs a fixed number of threads; small tensors are faster with one."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real clips: ``$DVO_DATA``, else ``../shared/data``. Skips where there is none."""
    path = find_data_root(required=False)
    if not path.is_dir():
        pytest.skip(f"no real data at {path} (set DVO_DATA to the folder that holds it)")
    return path


@pytest.fixture
def fake_odometry() -> Callable[..., FakeOdometry]:
    """``fake_odometry(lost=..., at_frame=..., new_segment=...)`` on :func:`curve` (or ``motion=...``)."""
    return lambda motion=curve, **options: FakeOdometry(motion, **options)


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch, fake_odometry: Callable[..., FakeOdometry]) -> Callable[..., FakeOdometry]:
    """``given(**options)`` makes ``dvo.load`` return a fake odometry with these options, and returns it.

    Its ``asked`` holds the arguments of ``dvo.load``, and is empty before the call. Plots are drawn if ``plots``.
    """

    def use(plots: bool = False, **options: Any) -> FakeOdometry:
        odometry = fake_odometry(**options)
        if not plots:
            without_plots(monkeypatch)

        def load(weights: str, **asked: Any) -> FakeOdometry:
            odometry.asked = {"weights": weights, **asked}
            return odometry

        monkeypatch.setitem(vars(dvo), "load", load)
        return odometry

    return use


@pytest.fixture
def image_folder(tmp_path: Path) -> Path:
    """Twenty 64x48 images in ``clip/images``; beside it ``calib.txt``, ``times.txt``, ``truth.txt`` (on the curve)."""
    images = tmp_path / "clip" / "images"
    images.mkdir(parents=True)
    generator = np.random.default_rng(0)
    stamps = 10.0 + 0.1 * np.arange(20)
    for number in range(len(stamps)):
        cv2.imwrite(str(images / f"{number:04d}.png"), generator.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    (images.parent / "calib.txt").write_text("50 50 31.5 23.5\n")
    (images.parent / "times.txt").write_text("".join(f"{stamp:.6f}\n" for stamp in stamps))
    truth = np.array([curve(stamp) for stamp in stamps])
    truth[:, :3] *= 2.5  # a monocular estimate has its own scale
    write_tum(images.parent / "truth.txt", Trajectory(stamps, truth))
    return images
