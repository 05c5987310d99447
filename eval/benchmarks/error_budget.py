"""Share of the error that measurements, and the tracker around them, have in a trajectory.

``python -m eval.benchmarks.error_budget [--suites plain] [--weights small] [--seed 0]``

Tracks rendered sequences with the measurements of the network, aligned or not, and with the true positions of the
patches in their place (after the initialisation, which is the network's), each with and without the final adjustment.
The error that is left with true measurements is the tracker's own.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dvo.core.command_line import OneLineParser
from dvo.core.threads import settle_threads
from dvo.map.window import Window
from dvo.metrics import Metrics, evaluate
from dvo.models.step import Measurement, Revision, UpdateState
from dvo.odometry.load import load
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.synth.sequence import SyntheticSequence, make_sequence
from eval.benchmarks.true_positions import TruePositions
from eval.suites.suite import read_suites

CASES = {
    "network": {"align": "none", "final_adjustment": False},
    "network, adjusted": {"align": "none"},
    "network, aligned, adjusted": {"align": "final"},
    "true positions": {"align": "always", "final_adjustment": False},
    "true positions, adjusted": {"align": "always"},
}


class TrueMeasurements:
    """Stage of the step that replaces the measurements of the network by the true positions of the patches.

    Args:
        window: of the tracker.
        sequence: that it tracks.
        depth: ``(N, H, W)`` of its frames.
    """

    def __init__(self, window: Window, sequence: SyntheticSequence, depth: Tensor) -> None:
        self.window, self.truth = window, TruePositions(sequence, depth)

    def snapshot(self, results: bool) -> None:
        """Nothing is kept."""

    def keep_image(self, map_slot: int, image: np.ndarray) -> None:
        """Nothing: images are not needed."""

    def forget(self, edge_slots: Tensor) -> None:
        """Nothing: there is no cache."""

    def __call__(self, state: UpdateState, revision: Revision) -> Measurement:
        """True positions where the patch is visible, otherwise no measurement; see :class:`dvo.models.step.Refinement`.

        Args:
            state: of the window.
            revision: output of the network, whose weights stay.
        """
        targets, seen = self.truth.find(self.window)
        return Measurement(targets[None], revision.weights * seen[None, :, None])


def measure(sequence: SyntheticSequence, depth: Tensor, case: str, weights: str, seed: int) -> Metrics:
    """Track a sequence in one of the :data:`CASES`.

    Args:
        sequence: rendered, of the size of the working image.
        depth: ``(N, H, W)`` of its frames.
        case: name in :data:`CASES`.
        weights: name or file.
        seed: of the tracker.

    Returns:
        Errors of the trajectory.
    """
    odometry = load(weights, seed=seed, **CASES[case])
    assert isinstance(odometry, PatchOdometry)
    if case.startswith("true"):
        odometry.patch_window.alignment = TrueMeasurements(odometry.window, sequence, depth)  # type: ignore[assignment]
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
            depth = torch.stack([torch.as_tensor(sequence.rendering(i).depth[0]) for i in range(len(sequence))])
            for case in CASES:
                m = measure(sequence, depth, case, given.weights, given.seed)
                print(
                    f"{entry.name:30} {case:28} {m.ate_percent:7.3f} {m.rpe_rot_deg:9.4f} {m.scale_drift:+12.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
