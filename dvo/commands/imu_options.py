"""Options of ``dvo imu``, in a module that imports nothing heavy."""

from __future__ import annotations

import argparse
from typing import Any

from dvo.commands.input_options import add_inertial_options
from dvo.core.command_line import positive_float, positive_int, seed

_CODES = "exit codes: 0 usable, 1 findings that make the samples unusable, 2 bad input"


def add_imu(commands: Any) -> None:
    """Add the command.

    Args:
        commands: sub-parsers of the command line.
    """
    group = commands.add_parser("imu", help="check an inertial sensor")
    verbs = group.add_subparsers(dest="verb", required=True, metavar="VERB")
    parser: argparse.ArgumentParser = verbs.add_parser(
        "check", help="rate, gaps, units, noise, time offset and axes of inertial samples, with remedies", epilog=_CODES
    )
    parser.add_argument(
        "source", metavar="SOURCE", help="video, images, dataset sequence or bag; or a table of samples alone"
    )
    add_inertial_options(parser)
    parser.add_argument("--no-vision", action="store_true", help="check the samples alone, and track no image")
    parser.add_argument(
        "--frames", type=positive_int, default=600, metavar="N", help="images to track at most (default: %(default)s)"
    )
    parser.add_argument("--start", metavar="T", help="first frame: seconds since the first one, or a number as 120f")
    parser.add_argument("--json", metavar="FILE", help="file to write numbers and findings to")
    parser.add_argument("--calib", metavar="FILE", help="calibration of the camera, as of dvo run")
    times = parser.add_mutually_exclusive_group()
    times.add_argument("--times", metavar="FILE", help="file with the time of each image")
    times.add_argument("--fps", type=positive_float, metavar="F", help="frames per second")
    parser.add_argument("--topic", metavar="NAME", help="topic of the images in a bag")
    parser.add_argument(
        "--device", metavar="D", default="auto", help="torch device (default: accelerator if available)"
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="default: %(default)s")
    parser.set_defaults(run="dvo.commands.imu:check")
