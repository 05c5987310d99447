"""Outputs of a command must not be its inputs, however their paths are spelled."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.files.output import LOCK
from dvo.session.results import CALIBRATION, EXPORT, is_result

_OUR_KINDS = (".dvo", ".rrd", ".mp4", ".avi")
_Given = Mapping[str, Path | str | None]


def check_outputs(
    outputs: _Given, inputs: _Given, source: Path | str | None = None, folder: Path | None = None
) -> None:
    """Check that no output of a command is one of its inputs, or another output of it.

    Files are the same by identity: links and other spellings of a path do not hide one.

    Args:
        outputs: files that will be created or replaced, by option; None for options that are not given.
        inputs: files and folders that are read, by option. A relative path is also looked up in the folder of the
            source, and a suffix ``:ID`` of a calibration does not count.
        source: file or folder that is read; of a folder, an existing file in it is an input too unless its name ends
            as that of the output's kind.
        folder: of results, the files in which may be replaced.

    Raises:
        DvoError: an output that is an input; the message names both.
    """
    written = {option: Path(path) for option, path in outputs.items() if path}
    for option, output in written.items():
        for name, path in inputs.items():
            if path and any(os.path.lexists(place) and _is_same(output, place) for place in places(path, source)):
                raise _error(output, option, name)
        if source and _is_same(output, Path(source)):
            raise _error(output, option, "the source")
        if source and _is_in(output, Path(source)) and not _is_of_our_kind(output):
            raise _error(output, option, "the source")
        for other, path in written.items():
            if other != option and _is_same(output, path):
                raise DvoError(f"is also the file of {other}", file=output, field=option, remedy="give another file")
        if folder is not None and _is_taken(output, folder):
            raise DvoError("is a file of the results", file=output, field=option, remedy="give another file")
    if folder is None:
        return
    for name, path in {**inputs, "the source": source}.items():
        for place in places(path, source) if path else ():
            within = is_result(place.name) and _is_same(place.parent, folder)
            if os.path.lexists(place) and (within or _is_in(place, folder / EXPORT)):
                raise _error(place, "--out", name)


def check_apart(folder: Path, source: Path | str, images: Sequence[Path] | None) -> None:
    """Check that results do not lie among the images that were read, whose reader would take the pictures for frames.

    Args:
        folder: of the results.
        source: that is read.
        images: of the source; None for a video or a stream.

    Raises:
        DvoError: it is the folder of the images, or that of the sequence.
    """
    if images and any(_is_same(folder, place) for place in (images[0].parent, Path(source))):
        message = "is the folder of the images, among which the pictures of the results would be read the next time"
        raise DvoError(message, file=folder, field="--out", remedy="give a folder beside or within it")


def _is_of_our_kind(output: Path) -> bool:
    """True for a name, of the file itself where it is a link, that only an output has."""
    return all(Path(path).suffix.lower() in _OUR_KINDS for path in (output, os.path.realpath(output)))


def _is_taken(output: Path, folder: Path) -> bool:
    """True for a file that the run itself writes into its results folder."""
    place, folder = Path(os.path.realpath(output)), Path(os.path.realpath(folder))
    if _is_same(place.parent, folder):
        return is_result(place.name) or place.name in (CALIBRATION, EXPORT, LOCK)
    return place.is_relative_to(folder / EXPORT)


def _error(file: Path, option: str, name: str) -> DvoError:
    what = name if name == "the source" else f"the file of {name}"
    return DvoError(f"is {what}, which it would replace", file=file, field=option, remedy="give another place")


def places(path: Path | str, source: Path | str | None) -> Iterator[Path]:
    """Files that the value of an option may name, in the order in which they are looked up.

    Args:
        path: the value; a suffix ``:ID`` of a calibration is left out too, and several files are parted at commas.
        source: in whose folder a relative path is looked up after the working directory.
    """
    spellings = [str(path)]
    head, colon, _ = str(path).rpartition(":")
    if colon and head:
        spellings.append(head)  # of several cameras, the one with an identifier
    if "," in str(path):
        spellings += filter(None, str(path).split(","))  # several files
    for text in spellings:
        yield Path(text)
        if source and not os.path.isabs(text):
            base = Path(source) if Path(source).is_dir() else Path(source).parent
            yield base / text


def _is_same(first: Path, second: Path) -> bool:
    try:
        return os.path.samefile(first, second)
    except (OSError, ValueError):  # one is missing, or no path at all
        return os.path.realpath(first) == os.path.realpath(second)


def _is_in(file: Path, folder: Path) -> bool:
    """True for an existing file somewhere in a folder."""
    if not (folder.is_dir() and file.exists()):
        return False
    return any(_is_same(parent, folder) for parent in Path(os.path.realpath(file)).parents)
