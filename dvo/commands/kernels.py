"""Kernels of a usual run, which another process compiles while the command imports torch and reads its first frames.

With no kernels on the disk and two cores the first run of a command that tracks starts
``python -m dvo.commands.kernels``; see :mod:`dvo.core.ahead`. When all kernels are there, a file beside them says so.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import sys
import threading
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path

from dvo.core.ahead import compiled_by
from dvo.core.limits import TRACKING, memory_of_group
from dvo.core.threads import CGROUPS, MEMBERSHIP, available_cores
from dvo.odometry.patch.kernels import needed

_PACKAGE = Path(__file__).resolve().parent.parent
_MEMORY = 300 * 2**20  # bytes of the process


def compiled_meanwhile(arguments: argparse.Namespace) -> AbstractContextManager[None]:
    """Have another process compile the kernels while a command runs, if they are not on the disk.

    Args:
        arguments: of a command that tracks.

    Returns:
        Context in which it does; a plain one where there is nothing to compile, no second core, no memory for another
        process, or no folder that keeps what it compiles.
    """
    system, device = getattr(arguments, "system", None), getattr(arguments, "device", "cpu")
    if system is not None or device not in ("auto", "cpu") or os.environ.get("DVO_KERNELS") == "torch":
        return contextlib.nullcontext()
    file = done_file()
    if file is None or file.exists() or not room_beside(_MEMORY):
        return contextlib.nullcontext()
    return compiled_by([sys.executable, "-m", "dvo.commands.kernels"])


def room_beside(memory: int) -> bool:
    """Tell if there is a core, and memory, for another process beside one that tracks.

    Args:
        memory: of that process, bytes.
    """
    limit = memory_of_group(MEMBERSHIP, CGROUPS)
    return available_cores() >= 2 and (limit is None or limit >= TRACKING.resident * 2**20 + memory)


def done_file() -> Path | None:
    """File that is there when the kernels are compiled: of these sources, this Python and this numba.

    Returns:
        The file, in a folder where numba keeps compiled code; None if none can be written, or without numba.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    own = _PACKAGE / "core" / "__pycache__"
    users = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "numba"
    folder = Path(given) if given else next((place for place in (own, users) if _is_writable(place)), None)
    if folder is None:
        return None
    from importlib import metadata  # here, since it takes longer than all else that `dvo --help` needs

    try:
        versions = f"{sys.version} {metadata.version('numba')} {metadata.version('llvmlite')}"
        sources = [file.read_bytes() for file in sorted(_PACKAGE.rglob("*_kernels.py"))]
        sources.append((_PACKAGE / "core" / "compiled.py").read_bytes())
    except (metadata.PackageNotFoundError, OSError):
        return None
    return folder / f"dvo-kernels-{hashlib.sha256(b''.join([versions.encode(), *sources])).hexdigest()[:16]}"


def _is_writable(folder: Path) -> bool:
    while not folder.exists():
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def main() -> None:
    """Compile the kernels, but for those whose names come in on standard input; end when that is closed."""
    theirs: set[str] = set()

    def listen() -> None:
        for line in sys.stdin:
            theirs.add(line.strip())
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    from numba.core import sigutils

    for name, types in needed().items():
        module, function = name.split(":")
        kernel = getattr(import_module(module), function)
        if kernel._cache.cache_path is None:
            return
        if name not in theirs:
            print("start", name, flush=True)
            kernel.compile(sigutils.normalize_signature(f"({types},)")[0])
            print("done", name, flush=True)
    file = done_file()
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        for older in file.parent.glob("dvo-kernels-*"):
            older.unlink(missing_ok=True)
        file.touch()


if __name__ == "__main__":
    main()
