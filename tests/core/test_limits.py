"""Limits of the system: told in one line, and before torch is imported where they can be read."""

from __future__ import annotations

import resource
import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest
import torch

from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.core.limits import LOADING, TRACKING, Needs, check_limits, limit_error, memory_of_group

MB = 2**20
NOTHING = Needs(0, 0, 0)


def run(repository, line, **limits):
    """``dvo`` in a process with limits; checks that it ends in one line, and gives it."""

    def restrict():
        for name, value in limits.items():
            resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (value, resource.RLIM_INFINITY))

    command = (
        [sys.executable, "-X", "importtime", "-m", "dvo", *line]
        if "AS" in limits
        else [sys.executable, "-m", "dvo", *line]
    )
    done = subprocess.run(command, cwd=repository, preexec_fn=restrict, capture_output=True, text=True, timeout=200)
    said = [text for text in done.stderr.splitlines() if not text.startswith("import time:")]
    assert done.returncode == 2, done.stderr[-2000:]
    assert len(said) == 1 and said[0].startswith("dvo: error: "), said
    assert "| torch\n" not in done.stderr
    return said[0]


@pytest.mark.parametrize("command", [["demo", "--frames", "5"], ["run", "x"], ["doctor"], ["summary", "x"]])
def test_a_limit_of_addresses(repository, command, tmp_path):
    line = run(repository, command, AS=500 * MB)
    assert "500 MB of memory are allowed (ulimit -v), at least" in line and "Raise the limit" in line


def test_other_limits(repository, tmp_path):
    assert "900 MB of memory are allowed (ulimit -v)" in run(repository, ["demo"], AS=900 * MB)
    assert "800 MB of memory are allowed (ulimit -d)" in run(repository, ["calibrate", "x"], DATA=800 * MB)
    assert "100 kB is allowed (ulimit -s)" in run(repository, ["demo"], STACK=100 * 1024)


@pytest.mark.slow
@pytest.mark.parametrize("frames", [5])
def test_what_is_allowed_suffices(repository, frames, tmp_path):
    """The numbers of :data:`TRACKING` are enough for the demo."""

    def restrict():
        resource.setrlimit(resource.RLIMIT_AS, (TRACKING.addresses * MB, resource.RLIM_INFINITY))

    line = [sys.executable, "-m", "dvo", "demo", "--frames", str(frames), "--out", str(tmp_path / "out")]
    environment = {"PYTHONPATH": str(repository), "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"}
    done = subprocess.run(line, preexec_fn=restrict, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode in (0, 1) and (tmp_path / "out" / "run.json").is_file(), done.stderr[-2000:]


@pytest.mark.parametrize(
    ("groups", "files", "found"),
    [
        ("0::/a/b\n", {"a/memory.max": "300000000", "a/b/memory.max": "max"}, 300_000_000),
        ("5:memory:/docker/x\n1:cpu:/\n", {"memory/memory.limit_in_bytes": "400000000"}, 400_000_000),
        ("5:cpu,memory:/a\n", {"cpu,memory/a/memory.limit_in_bytes": "9223372036854771712"}, 9223372036854771712),
        ("0::/\n", {"memory.max": "max"}, None),
        ("", {}, None),
    ],
)
def test_control_groups(tmp_path, groups, files, found):
    (tmp_path / "cgroup").write_text(groups)
    for name, text in files.items():
        (tmp_path / "groups" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / name).write_text(text + "\n")
    place = tmp_path / "cgroup", tmp_path / "groups"
    assert memory_of_group(*place) == found
    if found is not None and found < 2**40:
        with pytest.raises(DvoError, match=r"MB of memory are allowed \(memory limit of the control group\)"):
            check_limits(TRACKING, *place)
    else:
        check_limits(LOADING, *place)


def test_threads_that_cannot_start(monkeypatch, capsys):
    """As with ``ulimit -u``, or a limit of the processes of a container."""
    start, started = threading.Thread.start, []

    def limited(thread):
        if len(started) >= 2:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)
    with pytest.raises(DvoError, match="no further thread can start"):
        check_limits(NOTHING)
    assert not any(thread.is_alive() for thread in started)
    started.clear()
    assert main(["doctor"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def errors_of_libraries():
    def fail(function):
        with pytest.raises(Exception) as found:
            function()
        return found.value

    yield fail(lambda: np.zeros(2**55))
    yield fail(lambda: torch.zeros(2**50))
    yield fail(lambda: bytearray(2**60))
    yield cv2.error(
        "OpenCV(4.10) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 8 bytes in function 'x'"
    )
    yield RuntimeError("std::bad_alloc")
    yield ImportError("libtorch_cpu.so: failed to map segment from shared object")
    yield RuntimeError("CUDA out of memory. Tried to allocate 2 GiB")
    yield RuntimeError("unable to write to file </torch_123_456>: No space left on device (28)")
    yield RuntimeError("can't start new thread")
    yield ImportError("libx.so: cannot open shared object file: Too many open files")


def test_errors_of_libraries(monkeypatch, capsys):
    for error in errors_of_libraries():
        found = limit_error(error)
        assert found is not None and found.remedy

        def fail(arguments, error=error):
            raise error

        monkeypatch.setattr("dvo.commands.doctor.doctor", fail)
        assert main(["doctor"]) == 2
        said = capsys.readouterr().err
        assert said.startswith("dvo: error: ") and said.count("\n") == 1
    assert limit_error(ValueError("wrong")) is None and limit_error(DvoError("out of memory")) is None


@pytest.mark.slow
def test_files_larger_than_memory(repository, tmp_path):
    """Weights, a checkpoint and a map that do not fit into the addresses that the process may have."""
    import json
    import struct
    import zipfile

    size = 3 * 2**30
    head = json.dumps({"w": {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}}).encode()
    weights = tmp_path / "w.safetensors"
    weights.write_bytes(struct.pack("<Q", len(head)) + head)
    with open(weights, "r+b") as file:
        file.truncate(8 + len(head) + size)
    checkpoint = tmp_path / "c.pth"
    torch.save({"w": torch.zeros(300 * 2**20, dtype=torch.uint8)}, checkpoint)
    with zipfile.ZipFile(tmp_path / "m.dvo", "w") as archive:
        archive.writestr("map.json", bytes(900 * 2**20))
    for line in (["weights", "info", str(weights)], ["weights", "import", str(checkpoint)]):
        said = run(repository, line, AS=1100 * MB)
        assert "the memory does not suffice" in said and str(tmp_path) in said
    run(repository, ["export", str(tmp_path / "m.dvo"), str(tmp_path / "q"), "--to", "tum"], AS=1100 * MB)
