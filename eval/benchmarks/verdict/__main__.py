"""Verdicts on runs that are right and on runs that were made to fail: `python -m eval.benchmarks.verdict`.

Rendered clips are tracked as they are, under the conditions of the rendered suites, and after a change that makes the
odometry fail: something fixed to the camera, a crowd, waves, a floating crop, a wrong focal length, a lens whose
distortion is not in the calibration, frames left out, a spoiled network, something that moves before a camera that
stands still. A run is wrong if its ATE is above 2 % of the
path and above five times that of the best of dvo, `keyframe` and `klt-pnp` on the same clip as it was rendered, or if
it has poses before a camera that stands still. Scenes with an even number were there to choose the thresholds of
`dvo.odometry.quality` by; those of the odd ones are printed apart. Intervals are Wilson's of 95 %.

Runs are kept in `--out`, and the same command goes on from there.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from dvo.core.command_line import OneLineParser
from eval.benchmarks.verdict.trials import KINDS, Outcome, Trial, carry_out
from eval.execution.fresh_processes import in_fresh_processes


def interval(count: int, total: int) -> str:
    """Share with its interval (Wilson, 1927), in percent."""
    if not total:
        return "-"
    p, z = count / total, 1.96
    middle, half = p + z * z / (2 * total), z * math.sqrt(p * (1 - p) / total + (z / (2 * total)) ** 2)
    low, high = ((middle + sign * half) / (1 + z * z / total) for sign in (-1, 1))
    return f"{count} of {total}, {100 * p:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def table(outcomes: Sequence[Outcome]) -> str:
    """Table in Markdown: for each kind, runs that are right and wrong, and those told.

    Args:
        outcomes: of all trials; runs without poses are in none of the two groups.
    """
    lines = [
        "| kind | runs | no pose | wrong | of these not good | right | of these not good |",
        "|---|--:|--:|--:|---|--:|---|",
    ]
    given = [one for one in outcomes if one.poses]
    for kind in (*KINDS, "all"):
        mine = [one for one in given if kind in (one.kind, "all")]
        every = [one for one in outcomes if kind in (one.kind, "all")]
        cells = []
        for wrong in (True, False):
            group = [one for one in mine if one.wrong is wrong]
            told = sum(one.quality["verdict"] != "good" for one in group)
            cells += [str(len(group)), interval(told, len(group))]
        lines.append(f"| {kind} | {len(every)} | {len(every) - len(mine)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(given: list[str] | None = None) -> None:
    """Command line."""
    parser = OneLineParser(
        prog="python -m eval.benchmarks.verdict", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--right", type=int, default=160, metavar="N", help="clips as rendered")
    parser.add_argument("--wrong", type=int, default=24, metavar="N", help="clips of each kind of failure")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs at the same time")
    parser.add_argument("--out", type=Path, default=Path("runs/verdict"), metavar="DIR")
    options = parser.parse_args(given)
    trials = [Trial("right", n) for n in range(options.right)]
    trials += [Trial(kind, n) for n in range(options.wrong) for kind in KINDS[1:]]
    trials.sort(key=lambda trial: trial.number / (options.right if trial.kind == "right" else options.wrong))
    for name in ("right", "wrong", "jobs"):
        if getattr(options, name) < 1:
            parser.error(f"--{name}: must be 1 or more")
    options.out.mkdir(parents=True, exist_ok=True)
    record = options.out / "outcomes.jsonl"
    lines = record.read_text(encoding="utf-8").splitlines() if record.exists() else []
    try:
        outcomes = {(values["kind"], values["number"]): Outcome(**values) for values in map(json.loads, lines)}
    except (ValueError, TypeError, KeyError) as error:
        parser.error(f"{record}: not an outcome ({error}); give another --out, or remove the line")
    missing = [trial for trial in trials if (trial.kind, trial.number) not in outcomes]
    for done in in_fresh_processes(carry_out, missing, jobs=options.jobs, each=16):
        outcomes[done.kind, done.number] = done
        with record.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(done)) + "\n")
        ate = "" if done.ate is None else f", ATE {done.ate:.2f} %"
        print(f"{done.kind} {done.number}: {'wrong' if done.wrong else 'right'}{ate}, "
              f"{done.quality['verdict']} {done.quality['reason']}", flush=True)  # fmt: skip
    for parity, name in ((0, "scenes that thresholds were chosen by"), (1, "the other scenes")):
        print(f"\n{name}:\n\n" + table([outcomes[t.kind, t.number] for t in trials if t.number % 2 == parity]))


if __name__ == "__main__":
    main()
