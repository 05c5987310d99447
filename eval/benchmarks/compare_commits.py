"""Speed and results of this checkout compared with an earlier commit.

``python -m eval.benchmarks.compare_commits --base REV [--pairs 5] [--what tracking,ba,training] [--threads 1]``

REV is checked out into a temporary git worktree. Each measurement then runs in new processes of ``--threads`` threads,
base and current alternately, so that varying load of the machine affects both equally; of training, the two processes
of a pair take turns step by step, and the median of their steps counts. The output is every pair and the median of
their ratios (current over base; below 1 the current tree is faster), of processor time and, in brackets, of time on the
wall, which other load of the machine changes more. Of tracking, ``track`` and ``finish`` are told apart, and each
tree also runs ``dvo run`` on the real clips once; their ``trajectory.txt`` are compared byte by byte.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from dvo.core.command_line import OneLineParser, positive_int
from dvo.core.errors import DvoError
from dvo.core.processes import bound
from dvo.data.files.output import scratch_folder
from dvo.data.files.root import data_root
from eval.suites.suite import ROOT

CLIPS = ("kitti00_120", "7scenes_redkitchen_400", "tartanair_v1_60", "tum_fr1_rpy_60")
WHAT = ("tracking", "ba", "training")
SCRIPT = str(Path(__file__).with_name("measurements.py"))  # measures in a working tree
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_SECONDS = re.compile(r"SECONDS (\w+) ([0-9.]+) ([0-9.]+)")


@dataclass(frozen=True)
class Cost:
    """Time of a part of a measurement.

    Attributes:
        processor: processor time of the process, all of its threads, seconds.
        wall: time on the wall, seconds.
    """

    processor: float
    wall: float

    def __truediv__(self, other: Cost) -> Cost:
        """Ratios to another one."""
        return Cost(self.processor / other.processor, self.wall / other.wall)


Costs = dict[str, Cost]
"""Costs of the parts of a measurement, by name."""


@dataclass(frozen=True)
class Settings:
    """Sizes of the measurements.

    Attributes:
        data: folder of the real clips.
        clip, frames: clip of the tracking benchmark, and number of its frames; None for all.
        steps: training steps of one measurement.
        clips: clips whose trajectories are compared.
        preset: of the tracker in this checkout; the base, which may not know it, tracks with its default.
        threads: of each process.
    """

    data: Path
    clip: str = "tartanair_v1_60"
    frames: int | None = None
    steps: int = 15
    clips: tuple[str, ...] = CLIPS
    preset: str = "default"
    threads: int = 1


@contextmanager
def worktree(revision: str, repository: Path = ROOT) -> Iterator[Path]:
    """Temporary checkout of a commit, removed at the end.

    Args:
        revision: commit, branch or tag.
        repository: checkout with the commit in its history.

    Returns:
        Context manager that yields the root of the checkout.

    Raises:
        DvoError: git is not installed, or does not find the commit.
    """
    with scratch_folder("dvo-base") as folder:
        place = folder / "tree"
        _git(repository, "worktree", "add", "--detach", str(place), revision)
        try:
            yield place
        finally:
            _git(repository, "worktree", "remove", "--force", str(place))


def costs(what: str, tree: Path, settings: Settings) -> Costs:
    """Run one measurement in a new process.

    Args:
        what: ``tracking`` or ``ba`` (one call with backward).
        tree: checkout to measure.
        settings: sizes.

    Returns:
        Costs of its parts: ``track`` and ``finish``, or ``ba``.

    Raises:
        DvoError: the process failed, or printed no time.
    """
    clip = [str(settings.data / settings.clip)] if what == "tracking" else []
    frames = ["--frames", str(settings.frames)] if settings.frames else []
    changed = what == "tracking" and tree == ROOT and settings.preset != "default"
    preset = ["--preset", settings.preset] if changed else []
    threads = ["--threads", str(settings.threads)]
    output = _run([sys.executable, SCRIPT, what, *clip, *frames, *preset, *threads], tree, settings.threads)
    found = _read(output)
    if not found:
        raise DvoError("output without a time", file=tree, field=what, remedy="run the measurement by hand")
    return found


class _Steps:
    """Process that takes a training step when it is asked for one."""

    def __init__(self, tree: Path, threads: int) -> None:
        self.tree = tree
        command, pipe = [sys.executable, SCRIPT, "training", "--threads", str(threads)], subprocess.PIPE
        environment = _environment(tree, threads)
        self.process = subprocess.Popen(bound(command), cwd=tree, env=environment, text=True, stdin=pipe, stdout=pipe)
        self._answer("READY")

    def step(self) -> Cost:
        """Take a step; returns its cost."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return _read(self._answer("SECONDS"))["training"]

    def _answer(self, start: str) -> str:
        assert self.process.stdout is not None
        answer = self.process.stdout.readline()
        if not answer.startswith(start):
            raise DvoError("training failed", file=self.tree, remedy=f"run 'python {SCRIPT} training' there")
        return answer

    def close(self) -> None:
        """End the process."""
        self.process.communicate()  # end of its input


def alternate_steps(base: Path, current: Path, count: int, threads: int = 1) -> tuple[Costs, Costs]:
    """Run training steps of two trees by turns, in a new process each.

    Args:
        base, current: roots of the checkouts.
        count: steps of each, after two that do not count.
        threads: of each process.

    Returns:
        Median cost of a step of each tree.

    Raises:
        DvoError: a process failed.
    """
    with ExitStack() as stack:
        processes = [_Steps(tree, threads) for tree in (base, current)]
        for process in processes:
            stack.callback(process.close)
        rounds = [[process.step() for process in processes] for _ in range(count + 2)]
    one, two = ({"training": _median(steps[2:])} for steps in zip(*rounds, strict=True))
    return one, two


def paired(measure: Callable[[Path], Costs], base: Path, current: Path, pairs: int) -> list[tuple[Costs, Costs]]:
    """Measure two trees alternately: base, current, base, current, ...

    Args:
        measure: costs of a tree.
        base, current: roots of the checkouts.
        pairs: number of pairs.

    Returns:
        Costs of base and current, for each pair.
    """
    return [(measure(base), measure(current)) for _ in range(pairs)]


def median_ratios(pairs: list[tuple[Costs, Costs]]) -> Costs:
    """Medians of the ratios current over base.

    Args:
        pairs: costs of base and current.

    Returns:
        Ratios of each part; below 1 the current tree is faster.
    """
    return {part: _median([current[part] / base[part] for base, current in pairs]) for part in pairs[0][0]}


def _median(found: Sequence[Cost]) -> Cost:
    return Cost(*(statistics.median(getattr(cost, clock) for cost in found) for clock in ("processor", "wall")))


def _read(output: str) -> Costs:
    """Costs in the output of a measurement."""
    return {part: Cost(float(processor), float(wall)) for part, processor, wall in _SECONDS.findall(output)}


def trajectory(tree: Path, clip: Path, out: Path, threads: int = 1) -> bytes:
    """Run ``dvo run`` on a clip, with seed 0 on the CPU.

    Args:
        tree: checkout to run.
        clip: folder of the clip.
        out: results folder to write.
        threads: of the process.

    Returns:
        Content of ``trajectory.txt``.

    Raises:
        DvoError: the run failed.
    """
    command = [sys.executable, "-m", "dvo", "run", str(clip), "--out", str(out), "--seed", "0", "--device", "cpu"]
    _run(command, tree, threads)
    return (out / "trajectory.txt").read_bytes()


def same_trajectories(base: Path, current: Path, settings: Settings) -> dict[str, bool]:
    """Compare the trajectories of two trees byte by byte.

    Args:
        base, current: roots of the checkouts.
        settings: the clips, their folder, and threads.

    Returns:
        Clip name to True if the trajectories are equal.
    """
    found = {}
    with scratch_folder("dvo-tracks") as folder:
        for name in settings.clips:
            clip = settings.data / name
            one, two = (
                trajectory(tree, clip, Path(folder) / f"{name}-{k}", settings.threads)
                for k, tree in enumerate((base, current))
            )
            found[name] = one == two
    return found


def _run(command: list[str], tree: Path, threads: int) -> str:
    done = subprocess.run(bound(command), cwd=tree, env=_environment(tree, threads), capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]
        raise DvoError(f"{' '.join(command[1:4])} failed: {last}", file=tree, remedy="run it there by hand")
    return done.stdout


def _environment(tree: Path, threads: int) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(tree), "OMP_WAIT_POLICY": "PASSIVE"} | dict.fromkeys(_THREADS, str(threads))


def _git(repository: Path, *arguments: str) -> None:
    try:
        subprocess.run(["git", "-C", str(repository), *arguments], check=True, capture_output=True, text=True)
    except FileNotFoundError:
        raise DvoError("git is not installed", remedy="install it") from None
    except subprocess.CalledProcessError as error:
        last = (error.stderr.strip().splitlines() or ["failed"])[-1]
        raise DvoError(
            f"git {arguments[0]}: {last}", field="--base", remedy="give a commit of this repository"
        ) from None


def main(arguments: list[str] | None = None) -> int:
    """Run the comparison and print it.

    Args:
        arguments: of the command line; None for those of the process.

    Returns:
        Exit code: 0, or 2 for invalid input.
    """
    line = OneLineParser(prog="python -m eval.benchmarks.compare_commits", description=__doc__,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    line.add_argument("--base", required=True, metavar="REV", help="commit to compare with")
    line.add_argument("--pairs", type=int, default=5, metavar="N", help="number of pairs of each measurement (5)")
    line.add_argument("--what", default=",".join(WHAT), help=f"measurements, separated by commas ({','.join(WHAT)})")
    line.add_argument("--data", type=Path, metavar="DIR", help="folder of the recordings ($DVO_DATA, ../shared/data)")
    line.add_argument("--clip", default=Settings.clip, help=f"clip whose tracking is timed ({Settings.clip})")
    line.add_argument("--frames", type=int, metavar="N", help="number of its frames (all)")
    line.add_argument("--steps", type=int, default=Settings.steps, help=f"training steps of a pair ({Settings.steps})")
    line.add_argument(
        "--clips",
        default=",".join(CLIPS),
        help="clips whose trajectories are compared, separated by commas; '' for none",
    )
    line.add_argument("--preset", default=Settings.preset, help="of the tracker in this checkout (%(default)s)")
    line.add_argument("--threads", type=positive_int, default=Settings.threads, help="of each process (%(default)s)")
    given = line.parse_args(arguments)
    try:
        names = [name for name in given.what.split(",") if name]
        if unknown := [name for name in names if name not in WHAT]:
            raise DvoError(f"no measurement '{unknown[0]}'", field="--what", remedy=f"choose from {', '.join(WHAT)}")
        if given.pairs < 1:
            raise DvoError(f"must be 1 or more, got {given.pairs}", field="--pairs", remedy="give a whole number")
        data = data_root(given.data).resolve() if "tracking" in names else Path()
        clips = tuple(name for name in given.clips.split(",") if name)
        settings = Settings(data, given.clip, given.frames, given.steps, clips, given.preset, given.threads)
        with worktree(given.base) as base:
            for name in names:
                _compare(name, base, settings, given.pairs)
    except DvoError as error:
        print(f"compare_commits: error: {error}", file=sys.stderr)
        return 2
    return 0


def _compare(name: str, base: Path, settings: Settings, pairs: int) -> None:
    measured: list[tuple[Costs, Costs]] = []
    for number in range(pairs):
        if name == "training":
            measured.append(alternate_steps(base, ROOT, settings.steps, settings.threads))
        else:
            measured += paired(lambda tree: costs(name, tree, settings), base, ROOT, 1)
        one, two = measured[-1]
        for part, ratio in median_ratios(measured[-1:]).items():
            print(f"{part:9} pair {number + 1}: base {one[part].processor:.4f} s ({one[part].wall:.4f} s), "
                  f"current {two[part].processor:.4f} s ({two[part].wall:.4f} s), "
                  f"ratio {ratio.processor:.3f} ({ratio.wall:.3f})", flush=True)  # fmt: skip
    for part, ratio in median_ratios(measured).items():
        median = f"{ratio.processor:.3f} (wall {ratio.wall:.3f})"
        print(f"{part:9} median ratio current / base of {pairs} pairs: {median}", flush=True)
    if name == "tracking":
        for clip, same in same_trajectories(base, ROOT, settings).items():
            print(f"{clip:24} trajectory.txt {'same bytes' if same else 'DIFFERENT'}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
