"""Text of calibration files as plain values: YAML as OpenCV takes it, JSON, TOML, OpenCV's XML, ROS's ost."""

from __future__ import annotations

import configparser
import json
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from dvo.core.errors import DvoError
from dvo.core.yaml_files import MAX_DEPTH, parse_yaml
from dvo.data.calibration.calibration import EXPECTED

_TIGHT = re.compile(r"^(\s*[A-Za-z_][\w.]*):(?=[\w.+\-\"'\[{])", re.MULTILINE)  # OpenCV reads "Viewer.PointSize:2"
_PADDED = re.compile(r"(?<=[ \[,])0+(?=[1-9][0-9]*(?:[ ,\]]|$))", re.MULTILINE)  # no octal numbers
_COMMENT = re.compile(r"^[ \t]*//.*$", re.MULTILINE)  # OpenCV writes such lines into JSON
_END = re.compile(r"^(?:---|\.\.\.)(?=\s|$)", re.MULTILINE)
_SECTION = re.compile(r"\[[A-Za-z][^\[\],=]*\](?:\s*[#;].*)?")
_HEADING = re.compile(r"[A-Za-z][A-Za-z _]*")


def load_documents(text: str, path: Path) -> list[Any]:
    """Parse YAML of one document or several, also with OpenCV's ``%YAML:1.0`` head, its tags of matrices, keys
    without a blank after the colon, zeros before a number, and tabs for blanks.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Returns:
        Plain data of each document that holds anything.

    Raises:
        DvoError: not valid YAML, see :func:`dvo.core.yaml_files.parse_yaml`.
    """
    lines = ["" if line.startswith("%") else line for line in text.replace("\t", " ").splitlines()]
    parts = _END.split("\n".join(lines))
    found = [parse_yaml(_PADDED.sub("", _TIGHT.sub(r"\1: ", part)), path, remedy=EXPECTED) for part in parts]
    return [document for document in found if document is not None]


def load_yaml(text: str, path: Path) -> Any:
    """The first document of :func:`load_documents`; None for a file without any.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Raises:
        DvoError: not valid YAML.
    """
    return next(iter(load_documents(text, path)), None)


def load_json(text: str, path: Path) -> Any:
    """Parse JSON.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Raises:
        DvoError: not valid JSON, or a key twice.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError("a key twice")
        return found

    try:
        return json.loads(_COMMENT.sub("", text), object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        message = f"not valid JSON ({' '.join(str(error).split())[:100]})"
        raise DvoError(message, file=path, field="calibration", remedy=EXPECTED) from None


def load_toml(text: str, path: Path) -> Any:
    """Parse TOML.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Raises:
        DvoError: not valid TOML.
    """
    try:
        return tomllib.loads(text.replace("\r\n", "\n"))
    except (ValueError, RecursionError) as error:
        message = f"not valid TOML ({' '.join(str(error).split())[:100]})"
        raise DvoError(message, file=path, field="calibration", remedy=EXPECTED) from None


def load_xml(text: str, path: Path) -> Any:
    """Parse the XML of OpenCV's FileStorage, and other XML of elements and attributes.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Returns:
        Dictionaries, lists, numbers and texts.

    Raises:
        DvoError: not valid XML, one with entities of its own, or nested too deeply.
    """
    return _value(xml_root(text, path), path, 0)


def xml_root(text: str, path: Path) -> ElementTree.Element:
    """Root element of XML.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Raises:
        DvoError: not valid XML, or one with entities of its own.
    """
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise DvoError("XML with declarations", file=path, field="calibration", remedy=EXPECTED)
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise DvoError(f"not valid XML ({error})", file=path, field="calibration", remedy=EXPECTED) from None


def _value(element: Any, path: Path, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise DvoError("XML nested too deeply", file=path, field="calibration", remedy=EXPECTED)
    attributes = [(name, _of_text(text)) for name, text in element.attrib.items() if name != "type_id"]
    if len(element) or (attributes and not (element.text or "").strip()):
        children = [(child.tag, _value(child, path, depth + 1)) for child in element]
        if children and all(tag == "_" for tag, _ in children):
            return [value for _, value in children]
        children += attributes
        found = dict(children)
        if len(found) < len(children):
            raise DvoError("a key twice", file=path, field=str(element.tag)[:60], remedy=EXPECTED)
        if "data" in found and not isinstance(found["data"], list):
            found["data"] = [found["data"]]
        return found
    return _of_text(element.text or "")


def _of_text(text: str) -> Any:
    words = text.split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return " ".join(words).strip('"')
    return None if not numbers else numbers[0] if len(numbers) == 1 else numbers


def is_ost(text: str) -> bool:
    """True for the text of ROS's camera_calibration: ``ost.txt`` or ``*.ini``.

    Args:
        text: of the file.
    """
    return re.search(r"^camera matrix\s*$", text, re.MULTILINE) is not None


def load_ost(text: str, path: Path) -> Any:
    """Parse ROS's ``ost.txt``: ``[sections]``, headings, and the numbers below each.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Returns:
        Section to heading to a number, or the rows of numbers; ``width`` and ``height`` of ``[image]`` at the top.

    Raises:
        DvoError: numbers without a heading, or a heading twice.
    """
    found: dict[str, Any] = {}
    section, rows = found, None
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.split("#")[0].strip()
        if not line:
            continue
        if line.startswith("[") and line.endswith("]"):
            name = line[1:-1].strip() or "camera"
            section, rows = (found if name == "image" else found.setdefault(name, {})), None
            continue
        if _HEADING.fullmatch(line) and line.lower() not in ("nan", "inf"):
            rows = section.setdefault(line, [])
            if rows:
                raise DvoError(f"{line!r} twice", file=path, field=f"line {number}", remedy=EXPECTED)
            continue
        try:
            numbers = [float(word) for word in line.split()]
        except ValueError:
            numbers = []
        if rows is None or not numbers:
            raise DvoError(f"not understood: {line[:60]!r}", file=path, field=f"line {number}", remedy=EXPECTED)
        rows.append(numbers)
    for part in (found, *(value for value in found.values() if isinstance(value, dict))):
        for key, value in part.items():
            if isinstance(value, list):
                part[key] = value[0][0] if len(value) == 1 and len(value[0]) == 1 else value
    return found


def is_ini(text: str) -> bool:
    """True for text whose first line is a ``[section]``.

    Args:
        text: of the file.
    """
    lines = map(str.strip, text.splitlines())
    first = next((line for line in lines if line and line[0] not in "#;"), "")
    return _SECTION.fullmatch(first) is not None


def load_ini(text: str, path: Path) -> Any:
    """Parse ``[sections]`` of ``name = value``; values that are JSON or texts.

    Args:
        text: of the file.
        path: file that it comes from, for messages.

    Raises:
        DvoError: lines of another form, or a name twice.
    """
    parser = configparser.RawConfigParser(inline_comment_prefixes=("#", ";"), allow_no_value=True)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    try:
        parser.read_string(text)
    except configparser.Error as error:
        message = f"not understood ({' '.join(error.message.split())[:120]})"
        raise DvoError(message, file=path, field="calibration", remedy=EXPECTED) from None
    return {name: {key: _of_option(value) for key, value in parser.items(name)} for name in parser.sections()}


def _of_option(text: str | None) -> Any:
    try:
        return json.loads(text or "null")
    except (ValueError, RecursionError):
        return _of_text(text or "")
