"""Kernels that a process compiles while a command starts."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from importlib import import_module

import pytest

from dvo.commands import kernels
from dvo.commands.kernels import compiled_meanwhile, done_file
from dvo.odometry.patch import kernels as of_tracker


def command(**options):
    return argparse.Namespace(**({"device": "auto", "system": None} | options))


@pytest.fixture
def cold(monkeypatch, tmp_path):
    """No kernel on the disk, and two cores."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("DVO_KERNELS", raising=False)
    monkeypatch.setattr(kernels, "available_cores", lambda: 2)
    monkeypatch.setattr(kernels, "memory_of_group", lambda *_: None)


def is_plain(arguments):
    return isinstance(compiled_meanwhile(arguments), contextlib.nullcontext)


ALL = of_tracker.KERNELS | of_tracker.BFLOAT16_KERNELS | of_tracker.INT8_BFLOAT16_KERNELS


@pytest.mark.parametrize("name", ALL)
def test_every_kernel_is_there_with_as_many_arguments(name):
    from numba.core import sigutils

    module, function = name.split(":")
    types, _ = sigutils.normalize_signature(f"({ALL[name]},)")
    assert len(types) == len(inspect.signature(getattr(import_module(module), function).py_func).parameters)


@pytest.mark.long
def test_kernels_are_imported_without_torch():
    modules = sorted({name.split(":")[0] for name in ALL})
    program = (
        f"import sys, importlib; [importlib.import_module(x) for x in {modules}]; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("int8", [True, False])
def test_those_for_lower_precision_are_for_such_machines_alone(half, int8, monkeypatch):
    """No other can compile them."""
    monkeypatch.setattr("dvo.core.compiled.compiles_bfloat16", lambda: half)
    monkeypatch.setattr("dvo.core.compiled.prefers_int8", lambda: int8)
    found, numbers = of_tracker.needed(), "u2" if half else "f4"
    assert set(found) <= set(ALL)
    assert ("dvo.nets.patch.encoder_kernels:normalise_bfloat16" in found) == half
    assert ("dvo.nets.patch.encoder_kernels:normalise" in found) == (not half)
    assert ("dvo.nets.update.int8_kernels:multiply" in found) == int8
    looks_up = [name.split(":")[1] for name in found if ":correlate" in name]
    assert looks_up == ["correlate_bytes" if int8 else "correlate_bfloat16" if half else "correlate"]
    assert found["dvo.nets.update.update_kernels:spread"].startswith(numbers)
    assert all(
        types.endswith(f"{numbers}[:,::1]") for name, types in found.items() if name.endswith("int8_kernels:multiply")
    )


def test_no_process_where_it_would_be_of_no_use(cold, monkeypatch):
    assert not is_plain(command()) and not is_plain(argparse.Namespace())
    assert is_plain(command(system="keyframe")) and is_plain(command(device="meta"))
    for change in (
        lambda patch: patch.setenv("DVO_KERNELS", "torch"),
        lambda patch: patch.setattr(kernels, "available_cores", lambda: 1),
        lambda patch: patch.setattr(kernels, "memory_of_group", lambda *_: 700 * 2**20),
        lambda patch: patch.setattr(kernels, "done_file", lambda: None),
    ):
        with monkeypatch.context() as patch:
            change(patch)
            assert is_plain(command())
    done_file().touch()
    assert is_plain(command())


def test_what_is_done_is_of_these_sources(cold, monkeypatch, tmp_path):
    first = done_file()
    package = tmp_path / "package"
    (package / "core").mkdir(parents=True)
    (package / "core" / "compiled.py").write_text("")
    monkeypatch.setattr(kernels, "_PACKAGE", package)
    second = done_file()
    (package / "some_kernels.py").write_text("x = 1")
    assert len({first, second, done_file()}) == 3


@pytest.mark.slow
def test_a_first_run_shares_the_work(tmp_path, repository):
    """The process and the command bring one version of each kernel, and the results are those of the next run."""
    cache = tmp_path / "cache"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(repository)}
    environment.pop("DVO_KERNELS", None)
    metrics = []
    for run in ("first", "second"):
        line = [sys.executable, "-m", "dvo", "demo", "--frames", "40", "--out", str(tmp_path / run)]
        done = subprocess.run(line, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert ("compiling kernels" in done.stderr) == (run == "first")
        metrics.append(json.loads((tmp_path / run / "run.json").read_text())["metrics"]["ate_rmse"])
    assert metrics[0] == pytest.approx(metrics[1], rel=1e-3)
    known = 0  # kernels by the types of their arguments
    for index in cache.rglob("*.nbi"):
        with index.open("rb") as file:
            pickle.load(file)  # version of numba
            known += len(pickle.loads(file.read())[1])
    assert known == len(list(cache.rglob("*.nbc"))) > 20


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_both(tmp_path, repository, number):
    cache = tmp_path / "cache"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(repository)}
    line = [sys.executable, "-m", "dvo", "demo", "--out", str(tmp_path / "out")]
    with subprocess.Popen(line, env=environment, stderr=subprocess.PIPE, start_new_session=True) as process:
        end = time.monotonic() + 120
        while not cache.exists() and time.monotonic() < end:  # the process imports kernels
            time.sleep(0.01)
        process.send_signal(number)
        assert process.wait(120) == 128 + number
    with pytest.raises(ProcessLookupError):  # nobody is left of its session
        os.killpg(process.pid, 0)
