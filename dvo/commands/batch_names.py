"""Names of the results folders of many videos, and the placeholders in options that name a file for each."""

from __future__ import annotations

import json
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dvo.commands.request import SOURCE
from dvo.commands.run_options import INPUTS, OUTPUTS
from dvo.core.errors import DvoError
from dvo.data.readers.rosbag import split_topic
from dvo.session.results import SUMMARY
from dvo.session.run_facts import read_json

TABLE, LOGS = "batch.csv", "logs"
_RESERVED = {TABLE, LOGS, "con", "prn", "aux", "nul"}  # the last four are devices of Windows
_LONGEST = 100  # bytes of a name
_PLACEHOLDER = re.compile(r"\{(\w*)\}")


def folder_names(sources: Sequence[str], out: Path) -> list[str]:
    """Names of the folders of some sources, which differ in more than the case of letters.

    A source that has a folder keeps it. The others are named after their file or folder, with the names of parents
    before it where several would have the same.

    Args:
        sources: absolute paths, each once; with the topic of a bag behind it, if one is given.
        out: folder of the results; may be missing.

    Returns:
        A name for each source, of letters, digits, ``_``, ``.`` and ``-``.
    """
    owners = _owners(out)
    paths = [split_topic(source, None)[0] for source in sources]
    beside = Counter(_key(str(path.parent / path.stem)) for path in paths)
    bags = Counter(map(str, paths))
    candidates = []
    for source, path in zip(sources, paths, strict=True):
        # Of walk.mp4 and walk.avi in one folder, and of topics of one bag, the stem says too little.
        last = path.name if beside[_key(str(path.parent / path.stem))] > 1 else stem_of(path)
        last += source[len(str(path)) :] if bags[str(path)] > 1 else ""
        candidates.append(list(_candidates(last, path)))
    names: dict[int, str] = {}
    taken = {_key(name) for name in owners} | _RESERVED
    for number, path in enumerate(paths):
        if bags[str(path)] > 1:
            continue  # the folder does not tell for which topic it is; settled by its name below
        mine = [name for name in candidates[number] if owners.get(name) == str(path)]
        mine += sorted(name for name, owner in owners.items() if owner == str(path))
        if mine:
            names[number] = mine[0]
    left = [number for number in range(len(paths)) if number not in names]
    for level in range(max(map(len, candidates), default=0)):
        wanted = {number: candidates[number][min(level, len(candidates[number]) - 1)] for number in left}
        counts = Counter(_key(name) for name in wanted.values())
        for number, name in wanted.items():
            is_own = bags[str(paths[number])] > 1 and owners.get(name) == str(paths[number])
            if counts[_key(name)] == 1 and (_key(name) not in taken or is_own):
                names[number] = name
                taken.add(_key(name))
        left = [number for number in left if number not in names]
    for number in left:
        name = candidates[number][0]
        names[number] = next(found for k in range(2, len(taken) + 3) if _key(found := f"{name}-{k}") not in taken)
        taken.add(_key(names[number]))
    return [names[number] for number in range(len(paths))]


def stem_of(path: Path) -> str:
    """Name of a file without its extension, or of a folder.

    Args:
        path: absolute.
    """
    return path.name if path.is_dir() else path.stem


def filled(options: Mapping[str, Any], path: Path, name: str) -> dict[str, Any]:
    """Options of one video.

    Args:
        options: of all, with placeholders.
        path: of the video, absolute.
        name: of its results folder.

    Returns:
        Options without placeholders. Files that are written, and those that are found from the working directory, have
        absolute paths.

    Raises:
        DvoError: an unknown placeholder, or a pipe, which can be read once only.
    """
    values = {"stem": stem_of(path), "name": name}

    def value_of(found: re.Match[str]) -> str:
        return values[found[1]]

    result = dict(options)
    for option in (*INPUTS, *OUTPUTS):
        text = options.get(option)
        if not text:
            continue
        unknown = next((found[0] for found in _PLACEHOLDER.finditer(text) if found[1] not in values), None)
        if unknown is not None:
            remedy = "write {stem}, the name of the video without its extension, or {name}, that of its results folder"
            raise DvoError(f"unknown placeholder {unknown[:40]}", field=_flag(option), remedy=remedy)
        text = _PLACEHOLDER.sub(value_of, text)
        head, _, _ = text.rpartition(":")  # of a calibration of several cameras, before the identifier
        is_there = any(Path(place).exists() for place in (text, head) if place)
        if is_there and Path(text).is_fifo():
            raise DvoError("a pipe can be read for one video only", field=_flag(option), remedy="give a file")
        result[option] = os.path.abspath(text) if is_there or option in OUTPUTS else text
    return result


def has_name(text: str) -> bool:
    """True if a path has a placeholder that differs for all videos.

    Args:
        text: value of an option.
    """
    return any(found[1] == "name" for found in _PLACEHOLDER.finditer(text))


def _candidates(last: str, path: Path) -> Iterator[str]:
    """Names of a source, the shortest first."""
    parents = [part for part in path.parent.parts if part != path.anchor]
    for count in range(len(parents) + 1):
        yield _safe("-".join([*parents[len(parents) - count :], last]))


def _safe(text: str) -> str:
    """Text of characters that every file system and shell takes."""
    text = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", text)).strip("._-") or "video"
    text = text.encode()[-_LONGEST:].decode("utf-8", "ignore").lstrip("._-")  # the end is what differs
    return f"{text}_" if _key(text) in _RESERVED else text


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _owners(out: Path) -> dict[str, str]:
    """Sources of the results that a folder holds, by the name of their folder."""
    owners = {}
    for file in sorted(out.glob(f"*/{SUMMARY}")) if out.is_dir() else ():
        try:
            facts = read_json(file)
        except DvoError:
            continue
        inputs = facts.get("inputs")
        found = inputs.get(SOURCE) if isinstance(inputs, dict) else None
        path = found.get("path") if isinstance(found, dict) else facts.get("source")
        owners[file.parent.name] = os.path.abspath(path) if isinstance(path, str) else json.dumps(path)
    return owners


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
