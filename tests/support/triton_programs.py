"""Programs that run kernels of Triton without an accelerator, each in a process of its own.

Triton decides when it is imported if its interpreter runs the kernels. It can compile them for a device that is not
there, too, which finds what the interpreter lets pass.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMPILE = """
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
import triton

def compiled(kernel, types, constants, options={}):
    signature = {name: "constexpr" if name in constants else types[name] for name in kernel.arg_names}
    for architecture in (80, 90):
        target = GPUTarget("cuda", architecture, 32)
        found = triton.compile(ASTSource(kernel, signature, constants), target=target, options=options)
        assert "cubin" in found.asm
        print("compiled for", architecture)
"""


def run(program: str, *, interpret: bool, kept: Path) -> str:
    """Output of a program; skips without Triton.

    Args:
        program: text.
        interpret: kernels are run by the interpreter; otherwise ``compiled`` is defined.
        kept: folder for compiled kernels.
    """
    if importlib.util.find_spec("triton") is None:
        pytest.skip("triton is not installed")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TRITON_CACHE_DIR": str(kept), "OMP_NUM_THREADS": "1"}
    environment["TRITON_INTERPRET"] = "1" if interpret else "0"
    text = program if interpret else COMPILE + program
    done = subprocess.run([sys.executable, "-c", text], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout
