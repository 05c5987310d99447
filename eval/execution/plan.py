"""Plan of an evaluation, and its record ``run.json``, from which scores and reports are made later."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.files.output import write_text
from dvo.session.results import jsonable
from eval.execution.cache import SystemFacts, slug
from eval.suites.selection import suite_from
from eval.suites.suite import Sequence, Suite

MANIFEST, PREDICTIONS, GROUNDTRUTH = "run.json", "predictions", "groundtruth"
RESULTS, TABLE, AXES, PAGE, FIGURE_FOLDER = "results.csv", "table.md", "axes.md", "report.html", "figures"
LOOPS = "loops.md"
WRITTEN = (MANIFEST, PREDICTIONS, GROUNDTRUTH, RESULTS, TABLE, AXES, PAGE, FIGURE_FOLDER, LOOPS)
"""Names in the folder of an evaluation."""


@dataclass(frozen=True)
class Plan:
    """Plan of an evaluation.

    Attributes:
        suites, systems, seeds: every sequence of the suites, times the systems, times the seeds, is the list of runs.
        data: folder of the recordings.
        out: folder of the results.
        weights: weights file for ``dvo-...`` systems in place of the package's own.
        workers: runs at the same time.
        ray: address of a Ray cluster that runs them, or None.
        retry: make failed predictions again.
    """

    suites: tuple[Suite, ...]
    systems: tuple[str, ...]
    seeds: tuple[int, ...]
    data: Path
    out: Path
    weights: str | None = None
    device: str = "cpu"
    threads: int = 2
    workers: int = 1
    ray: str | None = None
    retry: bool = False

    def sequences(self) -> list[tuple[Suite, Sequence]]:
        """Every sequence with its suite."""
        return [(suite, sequence) for suite in self.suites for sequence in suite.sequences]


@dataclass(frozen=True)
class Run:
    """One run of an evaluation: which, and the folder of its prediction relative to the evaluation's."""

    system: str
    suite: str
    sequence: str
    seed: int
    folder: str


@dataclass(frozen=True)
class Manifest:
    """Content of ``run.json``.

    Attributes:
        suites, systems, seeds: of the plan; systems by the names in the tables.
        runs: every run with its folder, in the order of the tables.
        facts: of the systems, by name.
        threads, device, workers, machine: how and where it ran.
    """

    suites: tuple[Suite, ...]
    systems: tuple[str, ...]
    seeds: tuple[int, ...]
    runs: tuple[Run, ...]
    facts: dict[str, SystemFacts]
    threads: int
    device: str
    workers: int
    machine: str
    command: dict[str, Any] = field(default_factory=dict)

    def suite(self, name: str) -> Suite:
        """By name."""
        return next(suite for suite in self.suites if suite.name == name)


def write_manifest(plan: Plan, runs: list[Run], facts: dict[str, SystemFacts]) -> Manifest:
    """Write ``run.json`` into the plan's folder, whole or not at all.

    Args:
        plan: names the folder.
        runs: every run of the plan.
        facts: of the systems, by label.

    Returns:
        Content of the file.
    """
    manifest = Manifest(
        plan.suites,
        tuple(facts),
        plan.seeds,
        tuple(runs),
        facts,
        plan.threads,
        plan.device,
        plan.workers,
        machine() if plan.ray is None else f"Ray cluster at {plan.ray}",
        {"data": str(plan.data), "weights": plan.weights},
    )
    write_text(plan.out / MANIFEST, json.dumps(jsonable(asdict(manifest)), indent=1) + "\n")
    return manifest


def claim_folder(out: Path) -> None:
    """Check that a folder is free for an evaluation, or holds one, which goes on; a free one is marked as one.

    An evaluation that is killed before its manifest is written goes on, too.

    Args:
        out: the folder.

    Raises:
        DvoError: it holds a file or folder of the name of a result that no evaluation has written.
        OSError: it cannot be written.
    """
    taken = [name for name in WRITTEN if os.path.lexists(out / name)]
    if not taken:
        write_text(out / MANIFEST, json.dumps({"suites": [], "systems": [], "runs": []}) + "\n")
        return
    try:
        found = json.loads((out / MANIFEST).read_text(encoding="utf-8")) if (out / MANIFEST).is_file() else None
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or not {"suites", "systems", "runs"} <= set(found):
        message = "is not of an evaluation, whose results would take its place"
        raise DvoError(message, file=out / taken[0], field="--out", remedy="give a new folder")


def read_manifest(out: Path) -> Manifest:
    """Read ``run.json``.

    Args:
        out: folder of an evaluation.

    Raises:
        DvoError: there is none, or it is no such file.
    """
    path = out / MANIFEST
    if not path.is_file():
        raise DvoError("no evaluation in this folder", file=path, remedy="make one: python -m eval run --out DIR")
    try:
        entry = json.loads(path.read_text(encoding="utf-8"))
        entry["suites"] = tuple(suite_from(suite) for suite in entry["suites"])
        entry["runs"] = tuple(Run(**run) for run in entry["runs"])
        entry["facts"] = {name: SystemFacts(**facts) for name, facts in entry["facts"].items()}
        entry["systems"], entry["seeds"] = tuple(entry["systems"]), tuple(entry["seeds"])
        return Manifest(**entry)
    except (ValueError, TypeError, KeyError) as error:
        raise DvoError(
            f"not written by this version ({error})", file=path, remedy="run the evaluation again"
        ) from error


def prediction_folder(plan: Plan, system: str, suite: Suite, sequence: Sequence, seed: int, digest: str) -> Path:
    """Folder of the prediction of one run.

    Args:
        plan: names the folder of results.
        system: label.
        suite, sequence, seed: of the run.
        digest: of the key of the prediction.
    """
    place = plan.out / PREDICTIONS / slug(system) / slug(suite.name) / slug(sequence.name)
    return place / f"seed{seed}-{digest}"


def groundtruth_file(out: Path, suite: str, sequence: str) -> Path:
    """File with the copy of the ground truth of a sequence.

    Args:
        out: folder of an evaluation.
        suite, sequence: names.
    """
    return out / GROUNDTRUTH / slug(suite) / f"{slug(sequence)}.txt"


def inertial_file(out: Path, suite: str, sequence: str) -> Path:
    """File with the copy of the truth about the inertial samples of a sequence.

    Args:
        out: folder of an evaluation.
        suite, sequence: names.
    """
    return groundtruth_file(out, suite, sequence).with_suffix(".npz")


def machine() -> str:
    """Name of the processor and number of its cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    return f"{name}, {os.cpu_count()} cores"
