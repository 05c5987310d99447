"""Weights of the measurements against their errors: chi-square, and the scale that makes it one.

``python -m eval.benchmarks.weight_calibration [--suites plain,scale] [--weights small] [--seed 0]``

Tracks rendered sequences of scenes that do not move and compares every measurement, when it leaves the window, with the
true position of its patch. A weight ``w`` says that the variance of the measurement is ``sigma^2 / w``, for each axis;
then ``w r^2 / sigma^2`` of the residuals ``r`` (feature pixels) has the mean 1, chi-square for each degree of freedom,
and the median 0.455. ``sigma`` is fitted on every other sequence, from the mean and from the median (which wrong
matches do not move), and chi-square printed for those that it was not fitted on: for measurements of the network, and
for those that the sub-pixel alignment replaced.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.threads import settle_threads
from dvo.odometry.load import load
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.synth.sequence import SyntheticSequence, make_sequence
from eval.benchmarks.true_positions import TruePositions
from eval.suites.suite import Sequence, read_suites

MEDIAN = 0.45494
"""Median of chi-square with one degree of freedom."""
BINS = (0.0, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
"""Limits of the bins of the confidence of the network; an aligned measurement has that of the one it replaced."""
KINDS = ("network", "aligned")


@dataclass(frozen=True)
class Errors:
    """Errors of measurements, an entry for each axis of each.

    Attributes:
        squared: squared residuals, feature pixels squared.
        weights: in bundle adjustment.
        confidence: of the network, which is the weight unless the measurement is aligned.
    """

    squared: Tensor
    weights: Tensor
    confidence: Tensor

    @property
    def chi_square(self) -> Tensor:
        """``w r^2`` of every entry."""
        return self.weights * self.squared

    def between(self, low: float, high: float) -> Errors:
        """Entries whose confidence is above ``low`` and at most ``high``."""
        rows = (self.confidence > low) & (self.confidence <= high)
        return Errors(self.squared[rows], self.weights[rows], self.confidence[rows])

    @classmethod
    def concatenate(cls, parts: list[Errors]) -> Errors:
        """All entries, in order."""
        names = ("squared", "weights", "confidence")
        return cls(*(torch.cat([torch.zeros(0), *(getattr(part, name) for part in parts)]) for name in names))


@dataclass(frozen=True)
class Chi:
    """Chi-square for each degree of freedom, 1 for weights that are inverse variances.

    Attributes:
        count: degrees of freedom.
        mean: mean of ``w r^2``.
        robust: median of ``w r^2`` over that of a Gaussian error.
    """

    count: int
    mean: float
    robust: float

    @property
    def sigma(self) -> float:
        """Standard deviation of a measurement of weight 1 by the mean, feature pixels."""
        return self.mean**0.5

    @property
    def robust_sigma(self) -> float:
        """Standard deviation of a measurement of weight 1 by the median, feature pixels."""
        return self.robust**0.5


def chi_of(errors: Errors) -> Chi:
    """Chi-square of measurements; nan without any."""
    values = errors.chi_square
    if not len(values):
        return Chi(0, float("nan"), float("nan"))
    return Chi(len(values), float(values.double().mean()), float(values.median()) / MEDIAN)


class Recorder:
    """Records the errors of the edges that leave the window of a tracker, before and after their alignment.

    Args:
        odometry: a tracker before its first frame, with ``align="final"``.
        truth: of the sequence that it tracks.
    """

    def __init__(self, odometry: PatchOdometry, truth: TruePositions) -> None:
        self.window, self.truth = odometry.window, truth
        self._finalise = odometry.patch_window.finalise
        self._parts: dict[str, list[Errors]] = {kind: [] for kind in KINDS}
        odometry.patch_window.finalise = self._record  # type: ignore[method-assign]

    def _record(self, edges: Tensor) -> None:
        window = self.window
        positions, seen = self.truth.find(window, edges)
        confidence = window.weights[edges]
        self._add("network", window.targets[edges] - positions, confidence, confidence, seen)
        self._finalise(edges)
        aligned = seen & (window.weights[edges] != confidence).any(-1)
        self._add("aligned", window.targets[edges] - positions, window.weights[edges], confidence, aligned)

    def _add(self, kind: str, residual: Tensor, weights: Tensor, confidence: Tensor, rows: Tensor) -> None:
        parts = (residual[rows].square(), weights[rows], confidence[rows])
        self._parts[kind].append(Errors(*(part.flatten() for part in parts)))

    def errors(self) -> dict[str, Errors]:
        """Errors so far by kind: ``network`` of all measurements, ``aligned`` of those that were replaced."""
        return {kind: Errors.concatenate(parts) for kind, parts in self._parts.items()}


def measure(sequence: SyntheticSequence, weights: str, seed: int) -> dict[str, Errors]:
    """Track a sequence and compare its measurements with the truth.

    Args:
        sequence: rendered, of the size of the working image, of a scene that does not move.
        weights: name or file.
        seed: of the tracker.

    Returns:
        Errors by kind.

    Raises:
        DvoError: no such weights, or those of a network without patches.
    """
    frames = list(sequence)
    depth = torch.stack([torch.as_tensor(sequence.rendering(i).depth[0]) for i in range(len(sequence))])
    odometry = load(weights, seed=seed, final_adjustment=False)
    if not isinstance(odometry, PatchOdometry):
        raise DvoError("measures no patches", file=weights, field="--weights", remedy="give weights of a patch network")
    recorder = Recorder(odometry, TruePositions(sequence, depth))
    for frame in frames:
        odometry.track(frame)
    odometry.finish()
    return recorder.errors()


def table(kind: str, fitted: Errors, held_out: Errors) -> list[str]:
    """Lines of the result for one kind of measurements.

    Args:
        kind: name in :data:`KINDS`.
        fitted, held_out: errors on the sequences that ``sigma`` is fitted on, and on the others.
    """
    fit = chi_of(fitted)
    lines = [
        f"{kind}: sigma {fit.sigma:.4f} (mean), {fit.robust_sigma:.4f} (median) feature pixels of {fit.count} entries",
        f"  {'confidence':>14} {'entries':>8} {'RMS px':>8} {'chi2':>8} {'robust':>8} | held out, over sigma^2:"
        f" {'entries':>8} {'chi2':>7} {'robust':>7}",
    ]
    for low, high in [(0.0, 1.0), *zip(BINS, BINS[1:], strict=False)]:
        here, there = fitted.between(low, high), chi_of(held_out.between(low, high))
        chi = chi_of(here)
        rms = float(here.squared.double().mean()) ** 0.5 if chi.count else float("nan")
        lines.append(
            f"  {f'{low:g} to {high:g}':>14} {chi.count:8} {rms:8.4f} {chi.mean:8.4f} {chi.robust:8.4f} |"
            f" {'':23}{there.count:8} {there.mean / fit.mean:7.2f} {there.robust / fit.robust:7.2f}"
        )
    return lines


def rendered_sequences(suites: str) -> list[Sequence]:
    """Entries of rendered suites.

    Args:
        suites: names, with commas.

    Raises:
        DvoError: no such suite, or a recording in it, whose true positions are not known.
    """
    entries = [entry for name in suites.split(",") for suite in read_suites(name) for entry in suite.sequences]
    for entry in entries:
        if entry.rendered is None:
            remedy = "name suites of rendered sequences, such as plain"
            raise DvoError(f"{entry.name} is a recording", field="--suites", remedy=remedy)
    return entries


def main(arguments: list[str] | None = None) -> int:
    """Track the sequences and print the tables; bad input ends with code 2 and one line.

    Args:
        arguments: of the command line; None: those of the process.
    """
    parser = OneLineParser(
        prog="python -m eval.benchmarks.weight_calibration", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--suites", default="plain,scale,textureless,fast,blur", help="with commas (%(default)s)")
    parser.add_argument("--weights", default="small", help="name or file (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    settle_threads()
    try:
        _print_tables(rendered_sequences(given.suites), given.weights, given.seed)
    except DvoError as error:
        print(f"weight_calibration: error: {error}", file=sys.stderr)
        return 2
    return 0


def _print_tables(entries: list[Sequence], weights: str, seed: int) -> None:
    halves: tuple[list[dict[str, Errors]], list[dict[str, Errors]]] = ([], [])
    for number, entry in enumerate(entries):
        options = {name: value for name, value in entry.rendered or () if name != "version"}
        errors = measure(make_sequence(**options), weights, seed)
        halves[number % 2].append(errors)
        chis = (f"{kind} {chi_of(errors[kind]).mean:.4f} / {chi_of(errors[kind]).robust:.4f}" for kind in KINDS)
        print(f"{entry.name:28} {('fitted', 'held out')[number % 2]:9} mean / robust: {', '.join(chis)}", flush=True)
    for kind in KINDS:
        fitted, held_out = (Errors.concatenate([errors[kind] for errors in half]) for half in halves)
        print("\n".join(table(kind, fitted, held_out)), flush=True)


if __name__ == "__main__":
    sys.exit(main())
