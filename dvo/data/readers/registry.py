"""Readers of data sets by name, and the choice of one for a path."""

from __future__ import annotations

from pathlib import Path

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.data.recording import Reader

_BUILT_IN = {
    "rosbag": "dvo.data.readers.rosbag:READER",
    "video": "dvo.data.readers.video:READER",
    "euroc": "dvo.data.readers.euroc:READER",
    "kitti": "dvo.data.readers.kitti:READER",
    "kitti_raw": "dvo.data.readers.kitti_raw:READER",
    "tartanair": "dvo.data.readers.tartanair:READER",
    "icl_nuim": "dvo.data.readers.icl_nuim:READER",
    "tum": "dvo.data.readers.tum:READER",
    "sequence": "dvo.data.readers.sequence:READER",
    "folder": "dvo.data.readers.folder:READER",
}
READERS = Registry("reader", "dvo.readers", dict(_BUILT_IN))
"""Names to ``"module:READER"``, each a :class:`dvo.data.recording.Reader`. Other packages add theirs by an entry point
of the group ``dvo.readers``, or by ``READERS.register(name, target)``."""


def names_in_order() -> list[str]:
    """Names of the readers in the order in which a path is offered to them.

    Readers of other packages come first, because ``video``, ``sequence`` and ``folder`` accept almost anything; then
    the layouts of data sets, and the plain folder last.
    """
    return [*(name for name in READERS if name not in _BUILT_IN), *(name for name in _BUILT_IN if name in READERS)]


def find_reader(path: Path, name: str | None = None) -> Reader:
    """Reader of a path: the first whose layout matches.

    Args:
        path: existing file or folder.
        name: use this reader, whatever the path looks like.

    Raises:
        DvoError: no reader of that name, or none for this path.
    """
    if name is not None:
        return READERS.resolve(name)
    for candidate in names_in_order():
        reader: Reader = READERS.resolve(candidate)
        if reader.matches(path):
            return reader
    if path.is_fifo() or path.is_char_device():
        remedy = f"give images of a pipe as standard input: - < {path}"
        raise DvoError("a pipe or a device, no file", file=path, remedy=remedy)
    raise DvoError("neither a file nor a folder", file=path, remedy="give a video, a folder of images or a sequence")


def is_dataset(path: Path) -> bool:
    """True if a path has the layout of a data set or is a sequence folder; False for a plain folder or a video.

    Args:
        path: existing file or folder.
    """
    return path.is_dir() and find_reader(path).name not in ("video", "folder")
