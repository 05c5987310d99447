"""What a run was asked for, as entries of run.json, so that a later command knows whether it would do the same."""

from __future__ import annotations

import argparse
import hashlib
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dvo.commands.places import places
from dvo.commands.run_options import INPUTS, given_options
from dvo.data.readers.rosbag import split_topic
from dvo.data.streams.capture import is_stream
from dvo.session.results import jsonable

SOURCE = "source"
_WHOLE = 64 * 2**20  # bytes of a file up to which its content is compared; beyond, path and length


def request_facts(arguments: argparse.Namespace) -> dict[str, Any]:
    """Entries of run.json about the command line of ``dvo run``.

    Args:
        arguments: of the command line.

    Returns:
        See :func:`request_of`.
    """
    return request_of(arguments.source, given_options(arguments))


def request_of(source: Path | str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of run.json about a run that is asked for.

    Args:
        source: to track.
        options: of :func:`dvo.commands.run_options.given_options`.

    Returns:
        ``options`` as given; ``inputs``: for the source and each option that names a file or folder ``path``
        (absolute), ``bytes`` and ``sha256`` (None of folders and pipes; of files above 64 MiB there is no hash).
    """
    options, inputs = dict(options), {}
    if not is_stream(source):
        path, topic = split_topic(source, options.get("topic"))
        inputs[SOURCE] = _facts(path)
        options |= {} if topic is None else {"topic": topic}
    for name in INPUTS:
        text = options.get(name)
        found = next((place for place in places(text, source) if place.exists()), None) if text else None
        if found is not None:
            inputs[name] = _facts(found)
    facts: dict[str, Any] = jsonable({"options": options, "inputs": inputs})
    return facts


def differences(asked: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[str]:
    """Compare a run that is asked for with one that was made.

    Files are compared by content, folders and files above 64 MiB by path and length.

    Args:
        asked: of :func:`request_of`.
        found: content of run.json.

    Yields:
        A text for each difference, such as ``--end 60f (was 30f)``.
    """
    options, inputs = found.get("options"), found.get("inputs")
    if not isinstance(options, dict) or not isinstance(inputs, dict):
        yield "its options are not known"
        return
    if not _is_same(asked["inputs"].get(SOURCE), inputs.get(SOURCE)):
        yield "another source"
    for name in {**asked["options"], **options}:
        new, old = asked["options"].get(name), options.get(name)
        if name in asked["inputs"] and name in inputs:
            if _part(new) != _part(old) or not _is_same(asked["inputs"][name], inputs[name]):
                yield f"another file of {_flag(name)}"
        elif new != old:
            yield f"{_flag(name)}{_shown(new, ' {}', ' not given')}{_shown(old, ' (was {})', ' (was not given)')}"


def _facts(path: Path) -> dict[str, Any]:
    """Identity of a file or folder."""
    facts: dict[str, Any] = {"path": os.path.abspath(path), "bytes": None, "sha256": None}
    try:
        about = path.stat()
        if stat.S_ISREG(about.st_mode):  # the content of a pipe can be read once only
            facts["bytes"] = about.st_size
            if about.st_size <= _WHOLE:
                facts["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:  # who opens it has the error
        pass
    return facts


def _is_same(asked: Any, found: Any) -> bool:
    if not isinstance(asked, dict) or not isinstance(found, dict):
        return asked == found
    if asked.get("sha256") is not None:
        return bool(asked["sha256"] == found.get("sha256"))
    return asked == found


def _part(value: Any) -> str:
    """Identifier behind the name of a calibration of several cameras."""
    head, _, part = str(value).rpartition(":")
    return part if head and os.sep not in part else ""


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _shown(value: Any, text: str, without: str) -> str:
    return without if value is None else "" if value is True else text.format(value)
