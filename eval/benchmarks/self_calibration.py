"""Self-calibration against rendered cameras: ``python -m eval.benchmarks.self_calibration [--clips 7] [--frames 60]``.

Clips of held-out families are calibrated from their images alone (:func:`dvo.calibrate`): four of cameras without
distortion, whose focal length and principal point are drawn at random, and three of lenses with barrel distortion. The
table has true values, found ones with their standard deviations, the ATE in percent of the path with the true camera
and with the one that was found, and the root mean square of the errors in deviations; what is not told is a dash.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace

import dvo
from dvo.core.command_line import OneLineParser
from dvo.core.threads import settle_threads
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera, DistortionModel
from dvo.geometry.undistort import Undistorter
from dvo.metrics import evaluate
from dvo.odometry.calibration.calibrate import CalibrationOptions, calibrate
from dvo.odometry.calibration.camera_estimate import SelfCalibration
from dvo.synth.sequence import SyntheticSequence, make_sequence

FAMILIES = ("hall", "gallery", "courtyard")
KINDS = ("handheld", "loop")
FIRST_SEED = 4_320_000_000
PINHOLES = 4
BENT: tuple[tuple[float, DistortionModel, tuple[float, ...]], ...] = (
    (190.0, "radtan", (-0.25, 0.05, 0.0, 0.0)),
    (180.0, "fisheye", (0.0, 0.0, 0.0, 0.0)),
    (260.0, "radtan", (-0.1, 0.0, 0.0, 0.0)),
)
"""Focal length and lens of the clips after :data:`PINHOLES`: of an action camera, equidistant, of a phone with a wide
view."""


def clip(number: int, frames: int) -> SyntheticSequence:
    """Rendered clip, 15 frames a second, 320x240.

    Args:
        number: of the clip; families and kinds of motion take turns.
        frames: length.
    """
    family, kind = FAMILIES[number % len(FAMILIES)], KINDS[number // len(FAMILIES) % len(KINDS)]
    pinhole = make_sequence(
        FIRST_SEED + number, frames=frames, height=240, width=320, fps=15.0, family=family, kind=kind, apart=True
    )
    if number < PINHOLES:
        return pinhole
    focal, model, coefficients = BENT[(number - PINHOLES) % len(BENT)]
    camera = replace(pinhole.camera, fx=focal, fy=focal, model=model, coefficients=coefficients)
    return replace(pinhole, camera=camera)


def ate_percent(frames: Sequence[Frame], camera: Camera, truth: Trajectory) -> float:
    """ATE in percent of the path after Sim(3) alignment.

    Args:
        frames: as recorded.
        camera: that they are tracked with, its distortion taken from them.
        truth: poses.
    """
    undistorter = Undistorter(camera)
    pinhole = [replace(frame, image=undistorter(frame.image), camera=undistorter.camera) for frame in frames]
    return evaluate(dvo.run(dvo.load("small"), pinhole).result.trajectory, truth).ate_percent


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


def row(
    name: str, found: SelfCalibration, focal: float, cx: float, cy: float, ates: tuple[float, float] | None = None
) -> str:
    """Line of the table; see :func:`errors` and :func:`ate_percent`, of the true camera and of that found."""
    c = found.calibration
    cells = [name, f"{focal:.1f}", f"{c.fx:.1f} +- {found.deviation:.1f}" if found.found else "cannot tell"]
    for value, sigma, true in zip((c.cx, c.cy), found.aside_deviation, (cx, cy), strict=True):
        cells += [f"{true:.1f}", f"{value:.1f} +- {sigma:.1f}" if math.isfinite(sigma) else "\u2013"]
    cells.append(f"{found.bend:.2f} +- {found.bend_deviation:.2f}" if found.bend else "\u2013")
    if ates is not None:
        cells.append(", ".join(f"{value:.2f}" for value in ates))
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Run the benchmark and print the table."""
    parser = OneLineParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=PINHOLES + len(BENT))
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    settle_threads()
    print("| clip | f true | found | cx true | found | cy true | found | alpha found | ATE % true, found |")
    print(f"|---|{8 * '--:|'}")
    everything = []
    for number in range(arguments.clips):
        sequence = clip(number, arguments.frames)
        frames = list(sequence)
        camera = frames[0].camera
        found = calibrate(frames, options=CalibrationOptions(frames=arguments.frames))
        truth = (camera.fx + camera.fy) / 2, camera.cx, camera.cy
        everything += errors(found, *truth)
        lens = camera.coefficients[:2] if camera.model == "radtan" else camera.model
        name = f"{FAMILIES[number % len(FAMILIES)]} {number}" + (f", {lens}" if camera.needs_undistortion else "")
        found_camera = found.calibration.camera(camera.width, camera.height)
        poses = sequence.groundtruth
        ates = ate_percent(frames, camera, poses), ate_percent(frames, found_camera, poses)
        print(row(name, found, *truth, ates), flush=True)
    if everything:
        mean = math.sqrt(sum(error**2 for error in everything) / len(everything))
        print(f"root mean square error of {len(everything)} values: {mean:.2f} standard deviations")


if __name__ == "__main__":
    main()
