"""Calls of one object by several threads, one after the other."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

T = TypeVar("T")

METHODS = ("track", "finish", "current", "reset", "save", "adjust")
"""Methods of an odometry that read or change its state."""

# Beside the objects, because `reset` replaces all attributes, and an object with a lock cannot be copied.
_LOCKS: WeakKeyDictionary[Any, Any] = WeakKeyDictionary()


def exclusive(cls: type[T]) -> type[T]:
    """Let the methods of an odometry wait for each other: a class decorator.

    A method of :data:`METHODS` that is called while another thread is in one of them, of the same object, begins when
    that one has ended: ``current`` and ``save`` see the state between two frames. Attributes are not protected.

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
    for name in METHODS:
        if name in vars(cls):
            setattr(cls, name, _locked(vars(cls)[name]))
    return cls


def _locked(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def call(self: Any, *args: Any, **keywords: Any) -> Any:
        # Atomic: of two threads that call at once for the first time, both get the same lock.
        with _LOCKS.setdefault(self, threading.RLock()):
            return method(self, *args, **keywords)

    return call
