"""Decorator of kernels, see :mod:`dvo.core.kernels`. Imports numba."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import llvmlite.binding
import numba
from numba.core import config, event, sigutils
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys

from dvo.core import ahead

F = TypeVar("F", bound=Callable[..., Any])

# The order of sums may be changed when a kernel is compiled, so that they use vector instructions; it is then fixed.
# Infinite numbers and NaN keep their meaning. Nothing in C calls a kernel. A function becomes a piece of each that
# calls it: one that is called instead has a copy in each of them, and where several are in memory the first copy serves
# all, so that the sums of a kernel would depend on which others are there.
_OPTIONS: dict[str, Any] = dict(
    nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"}, no_cfunc_wrapper=True, forceinline=True
)


class _Notice(event.Listener):
    """Prints a line when the first kernel of this process is compiled; those on the disk are not."""

    ours: set[Any] = set()

    def on_start(self, event: Any) -> None:
        if event.data["dispatcher"].py_func in self.ours:
            ahead.tell()

    def on_end(self, event: Any) -> None: ...


event.register("numba:compile", _Notice())


def compiled(function: F) -> F:
    """Compile a function of arrays and numbers when it is first called; it runs without the lock of the interpreter.

    Compiled code is kept beside the file or, where that cannot be written, in the cache of the user or in
    ``$NUMBA_CACHE_DIR``; where none can, or a file of it is damaged, every process compiles its own.

    Args:
        function: of a file whose name ends in ``_kernels.py``.

    Returns:
        The same, compiled.
    """
    _Notice.ours.add(function)
    try:
        kernel = numba.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no place for the cache
        return numba.njit(**_OPTIONS)(function)
    cache = kernel._cache
    cache.save_overload, load = _tried(cache.save_overload), _tried(_loading(cache))

    def load_or_wait(*arguments: Any) -> Any:
        found = load(*arguments)
        if found is None and ahead.brought(name_of(function)):
            ahead.tell()
            found = load(*arguments)
        return found

    cache.load_overload, cache.load_kept = load_or_wait, load
    return kernel


def _loading(cache: Any) -> Callable[..., Any]:
    """Function that loads from a cache of numba without the declarations of all that it can compile.

    These take a third of a second, once in a process, and code that is compiled needs none of them.
    """
    if not hasattr(cache, "_load_overload"):  # a numba that does it in another way
        whole: Callable[..., Any] = cache.load_overload
        return whole

    def load(signature: Any, context: Any) -> Any:
        rtsys.initialize(context)  # memory of arrays
        with cache._guard_against_spurious_io_errors():
            return cache._load_overload(signature, context)

    return load


def load_kept(kernel: Any, types: str) -> None:
    """Load a kernel for arguments of some types if it is on the disk; it is not compiled.

    Args:
        kernel: of :func:`compiled`.
        types: of its arguments, as numba writes them.
    """
    signature, _ = sigutils.normalize_signature(f"({types},)")
    load = getattr(kernel._cache, "load_kept", None)  # there is none without a place for the cache
    with global_compiler_lock:
        found = None if load is None or signature in kernel.overloads else load(signature, kernel.targetctx)
        if found is not None:  # as Dispatcher.compile does it
            kernel.targetctx.insert_user_function(found.entry_point, found.fndesc, [found.library])
            kernel.add_overload(found)


@cache
def compiles_bfloat16() -> bool:
    """Tell if kernels are compiled for this CPU, and it has instructions for products of bfloat16 (AVX-512 BF16)."""
    return _has("avx512bf16")


@cache
def compiles_int8() -> bool:
    """Tell if kernels are compiled for this CPU, and it has instructions for products of bytes (VNNI)."""
    return _has("avx512vnni") or _has("avxvnni")


def prefers_int8() -> bool:
    """Tell if products of bytes are the fastest of this CPU; units for matrices (AMX) are faster."""
    return compiles_int8() and not _has("amx-tile")


def _has(feature: str) -> bool:
    another = any(getattr(config, name, None) for name in ("CPU_NAME", "CPU_FEATURES"))
    return not another and bool(llvmlite.binding.get_host_cpu_features().get(feature))


def name_of(function: Callable[..., Any]) -> str:
    """Name of a kernel for :mod:`dvo.core.ahead`.

    Args:
        function: compiled or not.

    Returns:
        ``module:function``.
    """
    return f"{function.__module__}:{function.__name__}"


def _tried(step: Callable[..., Any]) -> Callable[..., Any]:
    """Step of numba's cache whose failure is that nothing was kept: a full disk, a damaged file."""

    def guarded(*arguments: Any) -> Any:
        try:
            return step(*arguments)
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):
            return None

    return guarded


def part(function: F) -> F:
    """Compile a function that only compiled ones of its file call; it costs half the time, and no file of its own.

    Args:
        function: see :func:`compiled`.

    Returns:
        The same, compiled.
    """
    options: dict[str, Any] = dict(_OPTIONS, no_cpython_wrapper=True)
    return numba.njit(**options)(function)
