"""The registry of readers, and readers of other packages."""

import dataclasses
import os
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.data import READERS, open_source
from dvo.data.readers.registry import find_reader, is_dataset, names_in_order

OWN = """
import numpy as np
from dvo.data import Calibration, ImageRecording, Reader, Sensors

def matches(path):
    return (path / "mine.json").is_file()

def open_mine(path, request):
    images = sorted((path / "shots").glob("*.png"))
    calibration = Calibration(50, 51, 31, 23)
    return ImageRecording("mine", path, images, np.arange(len(images)) / 20, calibration=calibration)

READER = Reader("mine", matches, open_mine)
"""


@pytest.fixture
def own(make, monkeypatch):
    """Folder that also has the layout of the plain sequence, and a module outside dvo that reads it."""
    make.images("clip/shots", [f"{i}.png" for i in range(4)])
    make.text("clip/mine.json", "{}")
    make.text("package_of_mine.py", OWN)
    monkeypatch.syspath_prepend(make.root)
    yield make.root / "clip"
    sys.modules.pop("package_of_mine", None)
    READERS.unregister("mine")


def test_order_of_matching():
    assert names_in_order() == [
        "rosbag",
        "video",
        "euroc",
        "kitti",
        "kitti_raw",
        "tartanair",
        "icl_nuim",
        "tum",
        "sequence",
        "folder",
    ]
    assert all(READERS.resolve(name).name == name for name in names_in_order())


def test_a_registered_reader_comes_before_those_that_take_anything(own):
    assert find_reader(own).name == "sequence"
    READERS.register("mine", "package_of_mine:READER")
    source = open_source(own)
    assert source.kind == "mine" and [frame.timestamp for frame in source] == [0, 0.05, 0.1, pytest.approx(0.15)]
    assert is_dataset(own) and find_reader(own / "shots").name == "folder"


def test_a_reader_announced_by_another_package(own, monkeypatch):
    announced = [EntryPoint("mine", "package_of_mine:READER", "dvo.readers")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: announced if group == "dvo.readers" else [])
    fresh = Registry("reader", "dvo.readers", {name: READERS.target(name) for name in READERS})
    monkeypatch.setattr("dvo.data.readers.registry.READERS", fresh)
    assert names_in_order()[0] == "mine" and open_source(own).kind == "mine"


def test_a_reader_by_name(make):
    folder = make.images("clip", ["0.png", "1.png"])
    make.text("clip/groundtruth_tum.txt", "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    assert open_source(folder, calib=make.calib(), fps=1, reader="folder").kind == "folder"
    with pytest.raises(DvoError, match="no reader 'tun'.*tum"):
        open_source(folder, calib=make.calib(), reader="tun")
    with pytest.raises(DvoError, match="not a KITTI sequence"):
        open_source(folder, calib=make.calib(), reader="kitti")


def test_evaluation_uses_the_same_readers(own):
    from eval.suites.selection import suite_of_folder
    from eval.suites.suite import open_sequence

    make_truth = own.parent / "truth.txt"
    make_truth.write_text("".join(f"{i / 20} {i} 0 0 0 0 0 1\n" for i in range(4)))
    READERS.register("mine", "package_of_mine:READER")
    suite = suite_of_folder(own)
    sequence = dataclasses.replace(suite.sequences[0], groundtruth=str(make_truth))
    source, truth = open_sequence(sequence, own, 1)
    assert source.kind == "mine" and len(truth) == 4


def test_a_named_pipe_is_read_as_standard_input(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DvoError, match=r"a pipe or a device, no file. Give images .*: - < .*pipe"):
        open_source(tmp_path / "pipe")


@pytest.mark.parametrize("file", ["tum.py", "depth.py", "source.py"])
def test_cached_predictions_depend_on_every_reader(monkeypatch, file):
    from eval.execution.versions import reader_digest

    before, read = reader_digest(), Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + b"#" * (path.name == file))
    assert reader_digest() != before
