"""Tests of the choice between kernels and twins."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.autograd import forward_ad

from dvo.core.errors import DvoError
from dvo.core.kernels import VARIABLE, available, use_kernels

ROOT = Path(__file__).resolve().parents[2]
HIDDEN = (
    "import sys; sys.modules['numba'] = None; from dvo.core.kernels import available; print(available(), available())"
)
KERNEL = """
import numpy as np
from dvo.core.compiled import compiled

@compiled
def total(x):
    s = 0.0
    for i in range(len(x)):
        s += x[i]
    return s

print(total(np.ones(1000)), total(np.array([1.0, np.nan])))
"""
ALIGN = """
import hashlib, numpy as np
from dvo.nets.alignment.alignment_kernels import align

random = np.random.default_rng(0)
images, places = random.random((2, 40, 50), np.float32), (random.random((2, 99, 2)) * 30 + 5).astype(np.float32)
edges, warps = np.zeros(99, np.int64), np.tile(np.eye(2, dtype=np.float32), (99, 1, 1))
found, quality = np.empty((99, 2), np.float32), np.empty((2, 99), np.float32)
align(images, edges, edges + 1, *places, warps, 7, 5, 1e-3, 2.0, found, quality)
print(hashlib.sha1(found.tobytes() + quality.tobytes()).hexdigest(), len(align.stats.cache_hits))
"""


def test_of_the_cpu_without_gradients(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    plain, recorded = torch.zeros(3), torch.zeros(3, requires_grad=True)
    assert available() and use_kernels(plain)
    assert not use_kernels(plain, recorded) and use_kernels(plain, recorded, adjoint=True)
    assert not torch.func.grad(lambda x: x * use_kernels(x, adjoint=True))(torch.ones(()))
    assert not use_kernels(plain.double()) and not use_kernels(torch.zeros(3, device="meta"))
    assert use_kernels(plain.double(), double=True) and use_kernels(plain, double=True)
    assert not use_kernels(plain, plain.double(), double=True)
    with torch.inference_mode():
        assert use_kernels(plain, recorded)


def test_twins_where_derivatives_are_taken_forward(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    seen = []

    def look(x):
        seen.append(use_kernels(x))
        return x * 2

    torch.func.vmap(look)(torch.zeros(3))
    torch.func.grad(lambda x: look(x).sum())(torch.zeros(3))
    with forward_ad.dual_level():
        look(forward_ad.make_dual(torch.zeros(3), torch.ones(3)))
    assert seen == [False] * 3 and use_kernels(torch.zeros(3))


def test_twins_on_request(monkeypatch):
    monkeypatch.setenv(VARIABLE, "torch")
    assert not use_kernels(torch.zeros(3))
    monkeypatch.setenv(VARIABLE, "cuda-graph")
    with pytest.raises(DvoError, match="DVO_KERNELS: is 'cuda-graph'. Set it to numba or torch"):
        use_kernels(torch.zeros(3))


@pytest.mark.long
def test_without_numba_one_line_says_so():
    found = subprocess.run([sys.executable, "-c", HIDDEN], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False False"
    assert found.stderr.count("numba cannot be imported") == 1


@pytest.mark.long
def test_compiled_once_with_a_line(tmp_path):
    file = tmp_path / "some_kernels.py"
    file.write_text(KERNEL)
    for said in (1, 0):
        found = subprocess.run([sys.executable, file], env={"PYTHONPATH": str(ROOT), "PATH": ""}, capture_output=True,
                               text=True, check=True)  # fmt: skip
        assert found.stdout.strip() == "1000.0 nan"
        assert found.stderr.count("compiling kernels") == said


@pytest.mark.long
def test_compiled_or_from_the_disk_the_last_bits_are_the_same(tmp_path):
    environment = {"PYTHONPATH": str(ROOT), "PATH": "", "NUMBA_CACHE_DIR": str(tmp_path)}

    def run():
        line = [sys.executable, "-c", ALIGN]
        return subprocess.run(line, env=environment, capture_output=True, text=True, check=True).stdout.split()

    (compiled, hits), (kept, later) = run(), run()
    assert compiled == kept and (hits, later) == ("0", "1")


@pytest.mark.long
def test_a_cache_that_is_damaged_or_cannot_be_written_is_none(tmp_path):
    file, cache = tmp_path / "some_kernels.py", tmp_path / "cache"
    file.write_text(KERNEL)
    environment = {"PYTHONPATH": str(ROOT), "PATH": "", "NUMBA_CACHE_DIR": str(cache)}

    def run(program):
        return subprocess.run([sys.executable, *program], env=environment, capture_output=True, text=True, check=True)

    run([file])
    kept = [found for found in cache.rglob("*.nb?") if found.is_file()]
    assert kept
    for found in kept:
        found.write_bytes(b"\x80\x04")
    assert run([file]).stdout.strip() == "1000.0 nan"
    full = f"""
import os, errno, numba.core.caching as caching
def full(*_): raise OSError(errno.ENOSPC, "No space left on device")
caching.IndexDataCacheFile.save = full
exec(compile(open({str(file)!r}).read(), {str(file)!r}, "exec"))
"""
    for found in kept:
        found.unlink()
    assert run(["-c", full]).stdout.strip() == "1000.0 nan"


@pytest.mark.long
def test_functions_of_other_programs_are_compiled_without_a_line():
    program = "import numba, dvo.core.compiled; print(numba.njit(lambda x: x + 1)(1))"
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "2" and "compiling" not in found.stderr


def test_importing_dvo_does_not_import_numba():
    script = "import sys, dvo, dvo.cli; assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True)


@pytest.mark.long
def test_a_kernel_on_the_disk_is_loaded_without_all_that_numba_can_compile(tmp_path):
    """And another one can be compiled afterwards."""
    program = """
import sys
import numpy as np
from dvo.core.compiled import load_kept
from dvo.nets.update.update_kernels import add, spread
load_kept(add, "f4[:,::1], f4[:,::1]")
known = len(add.overloads)
x = np.ones((3, 4), np.float32)
add(x, x)
loaded = "numba.np.linalg" in sys.modules
spread(x, x, np.zeros(3, np.int64))
print(known, loaded, float(x.sum()))
"""
    found = []
    for _ in range(2):
        run = subprocess.run(
            [sys.executable, "-c", program], check=True, capture_output=True, text=True,
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        )  # fmt: skip
        found.append(run.stdout.split())
    assert found == [["0", "True", "64.0"], ["1", "False", "64.0"]]
