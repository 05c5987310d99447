"""Videos without ground truth: `python -m eval.benchmarks.wild DIR [--expected FILE] [--systems NAMES]`.

Every video of a folder, or of a list of what is right (`--expected`), is tracked by the systems with several seeds, and
by the first system backward too. The table has, for each video, the frame with the first measured pose, straightness,
angle, the largest difference of two seeds, the difference of forward and backward and of the other systems in percent
of the path after a similarity, and seconds of the processor. With a list it also prints if each run is right, wrong and
told (the verdict is not good), wrong and silent, right and doubted, or ended with an error. The calibration is that of
the list or NAME.calib.txt beside the video; without one the focal length is found in the images.

Runs and trajectories are kept in `--out`, and the same command goes on from there; `page.html` shows all plots.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.companions.right_source import VIDEO_SUFFIXES
from eval.benchmarks.wild.measures import Expected, Measures, backward, difference, measure, read_expected
from eval.benchmarks.wild.page import write_page
from eval.benchmarks.wild.runs import Run, Task, Video, carry_out
from eval.execution.fresh_processes import in_fresh_processes

LEAST_POSES = 0.5
"""Share of the frames that must have a pose in the trajectory of a run that is right."""


@dataclass(frozen=True)
class Judged:
    """Runs of one video, and what they amount to.

    Attributes:
        name: of the video.
        runs: of the systems, by key.
        measures: of the runs of the first system.
        seeds: largest difference of two seeds of it, percent of the path.
        turned: difference of forward and backward.
        others: differences of the other systems, by name.
        outcome: of each seed: ``right``, ``told``, ``silent``, ``doubted`` (right, but not good), or ``error`` of a run
            that ended with one; empty without a list.
        faults: what is not as expected.
    """

    name: str
    runs: dict[str, Run]
    measures: tuple[Measures, ...]
    seeds: float
    turned: float
    others: dict[str, float]
    outcome: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


def judge(video: Video, tasks: Iterable[Task], runs: dict[str, Run], expected: Expected | None) -> Judged:
    """Compare the runs of a video with each other, and with what is right.

    Args:
        video: clip.
        tasks: its tasks, those of the first system first.
        runs: by key.
        expected: what is right; None: not known.
    """
    mine = list(tasks)
    first = mine[0].system
    own = [runs[task.key] for task in mine if task.system == first and not task.backward]
    measures = tuple(measure(run.trajectory) for run in own)
    pairs = [difference(a.trajectory, b.trajectory) for k, a in enumerate(own) for b in own[:k]]
    seeds = max((value for value in pairs if not math.isnan(value)), default=math.nan)
    turned, others = math.nan, {}
    for task in mine:
        run = runs[task.key]
        if task.backward and len(run.poses):
            times = own[0].poses[:, 0]
            length = float(times[0] + times[-1]) if len(times) else 0.0
            turned = difference(backward(run.trajectory, length), own[0].trajectory)
        elif task.system != first:
            others[task.system] = difference(run.trajectory, own[0].trajectory)
    if expected is None:
        return Judged(video.name, {task.key: runs[task.key] for task in mine}, measures, seeds, turned, others)
    outcome, faults = [], []
    for run, found in zip(own, measures, strict=True):
        wrong = expected.faults(found, run.first)
        if 0 < found.rows < LEAST_POSES * run.frames:
            wrong.append(f"poses of {found.rows} of {run.frames} frames")
        if expected.seeds is not None and len(own) > 1 and not seeds <= expected.seeds:
            wrong.append(f"seeds {seeds:.2g} %")
        if expected.must == "still":
            wrong = ["poses"] if len(run.poses) else []
        if run.error:  # nothing was tracked, so that nothing can be right or told
            outcome.append("error")
            continue
        if not wrong and expected.must == "good" and run.verdict == "doubtful":
            outcome.append("doubted")
            wrong = [f"doubtful although right: {run.reason}"]
        else:
            told = run.verdict in ("failed", "doubtful")
            outcome.append("right" if not wrong else "told" if told else "silent")
        faults += [fault for fault in wrong if fault not in faults]
    kept = {task.key: runs[task.key] for task in mine}
    return Judged(video.name, kept, measures, seeds, turned, others, tuple(outcome), tuple(faults))


def table(judged: list[Judged]) -> str:
    """Table in Markdown, a row for each video; values of several seeds by commas.

    Args:
        judged: videos.
    """
    others = sorted({name for one in judged for name in one.others})
    head = ["video", "first pose", "straightness", "turn", "seeds %", "backward %", *(f"{name} %" for name in others),
            "verdict", "seconds", "outcome", "faults"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for one in judged:
        own = list(one.runs.values())[: len(one.measures)]
        cells = [
            one.name,
            ", ".join("-" if run.first is None else str(run.first) for run in own),
            ", ".join(f"{found.straightness:.3f}" for found in one.measures),
            ", ".join(f"{found.turn:.1f}" for found in one.measures),
            f"{one.seeds:.2f}",
            f"{one.turned:.2f}",
            *(f"{one.others.get(name, math.nan):.2f}" for name in others),
            ", ".join(run.error or run.verdict for run in own),
            f"{np.mean([sum(run.seconds.values()) for run in own]):.0f}",
            ", ".join(one.outcome),
            "; ".join(one.faults),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    total = [outcome for one in judged for outcome in one.outcome]
    if total:
        counts = ", ".join(f"{name} {total.count(name)}" for name in ("right", "told", "silent", "doubted", "error"))
        lines.append(f"\nOf {len(total)} runs: {counts}.")
    return "\n".join(lines)


def videos_of(folder: Path, expected: dict[str, Expected], base: Path) -> list[Video]:
    """Videos of a folder, or of a list."""
    if not expected:
        if not folder.is_dir():
            raise DvoError("no folder", file=folder, remedy="give a folder with videos, or --expected FILE")
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES)
        stems = [file.stem for file in files]
        names = [file.stem if stems.count(file.stem) == 1 else file.name for file in files]
        return [Video(name, file, _calib(file)) for name, file in zip(names, files, strict=True)]
    found = []
    for name, entry in expected.items():
        file = base / entry.video
        calib: Calibration | Path | None = _calib(file)
        if entry.calib is not None:
            fx, fy, cx, cy = entry.calib
            calib = Calibration(fx, fy, cx, cy)
        found.append(Video(name, file, calib, entry.frames))
    return found


def _calib(video: Path) -> Path | None:
    file = video.with_name(f"{video.stem}.calib.txt")
    return file if file.exists() else None


def tasks_of(video: Video, systems: Sequence[str], seeds: int) -> list[Task]:
    """Tasks of a video: those of the first system, backward, and the other systems with the first seed.

    Args:
        video: clip.
        systems: names.
        seeds: number of seeds of the first one.
    """
    first, *others = systems
    own = [Task(video, first, seed) for seed in range(seeds)]
    return [*own, Task(video, first, 0, backward=True), *(Task(video, name) for name in others)]


def make_runs(tasks: Sequence[Task], out: Path, jobs: int = 1) -> dict[str, Run]:
    """Make the runs that are not kept yet, each in a process of its own; a line is printed after each.

    Args:
        tasks: of all videos.
        out: folder of ``runs.jsonl`` and the trajectories.
        jobs: runs at the same time.

    Returns:
        Runs by key.
    """
    out.mkdir(parents=True, exist_ok=True)
    record = out / "runs.jsonl"
    runs = {}
    for line in record.read_text(encoding="utf-8").splitlines() if record.exists() else ():
        try:
            values = json.loads(line)
            runs[values["key"]] = Run(**values, poses=np.load(out / f"{values['key']}.npy"))
        except (ValueError, TypeError, KeyError, OSError) as error:
            raise DvoError(
                f"not a run ({error})", file=record, remedy="give another --out, or remove the line"
            ) from error
    for task in tasks:  # of the same name, but another clip, calibration or number of frames
        if task.key in runs and runs[task.key].video != str(task.video):
            del runs[task.key]
    missing = [task for task in tasks if task.key not in runs]
    for done in in_fresh_processes(carry_out, missing, jobs=jobs):
        runs[done.key] = done
        np.save(out / f"{done.key}.npy", done.poses)
        values = {name: value for name, value in vars(done).items() if name != "poses"}
        with record.open("a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")
        print(f"{done.key}: {done.error or done.verdict}, {len(done.poses)} of {done.frames} frames", flush=True)
    return runs


def main(given: list[str] | None = None) -> None:
    """Command line."""
    parser = OneLineParser(
        prog="python -m eval.benchmarks.wild", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="with videos")
    parser.add_argument("--expected", type=Path, metavar="FILE", help="what is right; its videos lie relative to it")
    parser.add_argument("--systems", type=lambda text: text.split(","), default=["dvo-small", "keyframe", "klt-pnp"])
    parser.add_argument("--seeds", type=int, default=3, help="of the first system, 0 to N-1 (3)")
    parser.add_argument("--videos", type=lambda text: text.split(","), help="names with commas between")
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    parser.add_argument("--out", type=Path, default=Path("runs/wild"), help="folder of runs, table and page")
    arguments = parser.parse_args(given)
    try:
        for name in ("seeds", "jobs"):
            if getattr(arguments, name) < 1:
                raise DvoError("must be 1 or more", field=f"--{name}", remedy="give a whole number")
        expected = read_expected(arguments.expected) if arguments.expected else {}
        base = arguments.expected.parent if arguments.expected else arguments.folder
        videos = videos_of(arguments.folder, expected, base)
        known = [video.name for video in videos]
        if unknown := [name for name in arguments.videos or () if name not in known]:
            raise DvoError(f"no video '{unknown[0]}'", field="--videos", remedy=f"choose from {', '.join(known)}")
        chosen = [video for video in videos if arguments.videos is None or video.name in arguments.videos]
        if not chosen:
            raise DvoError("no videos", file=arguments.folder, remedy="give a folder with videos, or --expected FILE")
        tasks = {video.name: tasks_of(video, arguments.systems, arguments.seeds) for video in chosen}
        runs = make_runs([task for some in tasks.values() for task in some], arguments.out, arguments.jobs)
        judged = [judge(video, tasks[video.name], runs, expected.get(video.name)) for video in chosen]
        text = table(judged)
        (arguments.out / "table.md").write_text(text + "\n", encoding="utf-8")
        write_page(arguments.out / "page.html", judged, text)
        print("\n" + text)
    except DvoError as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    main()
