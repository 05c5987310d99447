"""Files of results: errors of writing them, and the map as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.odometry.protocol import SparseMap

_PLY_LAYOUT = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]


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
    vertices = np.zeros(len(sparse_map.points), dtype=_PLY_LAYOUT)
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


def read_ply(path: Path) -> SparseMap:
    """Read a map that :func:`write_ply` has written.

    Args:
        path: the file.

    Returns:
        The points.

    Raises:
        DvoError: the file cannot be read, or has another layout.
    """
    remedy = "give a map that dvo has written"
    try:
        header, end, body = path.read_bytes().partition(b"end_header\n")
    except OSError as error:
        raise DvoError(error.strerror or str(error), file=path, remedy=remedy) from error
    lines = header.decode("ascii", "replace").splitlines()
    properties = [line.split()[-1] for line in lines if line.startswith("property ")]
    if not end or "format binary_little_endian 1.0" not in lines or properties != [name for name, _ in _PLY_LAYOUT]:
        raise DvoError("not a map of dvo", file=path, remedy=remedy)
    layout = np.dtype(_PLY_LAYOUT)
    if len(body) % layout.itemsize or f"element vertex {len(body) // layout.itemsize}" not in lines:
        raise DvoError("the number of points differs from its header", file=path, remedy=remedy)
    vertices = np.frombuffer(body, layout)
    points = np.column_stack([vertices[name] for name in ("x", "y", "z")]).astype(np.float32)
    return SparseMap(points, np.column_stack([vertices[name] for name in ("red", "green", "blue")]))
