"""A process that compiles kernels into the cache on the disk while this one does other things.

The two share the work by lines: the helper says which kernel it starts and which is done, and is told which one this
process compiles itself. It ends when its standard input is closed, so with this process however that ends.
"""

from __future__ import annotations

import contextlib
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from typing import IO

from dvo.core.text import print_line
from dvo.core.threads import process_environment

PATIENCE = 10.0
"""Seconds that this process waits for a kernel at most, or six times what the longest has taken if that is more: beside
other busy processes. That is what it takes to compile the longest."""


class Helper:
    """The process.

    Args:
        command: program and arguments.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, command: Sequence[str]) -> None:
        # Numba's messages of errors that it meets while it looks for types cost a twentieth of the time in colour.
        environment = process_environment(1) | {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self._changed = threading.Condition()
        self._said: dict[str, str] = {}  # kernels that are started or done
        self._began, self._longest, self._gone = 0.0, 0.0, False
        try:
            threading.Thread(target=self._listen, args=(self._process.stdout,), daemon=True).start()
        except RuntimeError as error:  # a limit of threads
            self.close()
            raise OSError(str(error)) from error

    def _listen(self, stream: IO[bytes]) -> None:
        for line in stream:
            word, _, name = line.decode(errors="replace").strip().partition(" ")
            with self._changed:
                self._said[name] = word
                if word == "start":
                    self._began = time.monotonic()
                else:
                    self._longest = max(self._longest, time.monotonic() - self._began)
                self._changed.notify_all()
        with self._changed:
            self._gone = True
            self._changed.notify_all()

    def brings(self, name: str) -> bool:
        """Tell if the process has compiled a kernel, after a wait if it is at it; if not, it is told to leave it out.

        Args:
            name: of the kernel, ``module:function``.

        Returns:
            True if the kernel is on the disk, unless it could not be written there.
        """
        with self._changed:
            end = time.monotonic() + max(PATIENCE, 6 * self._longest)
            while self._said.get(name) == "start" and not self._gone:
                if not self._changed.wait(end - time.monotonic()):
                    self._process.kill()  # it does not run
                    return False
            if self._said.get(name) == "done":
                return True
            assert self._process.stdin is not None
            if not self._gone:
                with contextlib.suppress(OSError):
                    self._process.stdin.write(f"{name}\n".encode())
                    self._process.stdin.flush()
            return False

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with self._changed, contextlib.suppress(OSError):  # what it was told last is not read any more
            self._gone = True  # what listens may not have seen the end yet
            self._process.stdin.close()


_present: list[Helper] = []
_told: list[bool] = []


@contextlib.contextmanager
def compiled_by(command: Sequence[str]) -> Iterator[None]:
    """Have a process compile kernels meanwhile; one that cannot be started is none.

    Args:
        command: program and arguments.
    """
    try:
        helper = Helper(command)
    except OSError:
        yield
        return
    _present.append(helper)
    try:
        yield
    finally:
        _present.remove(helper)
        helper.close()


def brought(name: str) -> bool:
    """Tell if another process has just compiled a kernel, see :meth:`Helper.brings`.

    Args:
        name: of the kernel, ``module:function``.
    """
    return any(helper.brings(name) for helper in _present)


def tell() -> None:
    """Print a line, once in this process, that kernels are compiled."""
    if not _told:
        _told.append(True)
        print_line("dvo: compiling kernels, once on this machine", error=True)
