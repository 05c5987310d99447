"""``dvo batch``: track many videos, each as ``dvo run`` does in a process of its own, and write a table of all."""

from __future__ import annotations

import argparse
import contextlib
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dvo.commands import NOTHING_TRACKED, OK
from dvo.commands.batch_names import LOGS, TABLE, filled, folder_names, has_name
from dvo.commands.batch_table import (
    FAILED,
    INTERRUPTED,
    Row,
    is_complete,
    printed,
    read_table,
    row_of,
    write_table,
)
from dvo.commands.console import InterruptSwitch, say, warn
from dvo.commands.export import SOURCE, check_image_options
from dvo.commands.places import check_outputs, places
from dvo.commands.request import differences, request_of
from dvo.commands.run import device_for, load_odometry
from dvo.commands.run_options import INPUTS, OUTPUTS, as_arguments, given_options
from dvo.core import cluster, processes
from dvo.core.errors import DvoError
from dvo.core.processes import Ending, StoppedError, run_limited
from dvo.core.text import first_line, print_line, visible
from dvo.core.threads import process_environment, share_cores
from dvo.data.files.output import scratch_folder
from dvo.data.readers.rosbag import split_topic
from dvo.data.streams.capture import is_stream
from dvo.export.formats import check_formats
from dvo.session import results
from dvo.session.run_facts import read_facts

ROOT = Path(__file__).resolve().parent.parent.parent
"""Folder that holds the package."""
LOG_BEGIN = "$ OMP_NUM_THREADS="
"""Beginning of a log."""
_ENDED = (OK, NOTHING_TRACKED, 129, 130, 143)  # exit codes of a run that has written its results
_LOG, _RESULTS, _CODE = "log.txt", "results", "code.txt"  # of a run on a node


@dataclass(frozen=True)
class Job:
    """A video to track.

    Attributes:
        name: of its results folder.
        source: absolute path, with the topic of a bag behind it if one is given.
        options: of ``dvo run``, see :func:`dvo.commands.run_options.given_options`.
        overwrite: the folder holds results that are replaced.
        threads: of its process.
    """

    name: str
    source: str
    options: Mapping[str, Any]
    overwrite: bool
    threads: int


def batch(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo batch``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code: 0, 1 if a video failed or has no tracked frame, 129, 130 or 143 after SIGHUP, Ctrl-C or SIGTERM.

    Raises:
        DvoError: wrong options, a stream, a folder that cannot be written or in which another batch is at work, results
            of other options without ``--overwrite``, or an output that is an input.
    """
    check_formats(arguments.export)
    check_image_options(arguments, arguments.export, "--export")
    sources, options = _sources(arguments.videos), given_options(arguments)
    _check_options(arguments, options)
    workers, threads = share_cores(None if arguments.ray else arguments.jobs)
    with results.locked_folder(arguments.out, "batch") as out:
        others = read_table(out / TABLE)
        names = folder_names(sources, out)
        rows: dict[str, Row] = {}
        jobs: list[Job] = []
        for name, source in zip(names, sources, strict=True):
            path = split_topic(source, None)[0]
            job = Job(name, source, filled(options, path, name), False, threads)
            rows[name], found = _found(job, out / name, arguments.overwrite)
            jobs += [found] if found is not None else []
        _check_places(jobs, out)
        others = [row for row in others if row["name"] not in rows and (out / row["name"]).is_dir()]
        if jobs:
            _check_settings(arguments)
        _announce(len(rows), len(jobs), workers, threads, arguments)
        (out / LOGS).mkdir(exist_ok=True)
        try:
            number = _track(jobs, rows, out, workers, arguments, partial(write_table, out / TABLE, others=others))
        finally:
            write_table(out / TABLE, rows.values(), others)
    for line in printed(list(rows.values())):
        say(line)
    tracked = sum(row.is_tracked for row in rows.values())
    say(f"{tracked} of {len(rows)} videos tracked; results in {out}/: {TABLE}, a folder for each, {LOGS}/")
    if number is not None:
        warn("the same command goes on with the videos that are not done", "note")
        return 128 + number
    return OK if tracked == len(rows) else NOTHING_TRACKED


# -- what is asked for ---------------------------------------------------------------------------------------------


def _sources(videos: Sequence[str]) -> list[str]:
    """Absolute paths of the videos, each once."""
    for video in videos:
        if is_stream(video):
            raise DvoError("a stream is no video", field=video, remedy="track it with dvo run")
    sources = list(dict.fromkeys(os.path.abspath(video) for video in videos))
    if len(sources) < len(videos):
        warn(f"{len(videos) - len(sources)} of the videos are named more than once; each is tracked once", "note")
    return sources


def _check_options(arguments: argparse.Namespace, options: Mapping[str, Any]) -> None:
    """Refuse options that make no sense for many videos."""
    if options.get("rerun_connect") is not None:
        remedy = "give a file for each, such as --rerun {name}.rrd"
        raise DvoError("a viewer shows one run", field="--rerun-connect", remedy=remedy)
    for name in OUTPUTS:
        text, flag = options.get(name), f"--{name.replace('_', '-')}"
        if text is None:
            continue
        if not text:
            raise DvoError("a viewer shows one run", field=flag, remedy="give a file, such as --rerun {name}.rrd")
        if arguments.ray is not None:
            raise DvoError("files of nodes do not come back", field=flag, remedy="leave out --ray, or use --export")
        if not has_name(text):
            raise DvoError("is one file for all videos", field=flag, remedy="write {name} in it, for that of a video")
    if arguments.ray is None:
        device_for(arguments)


def is_log(file: Path) -> bool:
    """True for a log that a batch has written, also for one that is empty.

    Args:
        file: the file.
    """
    if not file.is_file() or file.is_symlink():
        return False
    try:
        with open(file, "rb") as log:
            first = log.read(100)
    except OSError:
        return False
    return not first or first.startswith(LOG_BEGIN.encode())


def _check_settings(arguments: argparse.Namespace) -> None:
    """Load the odometry once, so that what is wrong with all runs ends the command before the first."""
    texts = (arguments.weights, arguments.config, arguments.map)
    if arguments.map is None and not any("{" in text for text in texts if text):
        odometry = load_odometry(arguments, torch.device("cpu"))
        if arguments.export_images != SOURCE:
            check_formats(arguments.export, odometry)


def _found(job: Job, folder: Path, overwrite: bool) -> tuple[Row, Job | None]:
    """Row of what a folder holds, and the job if it is still to be done."""
    waiting = Row(job.name, job.source)
    if not results.files_of_run(folder):
        return waiting, job  # what else is in the folder, the run tells
    try:
        facts = read_facts(folder / results.SUMMARY)
    except DvoError:
        if not overwrite:
            raise
        return waiting, Job(job.name, job.source, job.options, True, job.threads)
    other = list(differences(request_of(job.source, job.options), facts))
    if other and not overwrite:
        message = f"holds the results of other options: {'; '.join(other[:3])}"
        remedy = "give a new folder, or --overwrite to replace them"
        raise DvoError(message, file=folder, field="--out", remedy=remedy)
    if not other and is_complete(facts):
        return row_of(job.name, job.source, facts), None
    return waiting, Job(job.name, job.source, job.options, True, job.threads)


def _check_places(jobs: Sequence[Job], out: Path) -> None:
    """Refuse outputs of one video that are inputs of another, or of itself."""
    own = {os.path.realpath(out / TABLE): f"{TABLE} of --out"}
    for job in jobs:
        log = out / LOGS / f"{job.name}.log"
        own[os.path.realpath(log)] = f"the log of {job.name}"
        if os.path.lexists(log) and not is_log(log):
            message = "is not a file that dvo batch has written there, and would be replaced"
            raise DvoError(message, file=log, field="--out", remedy="give a new folder")
        for option in OUTPUTS:
            if option in job.options:
                own[os.path.realpath(job.options[option])] = f"--{option.replace('_', '-')} of {job.name}"
    folders, base = {job.name for job in jobs}, os.path.realpath(out) + os.sep
    for job in jobs:
        path = split_topic(job.source, None)[0]
        outputs = {f"--{name.replace('_', '-')}": job.options.get(name) for name in OUTPUTS}
        inputs = {f"--{name.replace('_', '-')}": job.options.get(name) for name in INPUTS}
        check_outputs(outputs, inputs, path, out / job.name)
        for option, value in {**inputs, "the source": str(path)}.items():
            for place in places(value, path) if value else ():
                real = os.path.realpath(place)
                if real in own and os.path.lexists(place):
                    message = f"is also {own[real]}, which would replace it"
                    raise DvoError(message, file=place, field=option, remedy="give another place")
                if real.startswith(base) and (folder := real[len(base) :].partition(os.sep)[0]) in folders - {job.name}:
                    check_outputs({}, {option: place}, None, out / folder)


def _announce(count: int, left: int, workers: int, threads: int, arguments: argparse.Namespace) -> None:
    many = f"{threads} {'thread' if threads == 1 else 'threads'}{' each' if workers > 1 else ''}"
    where = f"on {arguments.ray}, with" if arguments.ray else f"{min(workers, max(left, 1))} at a time, with"
    begin = f"{count} {'video' if count == 1 else 'videos'}"
    if not left:
        return _tell(f"{begin}, done already")
    done = f", {count - left} of them done already" if count > left else ""
    return _tell(f"{begin}{done}; {where} {many}")


def _tell(text: str) -> None:
    """Print a line of progress to stderr, if it can be written."""
    with contextlib.suppress(OSError):
        print_line(text, error=True)


# -- tracking ------------------------------------------------------------------------------------------------------


def _track(
    jobs: Sequence[Job],
    rows: dict[str, Row],
    out: Path,
    workers: int,
    arguments: argparse.Namespace,
    write: Callable[[Any], None],
) -> int | None:
    """Track the videos and fill the rows; gives the number of the signal that has ended it before."""

    def done(job: Job, row: Row) -> None:
        rows[job.name] = row
        write(rows.values())
        told = "" if row.frames is None else f"{row.tracked} of {row.frames} frames tracked, {row.seconds:.1f} s, "
        left = [name for name in (job.name for job in jobs) if rows[name].state == "waiting"]
        _tell(f"[{len(rows) - len(left)}/{len(rows)}] {job.name}: {told}{row.outcome}")

    if not jobs:
        return None
    with contextlib.ExitStack() as stack:
        ray = None if arguments.ray is None else stack.enter_context(cluster.connected(arguments.ray, ROOT))
        if ray is None:
            processes.begin()
        switch = stack.enter_context(InterruptSwitch(patience=4.0))  # after Ray, which has a handler of its own
        if ray is None:
            switch.on_press = lambda: processes.close(switch.pressed or signal.SIGTERM)
            found = _in_processes(jobs, out, workers)
        else:
            found = _on_ray(ray, jobs, out, arguments, lambda: switch.pressed is not None)
        stack.enter_context(contextlib.closing(found))  # after an exception of what follows too
        for job, row in found:
            done(job, row)
        return switch.pressed


def _in_processes(jobs: Sequence[Job], out: Path, workers: int) -> Generator[tuple[Job, Row], None, None]:
    """Track on this machine; gives the videos as they are done, and none that was not begun."""
    with ThreadPoolExecutor(min(workers, len(jobs))) as pool:
        futures = {pool.submit(_obtain, job, out): job for job in jobs}
        try:
            for future in as_completed(futures):
                with contextlib.suppress(StoppedError):
                    yield futures[future], future.result()
        except BaseException:  # a second Ctrl-C too: nothing that was started may go on
            for future in futures:
                future.cancel()
            processes.end_all()
            raise


def _obtain(job: Job, out: Path) -> Row:
    """Track a video in a process of its own."""
    log, folder = out / LOGS / f"{job.name}.log", out / job.name
    try:
        log.unlink(missing_ok=True)
        ending = run_one(job, folder, log)
        line = _error_line(log, ending)
    except OSError as error:
        return Row(job.name, job.source, FAILED, error=f"{log}: {error.strerror or error}")
    return _outcome(job, folder, ending.code, line)


def run_one(job: Job, folder: Path, log: Path) -> Ending:
    """Run ``dvo run`` in a process of its own.

    Args:
        job: the video.
        folder: of its results.
        log: file for what it prints.

    Returns:
        End of the process.

    Raises:
        StoppedError: the batch was ended.
    """
    overwrite = ["--overwrite"] if job.overwrite else []
    line = ["run", *as_arguments(job.options), f"--out={folder}", *overwrite, "--", job.source]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = process_environment(job.threads, {**os.environ, "PYTHONPATH": path})
    begin = f"{LOG_BEGIN}{job.threads} dvo {visible(shlex.join(line))}\n"
    log.write_text(begin, encoding="utf-8", errors="replace")
    program = [sys.executable, "-m", "dvo.batch_worker", str(os.getpid())]
    return run_limited([*program, *line], environment, None, log)


def _error_line(log: Path, ending: Ending) -> str:
    """What went wrong, in one line."""
    begin = "dvo: error: "
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else []
    told = next((line.removeprefix(begin) for line in reversed(lines) if line.startswith(begin)), None)
    return told or str(ending)


def _outcome(job: Job, folder: Path, code: int | None, error: str) -> Row:
    """Row of a video after its run."""
    if code not in _ENDED:
        return Row(job.name, job.source, FAILED, error=error)
    try:
        facts = read_facts(folder / results.SUMMARY)
    except DvoError as failure:
        if code <= NOTHING_TRACKED:
            return Row(job.name, job.source, FAILED, error=_one_line(failure))
        return Row(job.name, job.source, INTERRUPTED)  # before the first frame
    if code <= NOTHING_TRACKED:
        return row_of(job.name, job.source, facts)
    if list(differences(request_of(job.source, job.options), facts)):  # before the first frame: those of another run
        return Row(job.name, job.source, INTERRUPTED)
    return replace(row_of(job.name, job.source, facts), state=INTERRUPTED)


def _one_line(error: DvoError) -> str:
    return " ".join(str(error).split())


# -- over Ray ------------------------------------------------------------------------------------------------------


def _on_ray(
    ray: Any, jobs: Sequence[Job], out: Path, arguments: argparse.Namespace, should_stop: Callable[[], bool]
) -> Generator[tuple[Job, Row], None, None]:
    """Track on the nodes of a cluster; what runs when it is stopped is cancelled, and has no results."""
    accelerators = 0 if arguments.device in ("auto", "cpu") else 1
    found = cluster.run_on(
        ray, track_packed, jobs, threads=jobs[0].threads, accelerators=accelerators, at_most=arguments.jobs,
        should_stop=should_stop,
    )  # fmt: skip
    for number, result in found:
        job = jobs[number]
        try:
            content = result()
        except Exception as error:  # of the node, or of Ray
            yield job, Row(job.name, job.source, FAILED, error=first_line(error))
            continue
        yield job, _stored(job, content, out)


def track_packed(job: Job) -> bytes:
    """On a node: track a video into a folder of its own and pack what it leaves.

    Args:
        job: the video; its file has the same path here.

    Returns:
        For :func:`dvo.core.cluster.unpack`.
    """
    processes.begin()
    with scratch_folder("dvo-batch") as folder:
        ending = run_one(job, folder / _RESULTS, folder / _LOG)
        code = "" if ending.code is None else str(ending.code)
        (folder / _CODE).write_text(f"{code}\n{_error_line(folder / _LOG, ending)}\n", encoding="utf-8")
        return cluster.packed(folder)


def _stored(job: Job, content: bytes, out: Path) -> Row:
    """Put what a node has packed into the folder of results, with the checks of ``dvo run``; gives the row."""
    try:
        with scratch_folder(job.name, out) as unpacked:
            cluster.unpack(content, unpacked)
            code, _, error = (unpacked / _CODE).read_text(encoding="utf-8").partition("\n")
            os.replace(unpacked / _LOG, out / LOGS / f"{job.name}.log")
            if (unpacked / _RESULTS / results.SUMMARY).is_file():
                exports = job.options.get("export", ())
                opened = results.results_folder(out / job.name, job.name, overwrite=job.overwrite, exports=exports)
                with opened as folder:
                    results.remove_results(folder)
                    _move(unpacked / _RESULTS, folder)
        return _outcome(job, out / job.name, int(code) if code else None, error.strip())
    except DvoError as failure:
        return Row(job.name, job.source, FAILED, error=_one_line(failure))
    except OSError as failure:
        return Row(job.name, job.source, FAILED, error=f"{failure.filename}: {failure.strerror or failure}")


def _move(source: Path, folder: Path) -> None:
    """Move files into a folder, run.json last."""
    for child in sorted(source.iterdir(), key=lambda path: path.name == results.SUMMARY):
        if child.is_dir():
            (folder / child.name).mkdir(exist_ok=True)
            for inner in child.iterdir():
                shutil.move(inner, folder / child.name / inner.name)
        else:
            os.replace(child, folder / child.name)
