"""Maps that are loaded: `python -m eval.benchmarks.relocalisation [--suites NAMES] [--sequences NAMES] [--seeds 3]`.

Each sequence of the suites `revisit` and `revisit/test` is tracked to a third and saved. The map is loaded, and frames
are tracked in it: those that follow, and those of the second lap from 0.8 of the sequence on, which show the first
third again. The table has the number of frames until the camera was found in the map (at most 3 wanted) and the error
of its pose then, in percent of the way in the map, under the similarity that aligns the map with the truth. Last, each
map meets frames of the other sequences, in which the camera must not be found.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

import dvo
from dvo.data.frame import Frame
from dvo.data.source import Source
from dvo.data.trajectory import Trajectory
from dvo.metrics import associate, fit_alignment, transform
from eval.suites.selection import load_suites
from eval.suites.suite import open_sequence, reference_for

FEW = 3
"""Frames within which the camera is wanted to be found."""
TRIED = 10
"""Frames that are tracked in a map."""
AGAIN = 0.8
"""Share of a sequence after which the second lap shows the first third."""


@dataclass(frozen=True)
class Recorded:
    """Sequence with its truth.

    Attributes:
        name: of the sequence.
        source: its frames.
        truth: a row for each frame.
    """

    name: str
    source: Source
    truth: Trajectory

    def frames(self, start: float, count: int) -> list[Frame]:
        """Frames from a share of the sequence on."""
        first = int(start * len(self.truth))
        return list(islice(self.source, first, first + count))


def saved(recorded: Recorded, seed: int, file: Path) -> Trajectory:
    """Track the first third and save it; the trajectory that the map holds."""
    odometry = dvo.load("small", seed=seed)
    for frame in islice(recorded.source, len(recorded.truth) // 3):
        odometry.track(frame)
    odometry.save(file)
    return dvo.load_map(file).finish().trajectory


def found_after(file: Path, frames: Iterable[Frame], seed: int) -> tuple[int | None, dvo.Estimate | None]:
    """Number of frames until the camera is found in a map, and the estimate that tells of it; None if it is not."""
    odometry = dvo.load_map(file, seed=seed)
    for count, frame in enumerate(frames, 1):
        estimate = odometry.track(frame)
        if estimate.recovered:
            return count, estimate
    return None, None


def error_percent(estimate: dvo.Estimate, known: Trajectory, truth: Trajectory) -> float:
    """Distance of a pose from the truth, in percent of the way in the map."""
    own, true = associate(known, truth)
    assert estimate.pose_wc is not None
    pose = Trajectory(np.array([estimate.timestamp]), estimate.pose_wc[None])
    aligned = transform(pose, *fit_alignment(known.positions[own], truth.positions[true], "sim3"))
    at = int(np.abs(truth.timestamps - estimate.timestamp).argmin())
    way = float(np.linalg.norm(np.diff(truth.positions[true], axis=0), axis=1).sum())
    return 100 * float(np.linalg.norm(aligned.positions[0] - truth.positions[at])) / way


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suites", type=lambda text: text.split(","), default=["revisit", "revisit/test"])
    parser.add_argument("--sequences", type=lambda text: text.split(","), help="names with commas between")
    parser.add_argument("--seeds", type=int, default=3, help="of the tracker, 0 to N-1 (3)")
    options = parser.parse_args(arguments)
    recorded = []
    for suite in load_suites(options.suites, options.sequences):
        for sequence in suite.sequences:
            source, truth = open_sequence(sequence, Path(), suite.stride)
            stamps = np.array([frame.timestamp for frame in source])
            recorded.append(Recorded(sequence.name, source, reference_for(truth, stamps)))
    within = {"goes on": 0, "comes back": 0}
    elsewhere = wrong = 0
    print("| sequence | seed | frames, goes on | error % | frames, comes back | error % |\n|---|--:|--:|--:|--:|--:|")
    with tempfile.TemporaryDirectory() as folder:
        for one in recorded:
            for seed in range(options.seeds):
                file = Path(folder) / f"{one.name}_{seed}.dvo"
                known, cells = saved(one, seed, file), []
                for kind, start in (("goes on", 1 / 3), ("comes back", AGAIN)):
                    count, estimate = found_after(file, one.frames(start, TRIED), seed)
                    within[kind] += count is not None and count <= FEW
                    error = "-" if estimate is None else f"{error_percent(estimate, known, one.truth):.2f}"
                    cells += ["-" if count is None else str(count), error]
                print(f"| {one.name} | {seed} | {' | '.join(cells)} |", flush=True)
            for other in recorded:
                if other is not one:
                    elsewhere += 1
                    wrong += found_after(Path(folder) / f"{one.name}_0.dvo", other.frames(0.2, TRIED), 0)[0] is not None
    runs = len(recorded) * options.seeds
    print(f"\nFound within {FEW} frames: " + ", ".join(f"{kind} {count} of {runs}" for kind, count in within.items()))
    print(f"Found in maps of other places: {wrong} of {elsewhere}")


if __name__ == "__main__":
    main()
