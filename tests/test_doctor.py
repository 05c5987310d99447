"""``dvo doctor`` on this installation, and on broken ones."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import tomllib

import cv2
import pytest
import torch

from dvo.cli import main
from dvo.commands import doctor, probes
from dvo.models import weights as weights_files

TITLES = ["versions", "devices", "threads", "video and images", "weights", "folders", "optional packages",
          "registered by packages", "problems"]  # fmt: skip


def test_json_tells_the_state_of_this_installation(capsys):
    assert main(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report) == TITLES
    assert report["versions"]["opencv-python-headless"].split(".")[0] == cv2.__version__.split(".")[0]
    assert report["devices"]["cpu"].endswith("float64 works") and "auto" in report["devices"]
    assert report["threads"]["torch"].startswith(f"{torch.get_num_threads()}, chosen by ")
    assert "reads" in report["video and images"].values()
    assert ".png .jpg" in report["video and images"]["images"]
    assert report["weights"]["small"].startswith("loads, 462,692 parameters; sha256 ")
    assert "FAILED" not in json.dumps(report).upper()


def test_text_is_aligned(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "diagnose", lambda: ({"one": {"a": "1", "long": "2"}}, ["all wrong. Mend it"]))
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out == "one\n  a     1\n  long  2\n\nproblems:\n  - all wrong. Mend it\n"


def test_a_section_that_fails_becomes_a_line(monkeypatch):
    def fail(problems: list[str]) -> None:
        raise RuntimeError("no such\ndriver")

    monkeypatch.setattr(doctor, "devices", fail)
    report, problems = doctor.diagnose()
    assert report["devices"] == {"failed": "no such driver"} and list(report) == TITLES[:-1]
    assert "devices could not be examined: no such driver" in problems


def test_missing_and_doubled_packages(monkeypatch):
    monkeypatch.setattr(doctor, "REQUIRED", (("numpy", "numpy"), ("gone", "gone_module")))
    monkeypatch.setattr(doctor, "version_of", lambda name: "1.0")
    problems: list[str] = []
    found = doctor.versions(problems)
    assert found["numpy"] == "1.0" and found["gone"].startswith("cannot be imported: No module named")
    assert "pip install --force-reinstall gone" in problems[0] and "opencv-python and" in problems[1]


def test_optional_packages_come_with_their_command(monkeypatch):
    monkeypatch.setattr(doctor, "OPTIONAL", (("numpy", "numpy", "numbers", ""), ("a-b", "a_b", "letters", ""),
                                             ("c", "c_", "more", "pip install --no-deps c")))  # fmt: skip
    found = doctor.optional_packages([])
    assert found["numpy"].startswith("numbers: 2") or found["numpy"].startswith("numbers: 1")
    assert found["a-b"] == "letters: missing, pip install a-b"
    assert found["c"] == "more: missing, pip install --no-deps c"


def test_broken_weights(tmp_path, monkeypatch):
    whole = (weights_files.FOLDER / "small.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "whole.safetensors").write_bytes(whole)
    monkeypatch.setattr(weights_files, "FOLDER", tmp_path)
    problems: list[str] = []
    found = doctor.weights(problems)
    assert found["cut"].startswith("does not load: ") and found["whole"].startswith("loads, 462,692")
    assert len(problems) == 1 and "cut.safetensors do not load" in problems[0]
    monkeypatch.setattr(weights_files, "FOLDER", tmp_path / "none")
    assert doctor.weights(problems) == {} and "no weights" in problems[-1]


@pytest.mark.parametrize(("content", "expected"), [(b"right", "as installed"), (b"wrong", "differs")])
def test_checksum_of_the_installation(tmp_path, monkeypatch, content, expected):
    file = tmp_path / "dvo" / "weights" / "own.safetensors"
    file.parent.mkdir(parents=True)
    digest = base64.urlsafe_b64encode(hashlib.sha256(b"right").digest()).decode().rstrip("=")
    info = tmp_path / "dvo-9.9.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dvo\nVersion: 9.9\n")
    (info / "RECORD").write_text(f"dvo/weights/own.safetensors,sha256={digest},5\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert probes.checksum_state(file, content) == expected
    assert probes.checksum_state(tmp_path / "own.safetensors", content) == "no checksum recorded"


def test_folders_that_are_not_there(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DVO_DATA", str(tmp_path / "nowhere"))
    monkeypatch.setenv("DVO_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path))
    problems: list[str] = []
    found = doctor.folders(problems)
    assert found["data ($DVO_DATA)"] == "~/nowhere: not there"
    assert "not writable" in found["cache ($DVO_CACHE)"]
    assert "DVO_DATA" in problems[0] and "DVO_CACHE" in problems[1]
    monkeypatch.setenv("DVO_DATA", str(tmp_path))
    monkeypatch.setenv("DVO_CACHE", str(tmp_path / "new" / "cache"))
    assert doctor.folders(problems)["data ($DVO_DATA)"] == "~: 1 entry" and len(problems) == 2


def test_devices_that_do_not_work():
    problems: list[str] = []
    assert probes.arithmetic_state("meta", problems).startswith("does not work: ")
    assert "device meta does not work" in problems[0] and "--device cpu" in problems[0]


def test_opencv_without_ffmpeg(monkeypatch):
    monkeypatch.setattr(cv2.videoio_registry, "hasBackend", lambda code: False)
    monkeypatch.setattr(doctor, "video_state", lambda code, suffix: "reads")
    problems: list[str] = []
    found = doctor.codecs(problems)
    assert found["backends"] == "none" and found["FFmpeg in OpenCV"] == "missing"
    assert len(problems) == 1 and "no FFmpeg" in problems[0]


def test_formats():
    assert probes.video_state("MJPG", ".avi") == "reads"
    assert probes.video_state("????", ".nothing").startswith("not tested")
    assert probes.image_works(".png") and not probes.image_works(".nothing")


def test_every_package_of_an_extra_is_listed(repository):

    from dvo.commands.doctor import OPTIONAL, REQUIRED

    extras = tomllib.loads((repository / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = {
        re.match(r"[A-Za-z0-9._-]+", text).group().lower()
        for extra, packages in extras.items()
        if extra != "dev"
        for text in packages
    }
    listed = {name for name, *_ in (*OPTIONAL, *REQUIRED)}
    assert wanted <= listed, wanted - listed
