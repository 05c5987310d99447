"""A suite from start to end: predict every system on every sequence and seed, score, write the report."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from eval.plots import plot_sequence
from eval.predict import Job, Prediction, predict, read_prediction, read_trajectory
from eval.report import markdown, write_csv
from eval.score import Row, score
from eval.sequences import Sequence, Suite, open_sequence
from eval.systems import find_system

RESULTS, TABLE = "results.csv", "table.md"


@dataclass(frozen=True)
class Plan:
    """What to run and where to put it.

    Attributes:
        suite, systems, seeds: the product of the three is the list of runs.
        data: folder of the recordings.
        out: folder of the results; predictions lie in ``out/predictions/SYSTEM/SEQUENCE/seedN``.
        weights: weights file for ``dvo-...`` systems in place of the package's own.
    """

    suite: Suite
    systems: tuple[str, ...]
    seeds: tuple[int, ...]
    data: Path
    out: Path
    weights: str | None = None
    device: str = "cpu"
    threads: int = 2

    def folder(self, system: str, sequence: Sequence, seed: int) -> Path:
        """Where one run's prediction lies."""
        return self.out / "predictions" / _slug(system) / _slug(sequence.name) / f"seed{seed}"

    def jobs(self) -> list[Job]:
        """Every run, sequence by sequence."""
        return [
            Job(
                system=system,
                sequence=sequence,
                data=str(self.data.resolve()),
                folder=str(self.folder(system, sequence, seed).resolve()),
                seed=seed,
                stride=self.suite.stride,
                weights=self.weights,
                device=self.device,
                threads=self.threads,
                time_limit=self.suite.time_limit,
            )
            for sequence in self.suite.sequences
            for system in self.systems
            for seed in self.seeds
        ]


def predict_all(plan: Plan, say: Callable[[str], None], run: Callable[[Job], Prediction] = predict) -> None:
    """Run everything, one run at a time, so that speed means something.

    Raises:
        DvoError: a system that does not exist (before anything runs).
    """
    for system in plan.systems:
        find_system(system, plan.weights)
    jobs = plan.jobs()
    for number, job in enumerate(jobs, 1):
        done = run(job)
        fate = f"{done.tracked}/{len(done.stamps)} frames" if done.status == "ok" else f"{done.status}: {done.reason}"
        say(f"[{number}/{len(jobs)}] {job.sequence.name}, {job.system}, seed {job.seed}: {fate}")


def score_all(plan: Plan) -> list[Row]:
    """Compare every prediction in ``plan.out`` with ground truth.

    Raises:
        DvoError: a run of the plan has no prediction.
    """
    rows = []
    for sequence in plan.suite.sequences:
        truth = _groundtruth(plan, sequence)
        for system in plan.systems:
            for seed in plan.seeds:
                folder = plan.folder(system, sequence, seed)
                rows.append(
                    score(
                        read_prediction(folder),
                        read_trajectory(folder),
                        truth,
                        system=system,
                        suite=plan.suite,
                        sequence=sequence,
                        seed=seed,
                    )
                )
    return rows


def report(plan: Plan, rows: list[Row]) -> str:
    """Write results.csv, table.md and one picture per sequence; returns the table."""
    write_csv(plan.out / RESULTS, rows)
    table = markdown(plan.suite, rows, plan.threads, plan.device)
    (plan.out / TABLE).write_text(table, encoding="utf-8")
    for sequence in plan.suite.sequences:
        truth = _groundtruth(plan, sequence)
        if truth is not None:
            seed = plan.seeds[0]
            tracks = {name: read_trajectory(plan.folder(name, sequence, seed)) for name in plan.systems}
            plot_sequence(plan.out / f"{_slug(sequence.name)}.png", plan.suite, sequence, truth, tracks)
    return table


def _groundtruth(plan: Plan, sequence: Sequence) -> Trajectory | None:
    """None where the data are missing, which the predictions already say."""
    try:
        return open_sequence(sequence, plan.data, 1)[1]
    except DvoError:
        return None


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)
