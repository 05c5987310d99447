"""Predictions by key: a run is repeated only if something that it depends on has changed.

A prediction is a folder that appears whole or not at all, named by the hash of everything that its trajectory depends
on (``key.json`` holds it in words): so a run that was killed goes on where it stopped, and an old trajectory is never
taken for a new one.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from dvo.data.source import Source
from dvo.session.results import jsonable
from eval.execution.predict import RECORD, Job, Prediction, predict, read_prediction
from eval.execution.versions import code_digest, depends_on_threads, library_versions, reader_digest
from eval.suites.suite import Sequence
from eval.systems.registry import find_system
from eval.systems.system import System

KEY = "key.json"
CONTENT_LIMIT = 64 * 2**20  # bytes of a sequence up to which its files are hashed; beyond, names, sizes and times
# Fields of a sequence that change tables, or whose content is in the fingerprint; what is left chooses images.
NOT_IN_KEY = ("name", "about", "judged_by", "path", "calib", "times", "groundtruth", "clip")
FORMAT = 3  # of a stored prediction: 3 has segments, and the frames without a view
PASSING = ("unavailable", "no data")  # states that can change while the key stays


@dataclass(frozen=True)
class SystemFacts:
    """Properties of a system that the key and the report need, found once for a whole evaluation.

    Attributes:
        name: as on the command line.
        label: as in the tables.
        licence, about: see :class:`eval.systems.system.System`.
        version: ``""`` if the system cannot run or has none.
        missing: reason why it cannot run, or None.
        code, libraries, threads: see :mod:`eval.execution.versions`; ``threads`` is whether their number may change
            results.
        identity: target and settings, see :meth:`eval.systems.system.System.identity`.
    """

    name: str
    label: str
    licence: str
    about: str
    version: str
    missing: str | None
    code: str
    libraries: dict[str, str]
    threads: bool
    identity: dict[str, Any] = field(default_factory=dict)


def system_facts(name: str, weights: str | None = None) -> SystemFacts:
    """Look a system up and find its facts.

    Args:
        name: as on the command line.
        weights: weights file for ``dvo-...`` systems in place of the package's own.

    Raises:
        DvoError: no such system.
    """
    system = find_system(name, weights)
    missing = system.missing()
    threads = depends_on_threads(system)
    libraries = library_versions()
    return SystemFacts(
        name=name,
        label=system.name,
        licence=system.licence,
        about=system.about,
        version="" if missing is not None else _version(system),
        missing=missing,
        code=code_digest(system),
        libraries={name: version for name, version in libraries.items() if name != "torch" or threads},
        threads=threads,
        identity=system.identity(),
    )


def data_fingerprint(source: Source, sequence: Sequence) -> str:
    """Hash of the images and the calibration of an open sequence.

    Files of a small sequence are hashed whole, so that a copy elsewhere is the same; of a large one names, sizes and
    times of change count.

    Args:
        source: as opened.
        sequence: names the files beside the images that count too.

    Returns:
        Sixteen hexadecimal digits.
    """
    digest = hashlib.sha256()
    _add(digest, [asdict(source.recorded_camera), reader_digest()])
    root = source.path
    files = sorted(file for file in root.rglob("*") if file.is_file()) if root.is_dir() else [root]
    files += [root / name for name in (sequence.calib, sequence.times) if name and (root / name).is_file()]
    by_content = sum(file.stat().st_size for file in files) <= CONTENT_LIMIT
    for file in files:
        about = file.stat()
        name = str(file.relative_to(root)) if file.is_relative_to(root) else file.name
        _add(digest, [name, about.st_size])
        if by_content:
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        else:
            _add(digest, about.st_mtime_ns)
    return digest.hexdigest()[:16]


def job_key(job: Job, facts: SystemFacts, fingerprint: str, suite: dict[str, Any]) -> dict[str, Any]:
    """Key of a prediction: everything that the trajectory of a job depends on, JSON-able.

    Args:
        fingerprint: of the data, see :func:`data_fingerprint`.
        suite: name and other facts of the suite that choose the images (its version).
    """
    sequence = {name: value for name, value in jsonable(asdict(job.sequence)).items() if name not in NOT_IN_KEY}
    return {
        "format": FORMAT,
        **facts.identity,
        "version": facts.version,
        "code": facts.code,
        "libraries": facts.libraries,
        "suite": suite,
        "sequence": sequence,
        "data": fingerprint,
        "seed": job.seed,
        "stride": job.stride,
        "device": job.device,
        "threads": job.threads if facts.threads else None,
    }


def digest_of(key: dict[str, Any]) -> str:
    """Twelve hexadecimal digits of the hash of a key, for the name of a folder."""
    return hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:12]


def reusable(job: Job, retry: bool = False) -> Prediction | None:
    """Prediction in the job's folder, or None if it has to be made (again).

    Args:
        retry: make failed ones again.
    """
    folder = Path(job.folder)
    if not (folder / RECORD).is_file():
        return None
    found = read_prediction(folder)
    if found.status in PASSING or (retry and found.status != "ok"):
        return None
    if found.status == "timeout" and job.time_limit > (found.time_limit or 0):
        return None
    return found


def obtain(
    job: Job,
    key: dict[str, Any],
    *,
    run: Callable[[Job], Prediction] = predict,
    retry: bool = False,
) -> tuple[Prediction, bool]:
    """Prediction of a job, made now unless it is there; a new one appears in its folder in one step.

    Args:
        job: with its folder.
        key: written beside the prediction.
        run: makes a prediction.
        retry: make failed ones again.

    Returns:
        The prediction, and whether it was there already.
    """
    found = reusable(job, retry)
    if found is not None:
        return found, True
    part = part_folder(job)
    prediction = run(replace(job, folder=str(part)))
    commit(part, Path(job.folder), key)
    return prediction, False


def part_folder(job: Job) -> Path:
    """Folder in which a job works until it is done: beside its own, so that a rename is enough.

    Args:
        job: its folder need not exist.

    Returns:
        Folder, made now.
    """
    folder = Path(job.folder)
    part = folder.with_name(f".part-{folder.name}-{os.getpid()}-{threading.get_ident()}")
    part.mkdir(parents=True, exist_ok=True)
    return part


def commit(part: Path, folder: Path, key: dict[str, Any]) -> None:
    """Move a finished prediction into its folder.

    Args:
        part: folder in which the prediction was made.
        folder: its place; replaced if it exists.
        key: written as ``key.json``.
    """
    (part / KEY).write_text(json.dumps(key, indent=1) + "\n", encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(part, folder)


def sweep(predictions: Path) -> None:
    """Remove unfinished predictions of killed runs. Only for the process that holds the lock of the folder."""
    for part in predictions.rglob(".part-*"):
        shutil.rmtree(part, ignore_errors=True)


def slug(name: str) -> str:
    """Name as part of a path, every other character replaced by ``_``."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("_") or "_"


def _version(system: System) -> str:
    try:
        return system.version()
    except Exception:  # the run itself will report what is wrong with a system without a version
        return ""


def _add(digest: Any, value: Any) -> None:
    digest.update(json.dumps(jsonable(value), sort_keys=True, default=str).encode() + b"\0")
