"""Share of the error of a trajectory that sub-pixel alignment and the final adjustment take away.

``python -m eval.benchmarks.error_budget [--suites plain] [--weights small] [--seed 0]``

Tracks rendered sequences with the measurements of the network alone, with the final adjustment of them, and with
measurements that are aligned before it.
"""

from __future__ import annotations

from typing import Any

from dvo.core.command_line import OneLineParser
from dvo.core.threads import settle_threads
from dvo.metrics import Metrics, evaluate
from dvo.odometry.load import load
from dvo.synth.sequence import SyntheticSequence, make_sequence
from eval.suites.suite import read_suites

CASES: dict[str, dict[str, Any]] = {
    "network": {"align": "none", "final_adjustment": False},
    "network, adjusted": {"align": "none"},
    "network, aligned, adjusted": {"align": "final"},
}


def measure(sequence: SyntheticSequence, case: str, weights: str, seed: int) -> Metrics:
    """Track a sequence in one of the :data:`CASES`.

    Args:
        sequence: rendered, of the size of the working image.
        case: name in :data:`CASES`.
        weights: name or file.
        seed: of the tracker.

    Returns:
        Errors of the trajectory.
    """
    odometry = load(weights, seed=seed, **CASES[case])
    for frame in sequence:
        odometry.track(frame)
    return evaluate(odometry.finish().trajectory, sequence.groundtruth)


def main() -> None:
    """Run the comparison and print a line for each sequence and case."""
    parser = OneLineParser(prog="python -m eval.benchmarks.error_budget", description=__doc__)
    parser.add_argument("--suites", default="plain", help="rendered suites with commas between (%(default)s)")
    parser.add_argument("--weights", default="small", help="name or file (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    settle_threads()
    print(f"{'sequence':30} {'measurements':28} {'ATE %':>7} {'RPE deg':>9} {'scale drift':>12}")
    for suite in (suite for name in given.suites.split(",") for suite in read_suites(name)):
        for entry in suite.sequences:
            options = {name: value for name, value in entry.rendered or () if name != "version"}
            sequence = make_sequence(**options)
            for case in CASES:
                m = measure(sequence, case, given.weights, given.seed)
                print(
                    f"{entry.name:30} {case:28} {m.ate_percent:7.3f} {m.rpe_rot_deg:9.4f} {m.scale_drift:+12.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
