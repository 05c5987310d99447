"""A function called in a forked process, with a limit of time."""

import os
import select
import signal
import time
import traceback


def in_fork(work, limit=20.0):
    """Call a function in a process forked from this one.

    Args:
        work: without arguments.
        limit: seconds after which the process is killed.

    Returns:
        The representation of its result; type and text of its exception; or ``hangs``.
    """
    receiver, sender = os.pipe()
    child = os.fork()
    if not child:
        try:
            try:
                text = repr(work())
            except Exception as error:  # whatever it is, the parent looks at it
                text = f"{type(error).__name__}: {error}"
            os.write(sender, text.encode())
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(0)  # nothing of pytest runs here
    os.close(sender)
    end, found = time.monotonic() + limit, b""
    try:
        while select.select([receiver], [], [], max(end - time.monotonic(), 0.0))[0]:
            part = os.read(receiver, 65536)
            if not part:
                return found.decode()
            found += part
        return "hangs"
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(receiver)
