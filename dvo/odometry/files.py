"""Files of results: whether they can be written, and the map as PLY."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import numpy as np

from dvo.data.output import PART
from dvo.errors import DvoError
from dvo.odometry.protocol import SparseMap


def check_writable(folder: Path) -> None:
    """Write a small file into a folder and remove it.

    Args:
        folder: an existing folder.

    Raises:
        OSError: the folder cannot be written, or there is no space.
    """
    probe = folder / f"{PART}probe-{os.getpid()}"
    try:
        with open(probe, "xb") as file:
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)


def write_error(path: Path, error: OSError) -> DvoError:
    """Describe a file that could not be written.

    Args:
        path: the file.
        error: exception of the system.

    Returns:
        Exception to raise.
    """
    return DvoError(
        f"cannot be written ({error.strerror or error})",
        file=path,
        remedy="make space, or give another folder with --out",
    )


def write_ply(path: Path | str, sparse_map: SparseMap) -> None:
    """Write a map as binary little-endian PLY with ``x y z`` float and ``red green blue`` uchar.

    Args:
        path: file to write.
        sparse_map: the points.
    """
    layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(len(sparse_map.points), dtype=layout)
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = sparse_map.points[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = sparse_map.colors[:, column]
    header = ["ply", "format binary_little_endian 1.0", "comment dvo sparse map", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += ["end_header\n"]
    with open(path, "wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(vertices.tobytes())
