"""YAML of bounded size as plain values: no file makes the reader hang, exhaust the memory, or run code."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError

MAX_BYTES = 1024**2
"""Largest file."""

MAX_NODES = 20_000
"""Largest number of values, keys and containers, aliases expanded."""

MAX_DEPTH = 32
"""Deepest nesting, aliases expanded."""

MAX_NUMBER = 100
"""Longest number, characters."""

_CHECKED = {"int": "a whole number", "float": "a number", "bool": "true or false", "timestamp": "a date"}


def read_yaml(file: str | Path, remedy: str = "fix the file") -> Any:
    """Read a YAML file.

    Args:
        file: path.
        remedy: for messages.

    Returns:
        Dictionaries, lists, texts, numbers, booleans, dates, or None for an empty file.

    Raises:
        DvoError: no such file, no text in UTF-8, or see :func:`parse_yaml`.
    """
    path = Path(file)
    return parse_yaml(read_text(path, remedy), path, remedy=remedy)


def is_shell_pipe(path: Path) -> bool:
    """True for a pipe that a shell has opened, as for ``<(command)`` and ``/dev/stdin``: reading it comes to an end.

    A named pipe might wait for a writer forever.

    Args:
        path: any.
    """
    opened = str(path) == "/dev/stdin" or str(path.parent) in ("/dev/fd", "/proc/self/fd")
    try:
        return opened and path.is_fifo()
    except (OSError, ValueError):
        return False


def read_text(file: Path, remedy: str = "fix the file", limit: int = MAX_BYTES) -> str:
    """Read a text file in UTF-8, with a byte order mark or without.

    Args:
        file: path.
        remedy: for messages.
        limit: largest size, bytes.

    Raises:
        DvoError: no such file, a larger one, or another encoding.
    """
    if not (file.is_file() or is_shell_pipe(file)):
        raise DvoError("no such file", file=file, remedy=remedy)
    try:
        with file.open("rb") as stream:
            data = stream.read(limit + 1)
    except OSError as error:
        raise DvoError(f"cannot be read ({error.strerror})", file=file, remedy="check the permissions") from error
    if len(data) > limit:
        raise DvoError(f"larger than {limit // 1024:,} kB", file=file, remedy=remedy)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        message = f"not UTF-8 text (byte {data[error.start]:#04x})"
        raise DvoError(message, file=file, field=f"line {line}", remedy="save it with the encoding UTF-8") from None


def parse_yaml(text: str, file: object | None = None, *, field: str | None = None, remedy: str = "fix the file") -> Any:
    """Parse one YAML document into plain values.

    Tags of other languages are refused and run nothing; matrices of OpenCV are read as tables,
    and tuples of Python as lists.

    Args:
        text: the document.
        file, remedy: for messages.
        field: for messages; the line if None.

    Returns:
        As :func:`read_yaml`.

    Raises:
        DvoError: not valid YAML; more than :data:`MAX_NODES` values or :data:`MAX_DEPTH` levels (aliases expanded); a
            key twice; an alias within its own anchor; an impossible date or number.

    Example:
        >>> parse_yaml("{patches: 48, size: [320, 240]}")
        {'patches': 48, 'size': [320, 240]}
    """
    import yaml

    loader = None
    try:
        loader = _loader()(text)
        return loader.get_single_data()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error)
        where = f"line {mark.line + 1}" if mark is not None else None
        raise DvoError(
            f"not valid YAML ({' '.join(str(problem).split())[:200]})", file=file, field=field or where, remedy=remedy
        ) from None
    finally:
        if loader is not None:
            loader.dispose()


@cache
def _loader() -> Any:
    """PyYAML's safe loader with bounds, imported on first use."""
    import yaml
    from yaml.composer import ComposerError
    from yaml.constructor import ConstructorError

    class BoundedLoader(yaml.SafeLoader):
        """Checks each node when it is composed, before any value is made of it."""

        def __init__(self, text: str) -> None:
            super().__init__(text)
            self._depth = 0
            self._extents: dict[int, tuple[int, int]] = {}  # of finished nodes by identity: values and levels in them

        def compose_node(self, parent: Any, index: Any) -> Any:
            mark = self.peek_event().start_mark
            if self.check_event(yaml.AliasEvent):
                node = super().compose_node(parent, index)
                if id(node) not in self._extents:
                    raise ComposerError(None, None, "an alias within its own anchor", mark)
                return node
            self._depth += 1
            if self._depth > MAX_DEPTH or len(self._extents) > MAX_NODES:
                self._refuse(mark)
            node = super().compose_node(parent, index)
            self._depth -= 1
            parts = []
            if isinstance(node, yaml.SequenceNode):
                parts = node.value
            elif isinstance(node, yaml.MappingNode):
                parts = [part for pair in node.value for part in pair]
                self._check_keys(node)
            within = [self._extents[id(part)] for part in parts]
            size = 1 + sum(size for size, _ in within)
            levels = 1 + max((levels for _, levels in within), default=0)
            if size > MAX_NODES or levels > MAX_DEPTH:
                self._refuse(mark)
            self._extents[id(node)] = size, levels
            return node

        def _check_keys(self, node: Any) -> None:
            seen = set()
            for key, _ in node.value:
                if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                    if (key.tag, key.value) in seen:
                        raise ComposerError(None, None, f"the key '{key.value[:60]}' twice", key.start_mark)
                    seen.add((key.tag, key.value))

        def _refuse(self, mark: Any) -> None:
            limits = f"more than {MAX_NODES:,} values or {MAX_DEPTH} levels, aliases expanded"
            raise ComposerError(None, None, limits, mark)

    def checked(kind: str) -> Any:
        construct = yaml.SafeLoader.yaml_constructors[f"tag:yaml.org,2002:{kind}"]

        def constructor(loader: Any, node: Any) -> Any:
            if len(loader.construct_scalar(node)) > MAX_NUMBER:
                raise ConstructorError(None, None, f"a number longer than {MAX_NUMBER} digits", node.start_mark)
            try:
                return construct(loader, node)
            except (ValueError, OverflowError, KeyError, IndexError, AttributeError, TypeError):
                raise ConstructorError(None, None, f"not {_CHECKED[kind]}: {node.value}", node.start_mark) from None

        return constructor

    def text(loader: Any, node: Any) -> str:
        value = loader.construct_scalar(node)
        if any(0xD800 <= ord(character) <= 0xDFFF for character in value) or "\0" in value:
            raise ConstructorError(None, None, "text with characters that no file may hold", node.start_mark)
        return value

    for kind in _CHECKED:
        BoundedLoader.add_constructor(f"tag:yaml.org,2002:{kind}", checked(kind))
    BoundedLoader.add_constructor("tag:yaml.org,2002:str", text)
    for name in ("opencv-matrix", "opencv-nd-matrix"):  # OpenCV 5 writes a vector as the latter
        BoundedLoader.add_constructor(f"tag:yaml.org,2002:{name}", _mapping)
    BoundedLoader.add_constructor("tag:yaml.org,2002:python/tuple", _sequence)  # PyYAML's dump of (640, 480)
    return BoundedLoader


def _mapping(loader: Any, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


def _sequence(loader: Any, node: Any) -> Any:
    return loader.construct_sequence(node, deep=True)
