"""Calibrations that NumPy has saved: ``np.savez("calib.npz", mtx=K, dist=D)``, as in OpenCV's tutorial, or K alone."""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import MAX_BYTES
from dvo.data.calibration.calibration import EXPECTED, Calibration, Dialect
from dvo.data.calibration.values import from_matrix, from_values

SUFFIXES = (".npz", ".npy")
_LARGEST = 16  # numbers of an array that is read: poses and corners of the board stand beside the camera
_LARGEST_BYTES = 4096  # of the file of such an array
_UNREAD = "array that is not read"  # so that coefficients of a lens are refused by their name, and others ignored
_DAMAGED = (zipfile.BadZipFile, zlib.error, struct.error)


def numpy_calibration(path: Path, camera: int | None) -> Calibration:
    """Calibration of named arrays, or of a matrix K.

    Args:
        path: of the file. Nothing that is pickled is read.
        camera: number of the camera in a file of several; None for the first or the left one.

    Raises:
        DvoError: a file that NumPy cannot read without pickle, or see
            :func:`dvo.data.calibration.values.from_values`.
    """
    try:
        if path.suffix.lower() == ".npy" and path.stat().st_size > MAX_BYTES:
            raise DvoError(f"larger than {MAX_BYTES // 1024:,} kB", file=path, remedy=EXPECTED)
        with path.open("rb") as stream:
            found = np.load(stream, allow_pickle=False)
            if isinstance(found, np.ndarray):
                return from_matrix(found.astype(np.float64), path)
            sizes = [member.file_size for member in found.zip.infolist()]
            arrays = {
                name: _small(found, name) if size <= _LARGEST_BYTES else _UNREAD
                for name, size in zip(found.files, sizes, strict=True)
            }
    except (OSError, ValueError, TypeError, EOFError, MemoryError, RuntimeError, KeyError, *_DAMAGED) as error:
        message = f"not an array of NumPy without pickle ({' '.join(str(error).split())[:80]})"
        raise DvoError(message, file=path, field="calibration", remedy=EXPECTED) from None
    return from_values(arrays, path, camera)


def _small(found: Any, name: str) -> Any:
    """An array as plain values; a word for one of more numbers, and for one that is pickled."""
    try:
        array = found[name]
    except ValueError:
        return _UNREAD
    return array.tolist() if array.size <= _LARGEST and array.dtype.kind in "fiubU" else _UNREAD


DIALECT = Dialect(
    lambda path, text: path.suffix.lower() in SUFFIXES, lambda path, text, camera: numpy_calibration(path, camera)
)
