"""Output files of a run: trajectory.txt, map.ply and run.json. (:mod:`dvo.viz.plot` draws trajectory.png.)"""

from __future__ import annotations

import importlib.metadata
import json
import math
import platform
import sys
from dataclasses import asdict, is_dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.trajectory import write_tum
from dvo.errors import DvoError
from dvo.odometry.protocol import SparseMap
from dvo.odometry.session import Run

TRAJECTORY, MAP, PICTURE, SUMMARY = "trajectory.txt", "map.ply", "trajectory.png", "run.json"


def make_folder(out: Path | str | None, name: str) -> Path:
    """Create the results folder.

    Args:
        out: the folder; None for ``runs/<name>-<time>``.
        name: of the sequence.

    Returns:
        The folder.

    Raises:
        DvoError: the path is a file or cannot be written.
    """
    if out is None:
        base = Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
        folder, number = base, 2
        while folder.exists():
            folder, number = base.with_name(f"{base.name}-{number}"), number + 1
    else:
        folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "is not a folder" if folder.exists() else error.strerror or str(error)
        raise DvoError(reason, file=folder, field="--out", remedy="give a folder that can be written") from error
    return folder


def write_results(folder: Path, run: Run, facts: dict[str, Any]) -> None:
    """Write trajectory.txt, map.ply and run.json.

    Args:
        folder: an existing folder; files of these names in it are replaced.
        run: record of the session.
        facts: metadata of the caller (source, seed, device, config, metrics), the first entries of run.json.
    """
    write_tum(folder / TRAJECTORY, run.result.trajectory)
    write_ply(folder / MAP, run.result.map)
    text = json.dumps(jsonable({**facts, **summary(run)}), indent=2, allow_nan=False)
    (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")


def summary(run: Run) -> dict[str, Any]:
    """Measured part of run.json: counts, speed, memory, versions, warnings and the odometry's own metadata.

    Args:
        run: record of the session.

    Returns:
        Values for :func:`jsonable`.
    """
    result = run.result
    return {
        "frames": {
            "read": result.frames_read,
            "fed": run.frames_fed,
            "tracked": len(result.trajectory),
            "lost": result.frames_lost,
        },
        "fps": round(run.frames_per_second, 3),
        "seconds": {name: round(value, 3) for name, value in run.seconds.items()},
        "peak_memory_mb": peak_memory_mb(),
        "map_points": len(result.map.points),
        "interrupted": run.interrupted,
        "warnings": list(run.warnings),
        "config": result.info.get("config"),
        "info": {name: value for name, value in result.info.items() if name != "config"},
        "versions": versions(),
    }


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


def versions() -> dict[str, str]:
    """Versions of the software that results depend on.

    Returns:
        Name to version, for Python, the platform and the numerical packages.
    """
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("dvo", "torch", "numpy", "opencv-python-headless"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # run from a checkout, or another build of the package
            module = sys.modules.get({"opencv-python-headless": "cv2"}.get(name, name))
            found[name] = str(getattr(module, "__version__", "unknown"))
    return found


def peak_memory_mb() -> float | None:
    """Peak resident memory of this process.

    Returns:
        MB, or None on systems that do not report it (Windows).
    """
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1e6 if sys.platform == "darwin" else 1e3 / 1.024), 1)


def jsonable(value: Any) -> Any:
    """Convert to plain JSON values.

    Args:
        value: dataclass, enum, path, array, container or scalar.

    Returns:
        Dictionaries, lists, strings, numbers, booleans and None; numbers that are not finite become None.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return jsonable(asdict(value))
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [jsonable(item) for item in value]
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, np.generic):
        return jsonable(value.item())
    if isinstance(value, Enum):
        return jsonable(value.value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)
