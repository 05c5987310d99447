"""Kernels that a thread loads when a tracker is built."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

LOAD = """
import sys, threading, torch
from importlib import import_module
from dvo.odometry.patch import kernels
names = {names}
kernels.KERNELS = {{name: kernels.KERNELS[name] for name in names}}
kernels.load_in_background()
{then}
loaded = [getattr(import_module(module), function) for module, function in (name.split(":") for name in names)]
print(*(len(kernel.overloads) for kernel in loaded))
"""
JOIN = "[thread.join() for thread in threading.enumerate() if thread.name == 'dvo-kernels']"
FORK = """
import os
if not (child := os.fork()):
    os._exit(0 if not any(thread.name == "dvo-kernels" for thread in threading.enumerate()) else 1)
assert os.waitpid(child, 0)[1] == 0
"""
KERNELS = ["dvo.ba.sparse.schur_kernels:find", "dvo.ba.sparse.column_kernels:places"]


def run(program: str, **variables: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | variables, capture_output=True, text=True, check=True
    )
    assert not done.stderr
    return done.stdout.strip()


@pytest.mark.long
def test_those_on_the_disk_are_loaded_and_no_other_is_compiled(tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path), "DVO_KERNELS": ""}
    program = LOAD.format(names=KERNELS, then=JOIN)
    assert run(program, **cache) == "0 0"
    compile_one = (
        "from numba.core import sigutils; from dvo.odometry.patch.kernels import KERNELS; "
        "from dvo.ba.sparse.schur_kernels import find; import dvo.core.ahead as ahead; ahead.tell = lambda: None; "
        f"find.compile(sigutils.normalize_signature('(' + KERNELS['{KERNELS[0]}'] + ',)')[0])"
    )
    run(compile_one, **cache)
    assert run(program, **cache) == "1 0"
    assert run(LOAD.format(names=KERNELS, then=FORK), **cache) == "1 0"  # a fork waits for it
    assert run(program, **(cache | {"DVO_KERNELS": "torch"})) == "0 0"
