"""Calls of one object by several threads, one after the other."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, NoReturn, TypeVar

from dvo.core.context import in_own_context, own_context, use_threads
from dvo.core.errors import DvoError

T = TypeVar("T")

METHODS = ("track", "finish", "current", "reset", "save", "adjust")
"""Methods of an odometry that read or change its state."""
UNLOCKED = ("add_inertial",)
"""Methods that any thread may call while another one is in one of those: they wait for nothing."""


def exclusive(cls: type[T]) -> type[T]:
    """Let the methods of an odometry wait for each other: a class decorator.

    A method of :data:`METHODS` that is called while another thread is in one of them, of the same object, begins when
    that one has ended: ``current`` and ``save`` see the state between two frames. Attributes are not protected. The
    lock is an attribute of the object, which its constructor makes first. In a forked process that cannot compute
    (:func:`dvo.core.context.use_threads`), or that was forked while another thread was in a method, all of them raise a
    :class:`DvoError`. They compute in :func:`dvo.core.context.own_context`.

    Args:
        cls: any of the methods may be missing.

    Returns:
        The same class.

    Example:
        >>> @exclusive
        ... class Counter:
        ...     count = 0
        ...     def track(self):
        ...         self.count += 1  # read, add, write: not atomic
        ...         return self.count
        >>> Counter().track()
        1
    """
    changed = {name: _locked(vars(cls)[name]) for name in METHODS if name in vars(cls)}
    for name, method in {"__init__": _with_lock(cls.__init__), **changed}.items():
        setattr(cls, name, method)
    return described(cls)


def sheltered(cls: type[T]) -> type[T]:
    """Let an odometry without a lock compute in :func:`dvo.core.context.own_context`: a class decorator.

    Args:
        cls: any of the methods may be missing.

    Returns:
        The same class.
    """
    for name in ("__init__", *METHODS):
        if name in vars(cls):
            setattr(cls, name, in_own_context(vars(cls)[name]))
    return described(cls)


def described(cls: type[T]) -> type[T]:
    """Give an odometry a short ``repr``, and let copying it be an error with a remedy: a class decorator.

    Args:
        cls: whose objects have ``name``.

    Returns:
        The same class.
    """
    for name, method in {"__repr__": _short, "__getstate__": _no_state}.items():
        setattr(cls, name, method)
    return cls


def _short(self: Any) -> str:
    gate = getattr(self, "gate", None) or getattr(self, "_gate", None)
    state = "" if gate is None else ", finished" if gate.finished else ""
    return f"<{type(self).__name__} {getattr(self, 'name', '')}{state}>"


def _no_state(self: Any) -> NoReturn:
    raise DvoError(
        "an odometry is not copied or pickled: it holds a sequence, with threads and locks of its own",
        field=type(self).__name__,
        remedy="build another one (dvo.load), or save its map and load that (save, dvo.load_map)",
    )


def _with_lock(construct: Callable[..., None]) -> Callable[..., None]:
    @wraps(construct)
    def call(self: Any, *args: Any, **keywords: Any) -> None:
        self._lock, self._lock_process = threading.RLock(), os.getpid()
        with own_context():
            construct(self, *args, **keywords)

    return call


def _check_forked(lock: threading.RLock) -> None:
    """Raise DvoError if the lock is held by a thread that the forked process does not have."""
    if not lock.acquire(blocking=False):
        raise DvoError(
            "this process was forked while another thread used the odometry, which is between two states here",
            field="fork",
            remedy="fork between two calls, or build an odometry in each process",
        )
    lock.release()


def _locked(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def call(self: Any, *args: Any, **keywords: Any) -> Any:
        use_threads()
        if self._lock_process != os.getpid():
            _check_forked(self._lock)
        with self._lock, own_context():
            return method(self, *args, **keywords)

    return call
