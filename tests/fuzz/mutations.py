"""Mutations of the files of a folder: as bytes, as places in a file system, as text, and as images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.fuzz import images, text

Random = np.random.Generator
Mutation = Callable[[Path, Random], str]
HUGE = 4 * 10**9  # bytes of a sparse file


def files_of(folder: Path) -> list[Path]:
    """Regular files below a folder, sorted, without those that :func:`lengthen` made.

    Args:
        folder: of the input.
    """
    found = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sorted(path for path in found if path.stat().st_size < HUGE)


def pick(random: Random, options: list) -> object:
    """One of a list (``Generator.choice`` would turn its elements into arrays).

    Args:
        random: source of the choice.
        options: not empty.
    """
    return options[int(random.integers(len(options)))]


def flip_bytes(file: Path, random: Random) -> str:
    """Overwrite some bytes."""
    data = bytearray(file.read_bytes())
    count = int(random.integers(1, 9))
    span = len(data) if random.random() < 0.5 else min(len(data), 64)  # headers lie at the front
    for _ in range(count if span else 0):
        data[int(random.integers(span))] = int(random.integers(256))
    file.write_bytes(bytes(data))
    return f"{count} bytes overwritten"


def truncate(file: Path, random: Random) -> str:
    """Cut the end off."""
    size = int(random.integers(file.stat().st_size + 1))
    os.truncate(file, size)
    return f"cut after {size} bytes"


def empty(file: Path, random: Random) -> str:
    """Remove the content."""
    os.truncate(file, 0)
    return "emptied"


def remove(file: Path, random: Random) -> str:
    """Remove the file."""
    file.unlink()
    return "removed"


def insert_bytes(file: Path, random: Random) -> str:
    """Insert random bytes."""
    data = file.read_bytes()
    at = int(random.integers(len(data) + 1))
    file.write_bytes(data[:at] + random.bytes(int(random.integers(1, 200))) + data[at:])
    return f"random bytes inserted at {at}"


def repeat_bytes(file: Path, random: Random) -> str:
    """Repeat a part."""
    data = file.read_bytes()
    first, last = sorted(random.integers(len(data) + 1, size=2).tolist())
    file.write_bytes(data[:last] + data[first:last] * int(random.integers(1, 5)) + data[last:])
    return f"bytes {first} to {last} repeated"


def replace_by_noise(file: Path, random: Random) -> str:
    """Replace the content by noise."""
    file.write_bytes(random.bytes(int(random.integers(1, 5000))))
    return "replaced by noise"


def lengthen(file: Path, random: Random) -> str:
    """Append a hole of many gigabytes, which takes no room on the disk."""
    os.truncate(file, HUGE)
    return f"lengthened to {HUGE / 1e9:g} GB"


def replace_by_folder(file: Path, random: Random) -> str:
    """Put a folder in the file's place."""
    file.unlink()
    file.mkdir()
    return "replaced by a folder"


def replace_by_pipe(file: Path, random: Random) -> str:
    """Put a named pipe in the file's place, which nobody writes to."""
    file.unlink()
    os.mkfifo(file)
    return "replaced by a named pipe"


def replace_by_link(file: Path, random: Random) -> str:
    """Put a symbolic link in the file's place: to a device, to itself, to nothing, or out of the folder."""
    target = pick(random, ["/dev/zero", "/dev/null", "/dev/stdin", file.name, "nowhere", "/etc/hostname", "/etc", ".."])
    file.unlink()
    file.symlink_to(str(target))
    return f"replaced by a link to {target}"


def exchange(file: Path, random: Random) -> str:
    """Replace the content by that of another file of the input."""
    folder = next((parent for parent in file.parents if parent.name.startswith("case")), file.parent)
    other = pick(random, files_of(folder))
    if isinstance(other, Path) and other != file:
        shutil.copyfile(other, file)
    return f"content of {other}"


def rename(file: Path, random: Random) -> str:
    """Give the file an odd name with the same ending."""
    stems = [
        "²", "1²2", "１２", "9" * 200, "x" * 240, "a\nb", "-rf", " ", "a b", "nan", "inf", "1e999", "%n%s", "{0}", "é",
        b"\xff\xfe".decode(errors="surrogateescape"), "0.0", "9" * 20 + ".5", "1" * 17, "00000", "..x", "[1]",
    ]  # fmt: skip
    stem = pick(random, stems)
    ending = "".join(file.suffixes[-1:])
    file.rename(file.with_name(f"{stem}{ending}"))
    return f"renamed to {stem!r}{ending}"


BYTES: list[Mutation] = [
    flip_bytes, flip_bytes, flip_bytes, truncate, truncate, insert_bytes, repeat_bytes, replace_by_noise, empty,
    exchange,
]  # fmt: skip
PLACES: list[Mutation] = [
    remove, replace_by_folder, replace_by_pipe, replace_by_link, replace_by_link, rename, lengthen,
]  # fmt: skip


def mutate_file(file: Path, random: Random, formats: bool = True) -> str:
    """Change one file in one way.

    Args:
        file: regular file.
        random: source of all choices.
        formats: also use mutations that know the format of a text or an image.

    Returns:
        Description of the change.
    """
    groups: list[list[Mutation]] = [BYTES, PLACES]
    if formats and file.suffix.lower() in text.SUFFIXES:
        groups = [BYTES, PLACES, *[text.MUTATIONS] * 5]
        if file.suffix.lower() in (".yaml", ".yml"):
            groups += [text.YAML] * 2
    elif formats and file.suffix.lower() in images.SUFFIXES:
        groups += [images.MUTATIONS] * 2
    elif formats and file.suffix.lower() == ".avi":
        groups += [[images.state_frame_size]]
    group = groups[int(random.integers(len(groups)))]
    mutation = group[int(random.integers(len(group)))]
    return f"{file.name}: {mutation(file, random)}"


def mutate_text(folder: Path, random: Random) -> str:
    """Change the text of one file, which stays a file: for text that does not come from a file.

    Args:
        folder: of the input.
        random: source of all choices.

    Returns:
        Description of the change.
    """
    file = files_of(folder)[0]
    mutations = [*text.MUTATIONS, flip_bytes, truncate, empty]
    return mutations[int(random.integers(len(mutations)))](file, random)


def mutate_folder(folder: Path, random: Random) -> str:
    """Change one to three files of an input, preferring files that are few of their kind.

    Args:
        folder: of the input.
        random: source of all choices.

    Returns:
        Description of the changes.
    """
    said = []
    for _ in range(1 + int(random.choice(3, p=[0.7, 0.2, 0.1]))):
        files = files_of(folder)
        if not files:
            break
        kinds: dict[tuple[Path, str], list[Path]] = {}
        for file in files:
            kinds.setdefault((file.parent, file.suffix), []).append(file)
        kind = kinds[sorted(kinds)[int(random.integers(len(kinds)))]]
        said.append(mutate_file(kind[int(random.integers(len(kind)))], random))
    return "; ".join(said)
