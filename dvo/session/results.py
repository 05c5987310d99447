"""Results folder of a run: trajectory.txt, a trajectory file for each of several segments, map.ply and run.json.

:mod:`dvo.session.recorder` writes them while a run goes on, :mod:`dvo.viz.plot` draws trajectory.png,
:mod:`dvo.viz.run_page` summary.html, and :mod:`dvo.session.frame_table` writes frames.csv.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import itertools
import json
import math
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass, replace
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import redacted
from dvo.data.files.output import check_writable, only_writer, replaced, sweep_parts, write_text
from dvo.data.trajectory import Trajectory, tum_text
from dvo.session.files import write_error, write_ply
from dvo.session.run_facts import read_json
from dvo.session.session import Run

TRAJECTORY, MAP, PICTURE, SUMMARY = "trajectory.txt", "map.ply", "trajectory.png", "run.json"
FRAMES, PAGE = "frames.csv", "summary.html"
BASE = "trajectory_base.txt"
CLOUD, MESH = "cloud.ply", "mesh.ply"
CALIBRATION = "calib.txt"
"""Calibration file in the results folder of a run without a calibration, for the next run."""
RECORDING = "run.rrd"  # of --rerun without a display
FILES = (TRAJECTORY, MAP, PICTURE, FRAMES, PAGE, CLOUD, MESH, SUMMARY, BASE, RECORDING)
VIEWS = (PICTURE, FRAMES, PAGE)
"""Files that show what the others hold; an error in drawing one costs no other file."""
SEGMENT_FILE = re.compile(r"trajectory-\d+\.txt")
EXPORT = "export"
"""Folder of the exports in the results folder."""
_EXPORTED = re.compile(EXPORT + r"/[A-Za-z0-9_-]+")


@contextlib.contextmanager
def results_folder(
    out: Path | str | None, name: str, *, overwrite: bool = False, exports: Sequence[str] = ()
) -> Iterator[Path]:
    """Create and check the results folder, and keep other runs out of it for the time of a run.

    Nothing in it is touched here; see also :func:`locked_folder`.

    Args:
        out: the folder; None for ``runs/<name>-<time>``.
        name: of the sequence.
        overwrite: accept the results of an earlier run, which are replaced (:func:`remove_results`).
        exports: formats that the run exports to.

    Yields:
        The folder.

    Raises:
        DvoError: the path is a file or cannot be written, another run is writing into it, it holds results and
            ``overwrite`` is not set, or a file of the name of a result that no run of dvo has written.
    """
    with locked_folder(out, name) as folder:
        try:
            taken = [child.name for child in sorted(folder.iterdir()) if is_result(child.name)]
        except OSError as error:
            raise DvoError(error.strerror or str(error), file=folder, field="--out", remedy="give another") from error
        taken += [name for name in (f"{EXPORT}/{one}" for one in exports) if os.path.lexists(folder / name)]
        check_free(folder, taken, files_of_run(folder) if taken else (), overwrite)
        yield folder


@contextlib.contextmanager
def locked_folder(out: Path | str | None, name: str) -> Iterator[Path]:
    """Create and check a folder, and keep other writers out of it.

    If the block ends with an exception, a new folder that is still empty is removed.

    Args:
        out: the folder; None for ``runs/<name>-<time>``.
        name: of the sequence.

    Yields:
        The folder.

    Raises:
        DvoError: the path is a file or cannot be written, or another run is writing into it.
    """
    before = None if out is None else Path(out).exists()
    folder = make_folder(out, name)
    try:
        with only_writer(folder, "--out"):
            yield folder
    except BaseException:
        if not before:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()
        raise


def make_folder(out: Path | str | None, name: str) -> Path:
    """Create the results folder and check that files can be written into it.

    Args:
        out: the folder; None for ``runs/<name>-<time>``, a new one.
        name: of the sequence.

    Returns:
        The folder.

    Raises:
        DvoError: the path is a file or cannot be written.
    """
    folder = Path(out) if out is not None else Path("runs") / f"{name[:50]}-{datetime.now():%Y%m%d-%H%M%S}"
    is_new = False
    try:
        if out is None:
            folder = _new_folder(folder)
            is_new = True
        else:
            is_new = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
    except OSError as error:
        if is_new:
            with contextlib.suppress(OSError):
                folder.rmdir()
        reason = "is not a folder" if folder.exists() and not folder.is_dir() else error.strerror or str(error)
        raise DvoError(reason, file=folder, field="--out", remedy="give a folder that can be written") from error
    return folder


def _new_folder(base: Path) -> Path:
    """Create a folder that did not exist, with a number after its name if necessary."""
    for number in itertools.count(1):
        folder = base if number == 1 else base.with_name(f"{base.name}-{number}")
        with contextlib.suppress(FileExistsError):  # of another run that began in the same second
            folder.mkdir(parents=True)
            return folder
    raise AssertionError


def segment_file(number: int) -> str:
    """Name of the trajectory file of a segment, in a run with more than one.

    Args:
        number: of the segment, from 0.

    Returns:
        Name of the file.
    """
    return f"trajectory-{number}.txt"


def is_result(name: str) -> bool:
    """True for the name of a file that a run writes into its results folder.

    Args:
        name: of the file.
    """
    return name in FILES or SEGMENT_FILE.fullmatch(name) is not None


def files_of_run(folder: Path) -> frozenset[str]:
    """Files of the run whose results a folder holds: what a later run may replace.

    Args:
        folder: of results, or any other.

    Returns:
        Names, of exports ``export/NAME``; none without a ``run.json`` of dvo. Of a run that has not ended, and of one
        that does not list its files, all names of results.
    """
    try:
        facts = read_json(folder / SUMMARY)
    except DvoError:
        return frozenset()
    found = facts.get("versions")
    if not isinstance(found, dict) or "dvo" not in found or "odometry" not in facts:
        return frozenset()
    listed = facts.get("files")
    names = {name for name in listed if isinstance(name, str)} if isinstance(listed, list) else set()
    if not names or facts.get("finished") is not True:
        with contextlib.suppress(OSError):
            names |= {child.name for child in folder.iterdir() if is_result(child.name)}
    return frozenset(names | {SUMMARY})


def check_free(folder: Path, taken: Sequence[str], mine: Collection[str], overwrite: bool) -> None:
    """Refuse a folder with files that would be replaced, unless they are results that may be.

    Args:
        folder: of results.
        taken: names of the files that would be replaced.
        mine: names of the files that an earlier run of the command has written.
        overwrite: these may be replaced.

    Raises:
        DvoError: a file of another origin, or results that may not be replaced.
    """
    for name in taken:
        if name not in mine:
            message = "is not a file that dvo has written there, and would be replaced"
            raise DvoError(message, file=folder / name, field="--out", remedy="give a new folder")
    if taken and not overwrite:
        remedy = "give a new folder, or --overwrite to replace them"
        raise DvoError("holds results", file=folder, field="--out", remedy=remedy)


def remove_results(folder: Path) -> None:
    """Remove the results of an earlier run from a folder, and what killed runs have left; other files stay.

    Args:
        folder: the folder.

    Raises:
        OSError: a file cannot be removed.
    """
    mine = files_of_run(folder)
    for name in sorted(mine):
        if _EXPORTED.fullmatch(name):
            shutil.rmtree(folder / name, ignore_errors=True)
    with contextlib.suppress(OSError):  # missing, or with other files
        (folder / EXPORT).rmdir()
    _remove(folder, mine)
    sweep_parts(folder)


def _remove(folder: Path, names: Collection[str]) -> None:
    """Remove the results of these names, run.json last: until then the others are known to be of a run."""
    for name in sorted(filter(is_result, names), key=lambda name: name == SUMMARY):
        (folder / name).unlink(missing_ok=True)


def write_results(
    folder: Path,
    run: Run,
    facts: dict[str, Any],
    *,
    draw: Callable[[Path], None] | None = None,
    more: Mapping[str, Callable[[Path], None]] | None = None,
    page: Callable[[Path, dict[str, Any]], None] | None = None,
    segment_facts: Sequence[dict[str, Any]] = (),
    also: Callable[[], dict[str, Any]] | None = None,
) -> None:
    """Write trajectory.txt, a trajectory file for each segment if there are several, map.ply, the plot and run.json.

    Every file is replaced as a whole. After a failure the other files are written nevertheless, and run.json says that
    the results are not finished.

    Args:
        folder: an existing folder; results in it are replaced, those of segments that the run does not have removed.
        run: record of the session.
        facts: metadata of the caller (source, seed, device, config, metrics), the first entries of run.json.
        draw: writes the plot to the file that it is given.
        more: writers of further files, by name (one of :data:`FILES`).
        page: writes summary.html from the content of run.json, after the other files.
        segment_facts: further entries for each segment in run.json.
        also: writes a further file after these, anywhere, and returns entries for run.json about it.

    Raises:
        DvoError: a file cannot be written.
    """
    result = run.result
    writers: dict[str, Callable[[Path], None]] = {TRAJECTORY: _rows(result.trajectory)}
    if len(result.segments) > 1:
        for number, segment in enumerate(result.segments):
            writers[segment_file(number)] = _rows(segment.trajectory)
    writers[MAP] = lambda path: write_ply(path, result.map)
    if draw is not None:
        writers[PICTURE] = draw
    writers |= more or {}
    failures = [found for name, write in writers.items() if (found := _failure(folder / name, write))]
    if also is not None:
        try:
            facts = {**facts, **also()}
        except DvoError as error:
            failures.append(error)
    warned = replace(run, warnings=(*run.warnings, *map(str, failures)))
    values = jsonable({**facts, **summary(warned, segment_facts), "finished": not failures})
    if page is not None and (found := _failure(folder / PAGE, lambda path: page(path, values))):
        failures.append(found)
        values |= {"warnings": [*values["warnings"], str(found)], "finished": False}
    try:
        _remove(folder, {child.name for child in folder.iterdir()} - {*FILES, *writers})
        write_summary(folder, values)
    except OSError as error:
        failures.append(write_error(folder / SUMMARY, error))
    if failures:
        raise failures[0]


def _rows(trajectory: Trajectory) -> Callable[[Path], None]:
    """Writer of a trajectory file."""

    def write(path: Path) -> None:
        path.write_text(tum_text(trajectory), encoding="utf-8", newline="\n")

    return write


def _failure(file: Path, write: Callable[[Path], None]) -> DvoError | None:
    """Write a file; of what went wrong, the error."""
    try:
        with replaced(file) as part:
            write(part)
    except OSError as error:
        return write_error(file, error)
    except Exception as error:
        if file.name not in VIEWS:
            raise
        return DvoError(f"{type(error).__name__}: {error}", file=file, remedy="report this")
    return None


def write_summary(folder: Path, values: dict[str, Any]) -> None:
    """Write run.json, with a list of the results that the folder holds.

    Args:
        folder: an existing folder.
        values: for :func:`jsonable`; ``export`` and ``calibration_file`` name further files of the run.

    Raises:
        OSError: the file cannot be written.
    """
    files = {SUMMARY, *(child.name for child in folder.iterdir() if is_result(child.name))}
    files |= {f"{EXPORT}/{name}" for name in values.get("export") or ()}
    files |= {name for name in (values.get("calibration_file"),) if name}
    text = json.dumps(jsonable({**values, "files": sorted(files)}), indent=2, allow_nan=False)
    write_text(folder / SUMMARY, text + "\n")


def summary(run: Run, segment_facts: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """Measured part of run.json: counts, segments, breaks, speed, memory, versions, warnings, the odometry's metadata.

    Args:
        run: record of the session.
        segment_facts: further entries for each segment.

    Returns:
        Values for :func:`jsonable`.
    """
    result = run.result
    return {
        "quality": None if result.quality is None else asdict(result.quality),
        "frames": {
            "read": result.frames_read,
            "fed": run.frames_fed,
            "tracked": result.frames_tracked,
            "lost": result.frames_lost,
            **({"inertial": len(result.inertial)} if result.inertial else {}),
        },
        "segments": [
            {
                "number": number,
                "start": segment.start,
                "end": segment.end,
                "frames": len(segment),
                "joined_to": segment.joined_to,
                "in_map": segment.in_map,
                "file": segment_file(number) if len(result.segments) > 1 else TRAJECTORY,
                **(segment_facts[number] if segment_facts else {}),
            }
            for number, segment in enumerate(result.segments)
        ],
        "breaks": [
            {
                "from": found.start,
                "to": found.end,
                "frames": found.frames,
                "reason": found.reason,
                "new_segment": found.new_segment,
            }
            for found in result.breaks
        ],
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


def versions() -> dict[str, str]:
    """Versions of the software that results depend on.

    Returns:
        Name to version, for Python, the platform and the numerical packages.
    """
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("dvo", "torch", "numpy", "numba", "opencv-python-headless"):
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
        Dictionaries, lists, strings, numbers, booleans and None; numbers that are not finite become None, and addresses
        in strings lose user names, passwords and tokens.
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
    if value is None or isinstance(value, (bool, int)):
        return value
    return redacted(str(value))
