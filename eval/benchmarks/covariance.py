"""Covariance and confidence of the tracker's poses against their errors on rendered sequences.

``python -m eval.benchmarks.covariance [--split calibration] [--suites plain,scale] [--frames 70] [--weights small]``

``python -m eval.benchmarks.covariance --scale depth [--split calibration --clips 4]``

After every frame the newest pose relative to the reference of its covariance
(:mod:`dvo.odometry.uncertainty.uncertainty`) is compared with the truth, whose scale is fitted to what the covariance
holds fixed: the RMS distance of the keyframes in between from the reference. Printed are, by sequence, by suite and for
all, the normalised error squared ``xi^T C^-1 xi`` for each of the six degrees of freedom (its expectation is 1), the
same of the rotation and of the position alone, and the displacement that the error causes in the image; and for bins of
the confidence the share of poses whose displacement is below the tolerance that it is the probability of.

The split ``validation`` is that of the suites. ``calibration`` has the same options and other scenes;
``TrackerConfig.covariance_scale`` is fitted on it: the present one times the geometric mean, over the sequences, of
``robust``, their median over that of a chi-square, which poses in a second solution (:mod:`dvo.ba.multistart`) do not
move.

With ``--scale depth`` or ``stereo`` the tracker has the depth images or the right images of the renderings, and is in
metres: the covariance holds no scale, and poses are compared with the truth as they are.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.threads import settle_threads
from dvo.data.frame import Frame, StereoView
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.odometry.load import load
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.uncertainty.displacement import TOLERANCE
from dvo.odometry.uncertainty.gauge import relative_error, window_gauge
from dvo.odometry.uncertainty.uncertainty import WindowMeasurements, window_metric
from dvo.synth.sequence import SyntheticSequence, make_sequence
from eval.benchmarks.weight_calibration import rendered_sequences

SUITES = "plain,scale,textureless,fast,blur,rotation,lighting,dynamic,rolling_shutter,blackout,loop,low_light"
CALIBRATION = -500_000_000
"""Added to the seed of a validation sequence for one of the calibration split."""
MEDIAN = 5.3481 / 6
"""Median of chi-square with six degrees of freedom, over six."""
SCALES = {"none": SUITES, "depth": "rgbd", "stereo": "stereo"}
"""Sources of the scale, and the suites that are tracked with each."""
FARTHEST = 13.107
"""Largest depth that a depth image of the suites can state, metres."""
BASELINE = 0.12
"""Of stereo pairs, metres, where the suite states none."""
CLIP_STEP = 10
"""Added to the seed of a sequence of the calibration split for the next one with the same options."""
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)


@dataclass
class Errors:
    """Errors of the poses of a sequence, an entry for each pose with a covariance.

    Attributes:
        poses: number of poses, those without a covariance included.
        joint, rotation, position: normalised errors squared over the degrees of freedom, 6, 3 and 3.
        displacement: RMS displacement that the error causes in the image, pixels of an image of 320x240.
        expected: the same as the covariance predicts it: root of the mean of its square.
        confidence: of the estimates.
    """

    poses: int = 0
    joint: list[float] = field(default_factory=list)
    rotation: list[float] = field(default_factory=list)
    position: list[float] = field(default_factory=list)
    displacement: list[float] = field(default_factory=list)
    expected: list[float] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)

    def add(self, xi: np.ndarray, covariance: np.ndarray, metric: np.ndarray, confidence: float) -> None:
        """Record a pose.

        Args:
            xi: ``(6,)`` error, see :func:`dvo.odometry.uncertainty.gauge.relative_error`.
            covariance: ``(6, 6)`` of it.
            metric: of :func:`dvo.odometry.uncertainty.displacement.flow_metric`.
            confidence: of the estimate.
        """
        for values, rows in ((self.joint, slice(6)), (self.position, slice(3)), (self.rotation, slice(3, 6))):
            part = covariance[rows, rows]
            values.append(float(xi[rows] @ np.linalg.solve(part, xi[rows])) / len(part))
        self.displacement.append(float(xi @ metric @ xi) ** 0.5)
        self.expected.append(float(np.trace(covariance @ metric)) ** 0.5)
        self.confidence.append(confidence)

    @classmethod
    def concatenate(cls, parts: Sequence[Errors]) -> Errors:
        """All entries, in order."""
        lists = ([value for part in parts for value in getattr(part, name)] for name in _LISTS)
        return cls(sum(part.poses for part in parts), *lists)


_LISTS = ("joint", "rotation", "position", "displacement", "expected", "confidence")


def frames_of(sequence: SyntheticSequence, scale: str = "none", baseline: float = BASELINE) -> Iterator[Frame]:
    """Frames of a sequence, with what the scale is to come from.

    Args:
        sequence: rendered.
        scale: ``depth`` for frames with depth, ``stereo`` for frames with right images, ``none`` for neither.
        baseline: of the stereo pairs, metres.

    Returns:
        The frames, rendered when they are asked for.
    """
    right = sequence.stereo(baseline) if scale == "stereo" else None
    pose = np.array([baseline, 0, 0, 0, 0, 0, 1.0])
    for frame in sequence:
        if scale == "depth":
            depth = sequence.rendering(frame.index).depth[0].cpu().numpy()
            depth = np.where((depth > 0) & (depth <= FARTHEST), depth, np.nan).astype(np.float32)
            yield Frame(frame.index, frame.timestamp, frame.image, frame.camera, depth=depth)
        elif right is not None:
            view = StereoView(right.frame(frame.index).image, right.camera, pose)
            yield Frame(frame.index, frame.timestamp, frame.image, frame.camera, right=view)
        else:
            yield frame


def measure(
    sequence: SyntheticSequence, weights: str, seed: int, scale: str = "none", baseline: float = BASELINE
) -> Errors:
    """Track a sequence and compare each pose with the truth.

    Args:
        sequence: rendered.
        weights: name or file.
        seed: of the tracker.
        scale: source of the scale, a name in :data:`SCALES`.
        baseline: of stereo pairs, metres.

    Returns:
        The errors.

    Raises:
        DvoError: no such weights, or those of a network without patches.
    """
    metric = scale != "none"
    options: dict[str, Any] = {"scale": {scale: True}} if metric else {}
    odometry = load(weights, seed=seed, final_adjustment=False, loops=False, **options)
    if not isinstance(odometry, PatchOdometry):
        raise DvoError("has no covariances", file=weights, field="--weights", remedy="give weights of a patch network")
    times, window = sequence.groundtruth.timestamps, odometry.window
    poses_cw = se3.inverse(torch.from_numpy(sequence.groundtruth.poses_wc))
    errors = Errors()
    for frame in frames_of(sequence, scale, baseline):
        estimate = odometry.track(frame)
        errors.poses += estimate.pose_wc is not None
        gauge = None if estimate.covariance is None else window_gauge(window.problem())
        if estimate.covariance is None or gauge is None:
            continue
        stamps = np.array([keyframe.timestamp for keyframe in window.frames])
        true_cw = poses_cw[np.abs(times - stamps[:, None]).argmin(1)]
        pixels = window_metric(WindowMeasurements.of(odometry.patch_window))
        xi = relative_error(window.poses_cw.cpu(), true_cw, gauge, metric)
        errors.add(xi, estimate.covariance, pixels, estimate.confidence)
    return errors


HEADER = (
    f"{'sequence':30} {'poses':>5} {'with C':>6} | {'NEES/6':>6} {'robust':>6} {'rotation':>8} {'position':>8} |"
    f" {'median px':>9} {'expected':>8}"
)


def line(name: str, errors: Errors) -> str:
    """Line of the first table: means of the normalised errors, ``robust`` by the median, and displacements.

    Args:
        name: of the sequence.
        errors: of its poses.
    """
    if not errors.joint:
        return f"{name:30} {errors.poses:5} {0:6} |"
    joint, rotation, position = (float(np.mean(x)) for x in (errors.joint, errors.rotation, errors.position))
    return (
        f"{name:30} {errors.poses:5} {len(errors.joint):6} | {joint:6.2f} {robust(errors):6.2f} {rotation:8.2f}"
        f" {position:8.2f} | {np.median(errors.displacement):9.3f} {np.median(errors.expected):8.3f}"
    )


def robust(errors: Errors) -> float:
    """Median normalised error over that of a Gaussian's."""
    return float(np.median(errors.joint)) / MEDIAN


def scale_factor(parts: Sequence[Errors]) -> float:
    """Geometric mean, over the sequences, of their :func:`robust` normalised error; nan without any."""
    found = [robust(part) for part in parts if part.joint]
    return float(np.exp(np.mean(np.log(found)))) if found else float("nan")


def confidence_table(groups: dict[str, Errors]) -> Iterator[str]:
    """Lines of the second table: for each bin of the confidence, the poses of each group that are within the tolerance.

    Args:
        groups: errors by name.
    """
    head = "".join(f" | {name:>9} {'share':>6}" for name in groups)
    yield f"{'confidence':>12} {'poses':>6} {'mean':>6} {'share':>6} {'median px':>9}{head}"
    every = Errors.concatenate(list(groups.values()))
    for low, high in zip(BINS, BINS[1:], strict=False):
        count, mean, share, median = _bin(every, low, high)
        parts = (_bin(part, low, high) for part in groups.values())
        rest = "".join(f" | {part[0]:9} {part[2]:6.2f}" for part in parts)
        yield f"{f'{low:g} to {high:g}':>12} {count:6} {mean:6.2f} {share:6.2f} {median:9.3f}{rest}"


def _bin(errors: Errors, low: float, high: float) -> tuple[int, float, float, float]:
    """Poses with a confidence in ``[low, high)``: number, mean confidence, share within the tolerance, median error."""
    confidence, displacement = np.array(errors.confidence), np.array(errors.displacement)
    rows = (confidence >= low) & ((confidence < high) | (high == BINS[-1]))
    if not rows.any():
        return 0, float("nan"), float("nan"), float("nan")
    inside = displacement[rows] < TOLERANCE
    return int(rows.sum()), float(confidence[rows].mean()), float(inside.mean()), float(np.median(displacement[rows]))


def main(arguments: list[str] | None = None) -> int:
    """Track the sequences and print the tables; bad input ends with code 2 and one line.

    Args:
        arguments: of the command line; None: those of the process.
    """
    parser = OneLineParser(
        prog="python -m eval.benchmarks.covariance", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--scale", choices=tuple(SCALES), default="none", help="what it comes from (%(default)s)")
    parser.add_argument("--suites", help=f"with commas (by --scale: {SCALES})")
    parser.add_argument("--clips", type=int, default=1, help="of each sequence of --split calibration (%(default)s)")
    parser.add_argument("--split", choices=("calibration", "validation"), default="validation")
    parser.add_argument("--frames", type=int, default=70, help="of each sequence, from its first on (%(default)s)")
    parser.add_argument("--weights", default="small", help="name or file (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    settle_threads()
    try:
        _print_tables(given)
    except DvoError as error:
        print(f"covariance: error: {error}", file=sys.stderr)
        return 2
    return 0


def _print_tables(given: argparse.Namespace) -> None:
    found: list[Errors] = []
    families: dict[str, list[Errors]] = {}
    suites: dict[str, list[Errors]] = {}
    calibrate = given.split == "calibration"
    entries = rendered_sequences(given.suites or SCALES[given.scale])
    clips = [(entry, clip) for entry in entries for clip in range(given.clips if calibrate else 1)]
    for number, (entry, clip) in enumerate(clips):
        options = {name: value for name, value in entry.rendered or () if name not in ("version", "depth")}
        baseline = float(options.pop("baseline", BASELINE))
        options["seed"] += CALIBRATION + clip * CLIP_STEP if calibrate else 0
        sequence = beginning(make_sequence(**options), given.frames)
        errors = measure(sequence, given.weights, given.seed, given.scale, baseline)
        found.append(errors)
        families.setdefault(options["family"], []).append(errors)
        suites.setdefault(entry.name.rsplit("_validation", 1)[0], []).append(errors)
        if number == 0:
            print(HEADER)
        name = entry.name.replace("validation", given.split)
        print(line(f"{name} clip {clip}" if given.clips > 1 and calibrate else name, errors), flush=True)
    for suite, parts in suites.items():
        print(line(f"suite {suite}", Errors.concatenate(parts)))
    print(line("all", Errors.concatenate(found)))
    print(f"geometric mean of the sequences' robust NEES/6: {scale_factor(found):.2f}")
    tolerance = f"share: displacement below {TOLERANCE:g} px"
    print(f"\n{tolerance}", *confidence_table({k: Errors.concatenate(v) for k, v in families.items()}), sep="\n")


def beginning(sequence: SyntheticSequence, frames: int) -> SyntheticSequence:
    """The first frames of a sequence.

    Args:
        sequence: rendered one.
        frames: their number.

    Returns:
        Sequence of these, each with the same bytes.
    """
    truth = sequence.groundtruth
    return replace(sequence, groundtruth=Trajectory(truth.timestamps[:frames], truth.poses_wc[:frames]))


if __name__ == "__main__":
    sys.exit(main())
