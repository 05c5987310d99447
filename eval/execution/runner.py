"""Runs of a whole plan: open every sequence once, then make the predictions that are missing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from dvo.core import processes
from dvo.core.errors import DvoError
from dvo.data.files.output import only_writer
from dvo.data.trajectory import write_tum
from dvo.session.results import jsonable
from eval.execution.cache import (
    SystemFacts,
    commit,
    data_fingerprint,
    digest_of,
    job_key,
    obtain,
    part_folder,
    reusable,
    sweep,
    system_facts,
)
from eval.execution.plan import (
    PREDICTIONS,
    Plan,
    Run,
    claim_folder,
    groundtruth_file,
    inertial_file,
    prediction_folder,
    write_manifest,
)
from eval.execution.predict import Job, Prediction, predict, write_prediction
from eval.suites.selection import is_rendered, settle
from eval.suites.suite import Sequence, Suite, inertial_truth, open_sequence

# Fields of a suite that change how it is judged and described, not its images.
_JUDGING = ("label", "sequences", "alignment", "rpe_gap", "stride", "lost_below", "time_limit", "download")


@dataclass(frozen=True)
class Opened:
    """A sequence as found.

    Attributes:
        sequence: with the place where its files are.
        fingerprint: of its data.
        problem: why it cannot be used, or None.
    """

    sequence: Sequence
    fingerprint: str
    problem: str | None


@dataclass(frozen=True)
class Task:
    """A job with its key, and the problem that keeps it from running."""

    job: Job
    key: dict[str, Any]
    problem: str | None


def predict_all(plan: Plan, say: Callable[[str], None], run: Callable[[Job], Prediction] = predict) -> None:
    """Make every prediction of the plan that is not in its folder yet; write ``run.json`` first.

    One run at a time unless the plan has several workers, so that speed means something.

    Args:
        plan: what runs, on what, and where.
        say: called with a line for each run.
        run: makes a prediction.

    Raises:
        DvoError: a system that does not exist (before anything runs), another evaluation at work in the same folder, or
            a Ray cluster that cannot be reached.
    """
    facts = {name: system_facts(name, plan.weights) for name in plan.systems}
    labels = [known.label for known in facts.values()]
    for label in labels:
        if labels.count(label) > 1:
            raise DvoError(f"two systems of the name '{label}'", field="--systems", remedy="rename one of the files")
    with only_writer(plan.out, "--out"):
        claim_folder(plan.out)
        sweep(plan.out / PREDICTIONS)
        opened = {(suite.name, seq.name): open_once(plan, suite, seq, say) for suite, seq in plan.sequences()}
        tasks, runs = [], []
        for suite, sequence in plan.sequences():
            for system in plan.systems:
                for seed in plan.seeds:
                    task = make_task(plan, suite, opened[suite.name, sequence.name], facts[system], seed)
                    folder = str(Path(task.job.folder).relative_to(plan.out.resolve()))
                    tasks.append(task)
                    runs.append(Run(facts[system].label, suite.name, sequence.name, seed, folder))
        write_manifest(plan, runs, {known.label: known for known in facts.values()})
        for number, (task, prediction, old) in enumerate(_done(plan, tasks, run), 1):
            said = f"{prediction.tracked}/{len(prediction.stamps)} frames"
            if prediction.status != "ok":
                said = f"{prediction.status}: {prediction.reason}"
            where = f"{task.job.sequence.name}, {facts[task.job.system].label}, seed {task.job.seed}"
            say(f"[{number}/{len(tasks)}] {where}: {said}{' (was there)' if old else ''}")


def open_once(plan: Plan, suite: Suite, sequence: Sequence, say: Callable[[str], None]) -> Opened:
    """Find a sequence, keep a copy of its ground truth, and take the fingerprint of its data.

    Args:
        plan: of the evaluation.
        suite, sequence: to open.
        say: called before a rendering, which takes a while.

    Returns:
        The sequence as found, with the problem if it cannot be used.
    """
    truth_file = groundtruth_file(plan.out, suite.name, sequence.name)
    if is_rendered(sequence):
        say(f"{suite.name}: {sequence.name}")  # rendering it for the first time takes a while
    try:
        there = settle(suite, sequence, plan.data)
        source, truth = open_sequence(there, plan.data, 1)
    except DvoError as error:
        truth_file.unlink(missing_ok=True)
        return Opened(sequence, "", f"{error}{f' The data: {suite.download}' if suite.download else ''}")
    truth_file.parent.mkdir(parents=True, exist_ok=True)
    write_tum(truth_file, truth)
    about_samples = inertial_truth(there)
    if about_samples is not None:
        about_samples.write(inertial_file(plan.out, suite.name, sequence.name))
    return Opened(there, data_fingerprint(source, there), None)


def make_task(plan: Plan, suite: Suite, opened: Opened, facts: SystemFacts, seed: int) -> Task:
    """The job of one run, its folder named by its key.

    Args:
        plan: of the evaluation.
        suite: of the sequence.
        opened: the sequence as found.
        facts: of the system.
        seed: of the run.

    Returns:
        Job, key, and the problem that keeps it from running.
    """
    job = Job(
        system=facts.name,
        sequence=opened.sequence,
        data=str(plan.data.resolve()),
        folder="",
        seed=seed,
        stride=suite.stride,
        weights=plan.weights,
        device=plan.device,
        threads=plan.threads,
        time_limit=suite.time_limit,
        parallel=plan.workers,
    )
    facts_of_suite = {name: value for name, value in jsonable(asdict(suite)).items() if name not in _JUDGING}
    key = job_key(job, facts, opened.fingerprint, facts_of_suite)
    digest = digest_of(key) if opened.problem is None else "nodata"
    folder = prediction_folder(plan, facts.label, suite, opened.sequence, seed, digest)
    return Task(replace(job, folder=str(folder.resolve())), key, opened.problem)


def _done(plan: Plan, tasks: list[Task], run: Callable[[Job], Prediction]) -> Iterator[tuple[Task, Prediction, bool]]:
    """Tasks as they are done, with their predictions and whether those were there already."""
    waiting = []
    for task in tasks:
        if task.problem is not None:
            yield task, _no_data(task), False
        elif (found := reusable(task.job, plan.retry)) is not None:
            yield task, found, True
        else:
            waiting.append(task)
    if not waiting:
        return
    if plan.ray is not None:
        from eval.execution.cluster import run_on_ray

        jobs = [(task.job, task.key) for task in waiting]
        for number, prediction in run_on_ray(jobs, plan.ray):
            yield waiting[number], prediction, False
        return
    processes.begin()
    with ThreadPoolExecutor(plan.workers) as pool:
        futures = {pool.submit(obtain, task.job, task.key, run=run, retry=plan.retry): task for task in waiting}
        try:
            for future in as_completed(futures):
                yield futures[future], *future.result()
        except BaseException:  # Ctrl-C too: nothing that was started may go on
            for future in futures:
                future.cancel()
            processes.end_all()
            raise


def _no_data(task: Task) -> Prediction:
    part = part_folder(task.job)
    prediction = write_prediction(replace(task.job, folder=str(part)), Prediction("no data", task.problem or ""))
    commit(part, Path(task.job.folder), task.key)
    return prediction
