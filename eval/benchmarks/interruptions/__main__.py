"""Interrupted sequences: `python -m eval.benchmarks.interruptions` prints if a tracker gives poses where there is a
view, and only there.

Rendered scenes of held-out families and, where the data are there, recordings are interrupted by black, white and noise
frames (15, 30, 60 and 150 of them), another scene, a frozen image, and a gap in time. Frames without a view must not be
tracked, frames with one must be, every interruption must be told, and each segment must be as accurate as the same
frames of the sequence without the interruption.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch

import dvo
from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.processes import die_with_parent
from dvo.data.files.root import data_root
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Odometry
from eval.benchmarks.interruptions.scoring import Score, score
from eval.benchmarks.interruptions.trials import (
    AFTER,
    BEFORE,
    DURATIONS,
    OTHERS,
    WITHOUT_VIEW,
    Clip,
    Trial,
    interrupt,
    recording,
    rendered,
)

RECORDINGS = ("kitti00_120", "7scenes_redkitchen_400")


def clips(arguments: argparse.Namespace) -> Iterator[tuple[Clip, int]]:
    """Clips of the trials, each with the seed of tracker and interruptions.

    Args:
        arguments: of the command line.
    """
    longest = BEFORE + max(arguments.durations) + AFTER
    for seed in range(arguments.seeds):
        if "rendered" in arguments.clips:
            yield rendered(seed, arguments.split, longest), seed
        for name in RECORDINGS:
            if name in arguments.clips and (data_root() / name).is_dir():
                yield recording(name, longest), seed


def trials(clip: Clip, seed: int, arguments: argparse.Namespace) -> Iterator[Trial]:
    """Interruptions of a clip.

    Args:
        clip: good frames.
        seed: of the images.
        arguments: of the command line.
    """
    for kind in arguments.kinds:
        single = min(60, max(arguments.durations), len(clip.frames) - BEFORE - 30)
        for duration in arguments.durations if kind in WITHOUT_VIEW else [single]:
            other = rendered(seed + 1, arguments.split, BEFORE + duration) if kind == "other scene" else None
            # Recordings too short to go on during the interruption stand still in it.
            moves = len(clip.frames) >= BEFORE + duration + 30
            yield interrupt(clip, kind, duration, seed, other=other, moves=moves or kind == "gap")


def run(arguments: argparse.Namespace) -> list[Score]:
    """Run all trials; a line is printed, and written if asked for, after each.

    The frames before the interruption are tracked once for each clip; every trial goes on from there in a process of
    its own.

    Args:
        arguments: of the command line.

    Returns:
        Scores.
    """
    torch.set_num_threads(1)  # processes that are forked cannot share threads, and all trials run with one number
    scores = []
    for clip, seed in clips(arguments):
        whole = dvo.load(arguments.weights, seed=seed, device=arguments.device)
        for frame in clip.frames:
            whole.track(frame)
        unbroken = whole.finish().trajectory
        odometry = dvo.load(arguments.weights, seed=seed, device=arguments.device)
        before: list[Estimate] = []
        with ThreadPoolExecutor(arguments.jobs) as pool:
            jobs = []
            for trial in trials(clip, seed, arguments):
                while len(before) < trial.cut:
                    before.append(odometry.track(trial.frames[len(before)]))
                jobs.append(pool.submit(_forked, partial(_finish, odometry, before, trial, clip, unbroken)))
            for job in jobs:
                scores.append(job.result())
                print(line(scores[-1]), flush=True)
                if arguments.out:
                    with arguments.out.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(asdict(scores[-1])) + "\n")
    return scores


def _finish(odometry: Odometry, before: list[Estimate], trial: Trial, clip: Clip, unbroken: Trajectory) -> Score:
    """Track a trial from the interruption on, and score it."""
    after = [odometry.track(frame) for frame in trial.frames[trial.cut :]]
    return score(trial, clip, [*before, *after], odometry.finish(), unbroken)


def _forked(work: Callable[[], Score]) -> Score:
    """Run a function in a forked process, which changes nothing in this one."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def carry_out() -> None:
        die_with_parent()
        sender.send(work())

    process = context.Process(target=carry_out)
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError as error:
        raise DvoError("a trial failed", remedy="see its messages above") from error
    finally:
        process.join()


def line(found: Score) -> str:
    """One line for a trial.

    Args:
        found: its score.
    """
    scale = "" if found.scale is None else f", scale {found.scale:.2f}"
    moved = f", moved {found.moved:.4f}" if found.kind == "frozen" else ""
    return (
        f"{found.clip:>24s} seed {found.seed} {found.kind:>11s} {found.duration:3d}: "
        f"false {found.false_poses}/{found.dark}, posed {found.posed}/{found.good}, "
        f"tracked again after {found.recovery}, "
        f"{'told' if found.told else 'not told'}, {found.segments} segments{scale}{moved}, "
        f"ATE {found.error:.4f} m, uninterrupted {found.error_without:.4f} m"
    )


def summary(scores: list[Score]) -> str:
    """Totals by kind of interruption.

    Args:
        scores: of the trials.

    Returns:
        Table in Markdown. The ratio is the median over trials of the error to that without the interruption.
    """
    rows = [
        "| interruption | trials | false poses | good frames posed | tracked again within 15 | told | ATE ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in [*WITHOUT_VIEW, *OTHERS, "all"]:
        chosen = [found for found in scores if kind in (found.kind, "all")]
        if not chosen:
            continue
        dark, false_poses = sum(found.dark for found in chosen), sum(found.false_poses for found in chosen)
        good, posed = sum(found.good for found in chosen), sum(found.posed for found in chosen)
        soon = sum(found.recovery is not None and found.recovery <= 15 for found in chosen)
        told = [found for found in chosen if found.kind != "frozen"]
        kept = [is_told(found) for found in told]
        ratio = np.nanmedian([found.error / max(found.error_without, 1e-9) for found in chosen])
        rows.append(
            f"| {kind} | {len(chosen)} | {false_poses} of {dark} | {posed} of {good} ({100 * posed / good:.1f} %) "
            f"| {soon} of {len(chosen)} | {sum(kept)} of {len(told)} | {ratio:.2f} |"
        )
    return "\n".join(rows)


def is_told(found: Score) -> bool:
    """Decide if an interruption passes: told as a break, or bridged with the scale kept within 5 %.

    Args:
        found: score of the trial.
    """
    return found.told or (found.kind == "gap" and found.scale is not None and abs(found.scale - 1) < 0.05)


def main() -> None:
    """Entry point."""
    parser = OneLineParser(prog="python -m eval.benchmarks.interruptions", description=__doc__)
    parser.add_argument("--weights", default="small", metavar="NAME|FILE")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--split", choices=("calibration", "test"), default="test", help="rendered scenes")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="trials at the same time")
    parser.add_argument("--seeds", type=int, default=3, metavar="N")
    parser.add_argument("--clips", nargs="+", default=["rendered", *RECORDINGS], metavar="NAME")
    parser.add_argument("--kinds", nargs="+", default=[*WITHOUT_VIEW, *OTHERS], choices=[*WITHOUT_VIEW, *OTHERS])
    parser.add_argument("--durations", nargs="+", type=int, default=list(DURATIONS), metavar="FRAMES")
    parser.add_argument("--out", type=Path, metavar="FILE", help="append the scores as JSON lines")
    arguments = parser.parse_args()
    try:
        print("\n" + summary(run(arguments)))
    except DvoError as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    main()
