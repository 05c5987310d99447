"""Output files that are replaced as a whole: a reader, or a crash, never meets half of one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

PART = ".part-"  # prefix of a file that is being written; a fixed name, so that a killed run leaves at most one


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Write a new content beside a file and replace the file with it at the end of the block.

    The content reaches the disk before it takes the name. After an exception the file is as it was before.

    Args:
        path: file to create or replace.

    Yields:
        File in the same folder to write to, with the same extension.

    Raises:
        OSError: the content cannot be written.
    """
    part = path.with_name(PART + path.name)
    try:
        yield part
        with open(part, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
