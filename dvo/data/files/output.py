"""Output files and folders that appear as a whole: no reader, crash or second writer meets half of one."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import platform
import re
import secrets
import shutil
import stat
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.core.text import in_utf8

PART = ".part-"
"""Prefix of a file or folder that is being written: host, process and number of the part follow, and the final name."""
LOCK = ".dvo.lock"
"""File in a folder that one process writes into at a time."""
ABANDONED = 86400.0
"""Age in seconds from which a part of another machine, whose processes cannot be asked for, is taken for abandoned."""
_HOST = f"{zlib.crc32(platform.node().encode('utf-8', 'replace')):08x}"
_PROCESS = secrets.token_hex(4)  # a process number is given anew, in a container even to every run
_NUMBERS = itertools.count()
_NAME = re.compile(re.escape(PART) + r"([0-9a-f]{8})-(\d+)-([0-9a-f]{8})-\d+-.+", re.DOTALL)
_LONGEST = 200  # bytes of a name that is kept in the name of its part; file systems allow 255 in all


@contextlib.contextmanager
def replaced(path: Path | str) -> Iterator[Path]:
    """Write a new content beside a file and replace the file with it at the end of the block.

    The content reaches the disk before it takes the name. After an exception the file is as it was before. Each writer
    has a part of its own: of several at a time, the last to end gives the file its content. A link is followed: what it
    points to is replaced. Parts that processes have left behind when they were killed are removed.

    Args:
        path: file to create or replace.

    Yields:
        File in the same folder to write to, with the same extension.

    Raises:
        OSError: the content cannot be written, or the path is a folder, a device, a pipe or a socket.

    Example:
        >>> with replaced("note.txt") as part:
        ...     _ = part.write_text("whole or not at all")
    """
    part = begin_part(path)
    try:
        yield part
        end_part(part, path)
    except BaseException:
        drop_part(part)
        raise


def write_text(path: Path | str, text: str) -> None:
    """Create or replace a text file as a whole, in UTF-8; see :func:`replaced`.

    Args:
        path: the file.
        text: its content.

    Raises:
        OSError: it cannot be written.
    """
    with replaced(path) as part:
        part.write_text(in_utf8(text), encoding="utf-8", newline="\n")


@contextlib.contextmanager
def spelled_in_text(path: Path) -> Iterator[str]:
    """Name of a file for libraries that take text alone; OpenCV ends the process at one that is no UTF-8.

    Args:
        path: to read or to write.

    Yields:
        The whole path (of a relative one FFmpeg takes what stands before a colon for a protocol), or a link to it that
        goes away at the end.

    Raises:
        DvoError: the link cannot be made.
    """
    text = os.path.abspath(path)
    if in_utf8(text) == text:
        yield text
        return
    with scratch_folder("dvo-link") as folder:
        link = folder / f"file{path.suffix if path.suffix.isascii() else ''}"
        try:
            link.symlink_to(path.absolute())
        except OSError:
            message, remedy = "a name that is no text in UTF-8", "rename the file"
            raise DvoError(message, file=path, remedy=remedy) from None
        yield str(link)


@contextlib.contextmanager
def scratch_folder(name: str, place: Path | None = None) -> Iterator[Path]:
    """Folder for files of this process, which goes at the end of the block.

    One that a process has left behind when it was killed goes when the next one is made in the same place.

    Args:
        name: end of its name.
        place: where it lies; None for where temporary files do.

    Yields:
        The folder; other users cannot look into it.

    Raises:
        OSError: it cannot be made.
    """
    place = Path(tempfile.gettempdir()) if place is None else place
    sweep_parts(place)
    folder = place / _part_name(Path(name))
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def begin_part(path: Path | str) -> Path:
    """Name of a new part of a file, for content that is written over a longer time; see :func:`replaced`.

    Args:
        path: file to create or replace at the end.

    Returns:
        File to write to, in the same folder, with the same extension; it does not exist.

    Raises:
        OSError: the path is a folder, a device, a pipe or a socket.
    """
    target = _target(path)
    sweep_parts(target.parent)
    return target.with_name(_part_name(target, Path(path).suffix))


def end_part(part: Path, path: Path | str) -> None:
    """Bring a part to the disk and give it the name of its file.

    Args:
        part: of :func:`begin_part`.
        path: its file.

    Raises:
        OSError: the part is missing or cannot be written, or the path is not a regular file any more.
    """
    with open(part, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, _target(path))


def drop_part(part: Path) -> None:
    """Remove a part that does not become a file, if it can be removed.

    Args:
        part: of :func:`begin_part`; may be missing.
    """
    with contextlib.suppress(OSError):
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def new_folder(folder: Path | str) -> Iterator[Path]:
    """Write files into a part of a folder, which takes its name at the end of the block.

    A link is followed. A place at which a file system is mounted keeps its name: there the files appear one by one.

    Args:
        folder: missing or empty.

    Yields:
        Folder beside it, or in a mounted one, to write into.

    Raises:
        DvoError: it is not an empty folder, also because another writer was first.
        OSError: it cannot be written.
    """
    folder = Path(os.path.realpath(folder))
    is_mounted = os.path.ismount(folder)
    place = folder if is_mounted else folder.parent
    place.mkdir(parents=True, exist_ok=True)
    sweep_parts(place)
    check_empty(folder)
    part = place / _part_name(folder)
    part.mkdir()
    try:
        yield part
        check_empty(folder, part)
        if is_mounted:
            for child in list(part.iterdir()):
                os.rename(child, folder / child.name)
            return
        with contextlib.suppress(OSError):
            folder.rmdir()
        try:
            os.rename(part, folder)
        except OSError:
            check_empty(folder)
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


def sweep_parts(folder: Path) -> None:
    """Remove the parts of writers that are no more; what cannot be removed stays.

    Args:
        folder: in which they lie; may be missing.
    """
    try:
        with os.scandir(folder) as entries:
            found = [Path(entry.path) for entry in entries if entry.name.startswith(PART)]
    except OSError:
        return
    for part in found:
        if _is_abandoned(part):
            if part.is_dir() and not part.is_symlink():
                shutil.rmtree(part, ignore_errors=True)
            else:
                drop_part(part)


@contextlib.contextmanager
def only_writer(folder: Path, field: str) -> Iterator[None]:
    """Keep a second writer out of a folder; the lock ends with the process, however that ends.

    Args:
        folder: an existing folder.
        field: option or argument that names it.

    Yields:
        Nothing. Without file locks, as on Windows, nothing is locked.

    Raises:
        DvoError: another writer is at work in the folder.
        OSError: the folder cannot be written.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    file = folder / LOCK
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                os.close(descriptor)
                message = "another run is writing into this folder"
                raise DvoError(
                    message, file=folder, field=field, remedy="wait for it, or give another folder"
                ) from None
            # A file system without locks: the folder can still be used.
        if _is_same(file, descriptor):
            break
        os.close(descriptor)  # its writer has ended meanwhile, and removed it
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            file.unlink(missing_ok=True)  # while it is still locked
        os.close(descriptor)


def check_place(file: Path, option: str) -> None:
    """Check that a file can be written, before the work that it will hold.

    Args:
        file: its folder is made if need be.
        option: of the command line that names it.

    Raises:
        DvoError: it cannot, or is a folder, a device, a pipe or a socket.
    """
    try:
        target = _target(file)
        target.parent.mkdir(parents=True, exist_ok=True)
        check_writable(target.parent)
    except OSError as error:
        remedy = "give a file in a folder that can be written"
        raise DvoError(error.strerror or str(error), file=file, field=option, remedy=remedy) from error


def check_writable(folder: Path) -> None:
    """Write a small file into a folder and remove it.

    Args:
        folder: an existing folder.

    Raises:
        OSError: the folder cannot be written, or there is no space.
    """
    probe = folder / f"{PART}{_HOST}-{os.getpid()}-{_PROCESS}-{next(_NUMBERS)}-probe"
    try:
        with open(probe, "xb") as file:
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())
    finally:
        drop_part(probe)


def _target(path: Path | str) -> Path:
    """File that a path names, links followed; only a regular file may be replaced."""
    target = Path(os.path.realpath(path))
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    if stat.S_ISREG(mode):
        return target
    reason = "is a folder" if stat.S_ISDIR(mode) else "is not a regular file"
    raise OSError(errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL, reason, str(path))


def _part_name(target: Path, suffix: str = "") -> str:
    name = target.name
    if target.suffix != suffix:  # the target of a link, with another name
        name += suffix
    if len(os.fsencode(name)) > _LONGEST:
        name = f"long{suffix}" if len(os.fsencode(suffix)) < _LONGEST else "long"
    return f"{PART}{_HOST}-{os.getpid()}-{_PROCESS}-{next(_NUMBERS)}-{name}"


def _is_abandoned(part: Path) -> bool:
    found = _NAME.fullmatch(part.name)
    if found is None:
        return False
    host, process, token = found[1], int(found[2]), found[3]
    if host == _HOST and process == os.getpid():
        return token != _PROCESS
    if host == _HOST and os.name == "posix":
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return True
        except (OSError, OverflowError):
            return False
        return False
    try:
        return time.time() - part.stat().st_mtime > ABANDONED
    except OSError:
        return False


def check_empty(folder: Path, but: Path | None = None) -> None:
    """Refuse a place that a new folder cannot take.

    Args:
        folder: to be written.
        but: what may lie in it.

    Raises:
        DvoError: it is there, and no empty folder.
    """
    if os.path.lexists(folder) and (not folder.is_dir() or any(child != but for child in folder.iterdir())):
        raise DvoError("is not an empty folder", file=folder, remedy="give a new folder")


def _is_same(file: Path, descriptor: int) -> bool:
    try:
        found, held = os.stat(file), os.fstat(descriptor)
    except FileNotFoundError:
        return False
    return (found.st_dev, found.st_ino) == (held.st_dev, held.st_ino)
