"""Options of ``dvo calibrate``, in a module that imports nothing heavy."""

from __future__ import annotations

import argparse
from typing import Any

from dvo.commands.input_options import add_source_options
from dvo.core.command_line import number, whole

_CODES = "exit codes: 0 done, 1 the motion does not tell the focal length (without a board), 2 bad input"


def add_calibrate(commands: Any) -> None:
    """Add the command.

    Args:
        commands: sub-parsers of the command line.
    """
    parser = commands.add_parser(
        "calibrate", help="calibrate a camera from a video of a board, or of any scene", epilog=_CODES
    )
    parser.add_argument(
        "source", metavar="SOURCE", nargs="?",
        help="video or folder of images of a board; without --board, of any scene",
    )  # fmt: skip
    parser.add_argument("--show", metavar="FILE", help="print how a calibration file is read, and do nothing else")
    boards = parser.add_mutually_exclusive_group()
    boards.add_argument(
        "--board", type=_grid, metavar="CxR", help="checkerboard with so many inner corners: 10x7 squares have 9x6"
    )
    boards.add_argument("--charuco", type=_grid, metavar="CxR", help="ChArUco board of so many squares")
    parser.add_argument(
        "--square", type=number, default=1.0, metavar="M", help="side of a square in metres (default: 1)"
    )
    parser.add_argument(
        "--marker", type=number, default=0.0, metavar="M", help="ChArUco: side of a marker (default: 0.75 of a square)"
    )
    parser.add_argument(
        "--dictionary", metavar="NAME", default="4X4_50", help="ChArUco: OpenCV's name (default: %(default)s)"
    )
    parser.add_argument("--fisheye", action="store_true", help="lens model of fisheyes; writes calib.yaml")
    parser.add_argument("--k3", action="store_true", help="third radial coefficient")
    parser.add_argument(
        "--frames", type=whole, default=300, metavar="N", help="frames to search (default: %(default)s)"
    )
    add_source_options(parser)
    parser.add_argument("--out", metavar="DIR", help="results folder (default: runs/NAME-TIME)")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier calibration in --out")
    parser.add_argument("--weights", metavar="NAME|FILE", default="small", help="without a board (default: small)")
    parser.add_argument(
        "--device", metavar="D", default="auto", help="torch device (default: accelerator if available)"
    )
    parser.add_argument("--seed", type=_seed, default=0, metavar="N", help="default: %(default)s")
    parser.set_defaults(run="dvo.commands.calibrate:calibrate")


def _grid(text: str) -> tuple[int, int]:
    columns, separator, rows = text.lower().partition("x")
    if not (separator and all(part.isdecimal() and len(part) < 4 for part in (columns, rows))):
        raise argparse.ArgumentTypeError(f"expected COLUMNSxROWS, such as 9x6, got {text[:60]!r}")
    return int(columns), int(rows)


def _seed(text: str) -> int:
    value = whole(text)
    if not 0 <= value < 2**63:
        raise argparse.ArgumentTypeError(f"must be 0 or more and below 2^63, got {text[:60]}")
    return value
