"""Self-calibration against rendered cameras: ``python -m eval.benchmarks.self_calibration [--clips 4] [--frames 60]``.

Clips of held-out families, whose focal length and principal point are drawn at random, are calibrated from their images
alone (:func:`dvo.calibrate`). The table has true values, found ones with their standard deviations, and the root mean
square of the errors in deviations; a coordinate of the principal point that is not told is a dash.
"""

from __future__ import annotations

import argparse
import math

from dvo.core.command_line import OneLineParser
from dvo.core.threads import settle_threads
from dvo.odometry.calibration.calibrate import CalibrationOptions, calibrate
from dvo.odometry.calibration.camera_estimate import SelfCalibration
from dvo.synth.sequence import SyntheticSequence, make_sequence

FAMILIES = ("hall", "gallery", "courtyard")
KINDS = ("handheld", "loop")
FIRST_SEED = 4_320_000_000


def clip(number: int, frames: int) -> SyntheticSequence:
    """Rendered clip, 15 frames a second, 320x240.

    Args:
        number: of the clip; families and kinds of motion take turns.
        frames: length.
    """
    family, kind = FAMILIES[number % len(FAMILIES)], KINDS[number // len(FAMILIES) % len(KINDS)]
    return make_sequence(
        FIRST_SEED + number, frames=frames, height=240, width=320, fps=15.0, family=family, kind=kind, apart=True
    )


def errors(found: SelfCalibration, focal: float, cx: float, cy: float) -> list[float]:
    """Errors of what was told, in standard deviations.

    Args:
        found: by the images.
        focal, cx, cy: true values, pixels.
    """
    c = found.calibration
    told = [(c.fx, found.deviation, focal)] if found.found else []
    told += [
        (value, sigma, true) for value, sigma, true in zip((c.cx, c.cy), found.aside_deviation, (cx, cy), strict=True)
    ]
    return [(value - true) / sigma for value, sigma, true in told if math.isfinite(sigma)]


def row(name: str, found: SelfCalibration, focal: float, cx: float, cy: float) -> str:
    """Line of the table; see :func:`errors`."""
    c = found.calibration
    cells = [name, f"{focal:.1f}", f"{c.fx:.1f} +- {found.deviation:.1f}" if found.found else "cannot tell"]
    for value, sigma, true in zip((c.cx, c.cy), found.aside_deviation, (cx, cy), strict=True):
        cells += [f"{true:.1f}", f"{value:.1f} +- {sigma:.1f}" if math.isfinite(sigma) else "\u2013"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Run the benchmark and print the table."""
    parser = OneLineParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=4)
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    settle_threads()
    print("| clip | f true | found | cx true | found | cy true | found |\n|---|--:|--:|--:|--:|--:|--:|")
    everything = []
    for number in range(arguments.clips):
        sequence = clip(number, arguments.frames)
        frames = list(sequence)
        camera = frames[0].camera
        found = calibrate(frames, options=CalibrationOptions(frames=arguments.frames))
        truth = (camera.fx + camera.fy) / 2, camera.cx, camera.cy
        everything += errors(found, *truth)
        name = f"{FAMILIES[number % len(FAMILIES)]} {number}"
        print(row(name, found, *truth), flush=True)
    if everything:
        mean = math.sqrt(sum(error**2 for error in everything) / len(everything))
        print(f"root mean square error of {len(everything)} values: {mean:.2f} standard deviations")


if __name__ == "__main__":
    main()
