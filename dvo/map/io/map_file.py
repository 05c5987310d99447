"""Container of a map file: a zip file of ``map.json`` and arrays as ``.npy``, all of them stored without compression.

Nothing in it is executed or unpickled, and nothing needs more memory than the file is long: an entry that is compressed
is refused. ``unzip`` and ``numpy.load`` read it as well. What the arrays mean is for the caller
(:mod:`dvo.map.io.serialisation`, :mod:`dvo.odometry.patch.map_tables`); here their types, sizes and ranges are checked.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.limits import limit_error
from dvo.core.settings import from_table
from dvo.data.files.files import is_file, lookups
from dvo.data.files.output import replaced

FORMAT, VERSION = "dvo-map", 3
"""Name of the format, and the version that is written. Files of older versions are read, newer ones refused."""

_DESCRIPTION = "map.json"
_LARGEST_DESCRIPTION = 2**24  # bytes
_DIGITS = 19  # of a whole number in the description
_LARGEST = {np.dtype(np.float16): 65504.0, np.dtype(np.float32): 1e9, np.dtype(np.float64): 1e12}
_UNIT = 1e-2  # largest deviation of the length of a quaternion from 1
_FARTHEST, _SMALLEST_SCALE = 1e9, 1e-9  # of similarities
_LARGE = 2**27  # bytes of a file that memory may not hold
_REMEDY = "give a map file as dvo has written it"
_HEADER = re.compile(
    rb"\{'descr': '([<|][a-z][0-9])', 'fortran_order': False, 'shape': \(((?:[0-9]{1,12},? ?){0,8})\), \} *\n"
)
_T = TypeVar("_T")


def write_map_file(file: str | Path, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a map file. An existing file is replaced as a whole, once the new one is complete.

    Args:
        file: its folder is made if need be.
        description: JSON-able values; name and version of the format are added.
        arrays: by name, which may have slashes.

    Raises:
        DvoError: the file cannot be written.
    """
    path = Path(file)
    text = json.dumps({"format": FORMAT, "version": VERSION, **description}, indent=1, allow_nan=False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as container:
            container.writestr(zipfile.ZipInfo(_DESCRIPTION), text)
            for name, array in arrays.items():
                content = io.BytesIO()
                np.lib.format.write_array(content, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
                container.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getbuffer())
    except OSError as error:
        raise DvoError(
            f"cannot be written ({error.strerror or error})", file=path, remedy="make space, or give another file"
        ) from error


@contextmanager
def open_map_file(file: str | Path) -> Iterator[MapReader]:
    """Open a map file.

    Args:
        file: path.

    Yields:
        Its reader, for the time of the block.

    Raises:
        DvoError: no such file, no map, or one of a newer version.
    """
    path = Path(file)
    if not is_file(path):
        raise DvoError("no such file", file=path, remedy="give a file that dvo has saved, such as map.dvo")
    with lookups(path):
        try:
            container = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, ValueError, NotImplementedError, OverflowError, MemoryError) as error:
            message = f"not a map file ({error})"
            raise _too_large(path, error) or DvoError(message, file=path, remedy=_REMEDY) from error
        with container:
            yield MapReader(path, container)


def _too_large(file: Path, error: Exception) -> DvoError | None:
    """Error of a file that memory cannot hold; a short one that asks for much is damaged."""
    return limit_error(error, file) if file.stat().st_size >= _LARGE else None


class MapReader:
    """Checked access to a map file.

    Args:
        file: for messages.
        container: the open file.

    Attributes:
        file: the file.
        description: its JSON values.
        version: of the format.

    Raises:
        DvoError: entries that no map has, or a description that is not one of a known version.
    """

    def __init__(self, file: Path, container: zipfile.ZipFile) -> None:
        self.file, self._container = file, container
        self._entries = {entry.filename: entry for entry in container.infolist()}
        if len(self._entries) < len(container.infolist()):
            raise self.refused("entries of the same name")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in self._entries.values()):
            raise self.refused("compressed entries")
        if sum(entry.file_size for entry in self._entries.values()) > file.stat().st_size:
            raise self.refused("entries that are longer than the file")
        self.description = self._described()
        self.version = int(self.description["version"])

    def refused(self, problem: str, field: str | None = None, remedy: str = _REMEDY) -> DvoError:
        """Describe a problem of the file.

        Args:
            problem: in one sentence.
            field: array or value with the problem.
            remedy: instruction to fix it.

        Returns:
            Exception to raise.
        """
        return DvoError(problem, file=self.file, field=field, remedy=remedy)

    def require(self, condition: object, problem: str, field: str) -> None:
        """Refuse the file unless a condition holds.

        Args:
            condition: whose truth is required.
            problem: sentence for the message.
            field: array or value with the problem.

        Raises:
            DvoError: the condition does not hold.
        """
        if not condition:
            raise self.refused(problem, field)

    def table(self, kind: type[_T], name: str) -> _T:
        """Read a table of the description.

        Args:
            kind: dataclass, see :func:`dvo.core.settings.from_table`.
            name: of the table.

        Returns:
            The instance.

        Raises:
            DvoError: there is none, or one of its values is of another type or out of range.
        """
        try:
            return from_table(kind, self.description.get(name), self.file, name)
        except DvoError as error:  # of a constructor, which does not know the file
            if error.file is not None:
                raise
            raise self.refused(error.message, f"{name}: {error.field}") from error

    def array(
        self, name: str, dtype: Any, shape: tuple[int | None, ...], low: float | None = None, high: float | None = None
    ) -> np.ndarray:
        """Read an array.

        Args:
            name: of the array.
            dtype: of its numbers.
            shape: lengths of its axes; None for any length.
            low, high: smallest and largest number, both inclusive; None for no limit, but numbers are always finite.

        Returns:
            A writable copy.

        Raises:
            DvoError: there is no such array, or it differs from this description.
        """
        found = self._read(name, np.dtype(dtype))
        fits = len(found.shape) == len(shape) and all(b in (None, a) for a, b in zip(found.shape, shape, strict=True))
        wanted = " x ".join("any" if side is None else str(side) for side in shape)
        self.require(fits, f"has the shape {found.shape}, expected {wanted}", name)
        if found.dtype.kind == "f":
            self.require(np.isfinite(found).all(), "holds numbers that are not finite", name)
            largest = _LARGEST[found.dtype]
            low, high = -largest if low is None else low, largest if high is None else high
        if found.size and not (low is None or found.min() >= low):
            raise self.refused(f"holds {found.min()}, less than {low:g}", name)
        if found.size and not (high is None or found.max() <= high):
            raise self.refused(f"holds {found.max()}, more than {high:g}", name)
        return found

    def has(self, name: str) -> bool:
        """True if there is an array of this name.

        Args:
            name: of the array.
        """
        return f"{name}.npy" in self._entries

    def poses(self, name: str, dtype: Any, count: int | None) -> np.ndarray:
        """Read poses, with quaternions of length 1.

        Args:
            name: of the array.
            dtype: of its numbers.
            count: number of poses; None for any.

        Returns:
            ``(count, 7)``.

        Raises:
            DvoError: as :meth:`array`, or another quaternion.
        """
        found = self.array(name, dtype, (count, 7))
        lengths = np.linalg.norm(found[:, 3:].astype(np.float64), axis=1)
        self.require((np.abs(lengths - 1) < _UNIT).all(), "holds rotations that are no unit quaternions", name)
        return found

    def similarities(self, name: str, count: int | None = None) -> np.ndarray:
        """Read similarities, with positive scales and quaternions of length 1.

        Args:
            name: of the array.
            count: number of similarities; None for any.

        Returns:
            ``(N, 8)`` float64.

        Raises:
            DvoError: as :meth:`array`, or another quaternion or scale.
        """
        found = self.array(name, np.float64, (count, 8), -_FARTHEST, _FARTHEST)
        lengths = np.linalg.norm(found[:, 3:7], axis=1)
        valid = (found[:, 7] > _SMALLEST_SCALE).all() and (np.abs(lengths - 1) < _UNIT).all()
        self.require(valid, "holds no similarities", name)
        return found

    def _described(self) -> dict[str, Any]:
        entry = self._entries.get(_DESCRIPTION)
        if entry is None or entry.file_size > _LARGEST_DESCRIPTION:
            raise self.refused("holds no description of a map", _DESCRIPTION)
        try:
            found = json.loads(self._bytes(_DESCRIPTION), parse_constant=_refuse_constant, parse_int=_whole)
        except (ValueError, RecursionError) as error:
            raise self.refused(f"not valid JSON ({str(error)[:100]})", _DESCRIPTION) from error
        self.require(isinstance(found, dict) and found.get("format") == FORMAT, "not a map of dvo", "format")
        version = found.get("version")
        whole = isinstance(version, int) and not isinstance(version, bool) and version >= 1
        self.require(whole, "not a number of a version", "version")
        if version > VERSION:
            raise self.refused(
                f"version {version} of the format is newer than {VERSION}, the newest that this dvo reads",
                "version",
                "update dvo",
            )
        return found

    def _bytes(self, name: str) -> bytes:
        try:
            return self._container.read(name)
        except (zipfile.BadZipFile, ValueError, NotImplementedError, RuntimeError, EOFError, MemoryError) as error:
            raise _too_large(self.file, error) or self.refused(f"damaged ({str(error)[:100]})", name) from error

    def _read(self, name: str, dtype: np.dtype) -> np.ndarray:
        """Array of an entry, of the given type and any shape."""
        entry = f"{name}.npy"
        if entry not in self._entries:
            raise self.refused("is missing", name)
        content = self._bytes(entry)
        length = int.from_bytes(content[8:10], "little")
        header = _HEADER.fullmatch(content[10 : 10 + length])
        if content[:8] != b"\x93NUMPY\x01\x00" or header is None:
            raise self.refused("not an array", name)
        found = header[1].decode()
        self.require(found == dtype.str, f"holds numbers of the type {found}, expected {dtype.str}", name)
        shape = tuple(int(side) for side in header[2].replace(b",", b" ").split())
        count = 1
        for side in shape:
            count *= side
        if count * dtype.itemsize != len(content) - 10 - length:
            raise self.refused(f"does not have the length that its shape {shape} needs", name)
        try:
            return np.frombuffer(content[10 + length :], dtype).reshape(shape).copy()
        except ValueError as error:  # an empty array whose other axes are too long
            raise self.refused(f"has an impossible shape {shape}", name) from error


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number of JSON")


def _whole(text: str) -> int:
    if len(text) > _DIGITS + 1:
        raise ValueError("a whole number of too many digits")
    return int(text)
