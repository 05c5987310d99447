"""Options of ``dvo run`` for the metric scale, in a module that imports nothing heavy."""

from __future__ import annotations

import argparse

from dvo.core.command_line import number

OWN = ""  # value of --depth and --right without a path: those of the data set itself


def add_scale_options(parser: argparse.ArgumentParser) -> None:
    """Add the options.

    Args:
        parser: of the command.
    """
    about = "poses and map in metres; one of --depth, --right, --height, --distance"
    group = parser.add_argument_group("metric scale", about)
    source = group.add_mutually_exclusive_group()
    source.add_argument(
        "--depth",
        nargs="?",
        const=OWN,
        metavar="PATH",
        help="depth images: a folder of 16-bit PNG files, a list as depth.txt or a topic (default: of the data set)",
    )
    source.add_argument(
        "--right",
        nargs="?",
        const=OWN,
        metavar="PATH",
        help="right images of a stereo pair: a folder, list, second video or topic (default: those of the data set)",
    )
    source.add_argument("--height", type=_metres, metavar="METRES", help="of the camera over the ground")
    source.add_argument(
        "--distance",
        nargs=3,
        type=number,
        action="append",
        metavar=("T0", "T1", "METRES"),
        help="straight distance between the camera at two times, seconds; repeatable",
    )
    group.add_argument(
        "--baseline",
        type=_metres,
        metavar="METRES",
        help="distance of the cameras of a stereo pair (default: that of the calibration file or the data set)",
    )
    group.add_argument(
        "--depth-scale",
        type=_metres,
        metavar="UNITS",
        help="units of a metre in depth images (default: 1000; of a list 5000; that of a data set)",
    )
    group.add_argument(
        "--depth-calib",
        metavar="FILE",
        help="'fx fy cx cy' of the depth images, where they are not registered to the images",
    )
    group.add_argument(
        "--tsdf", action="store_true", help="with --depth: fuse the depth images to a mesh too, mesh.ply (dvo[tsdf])"
    )


def _metres(text: str) -> float:
    value = number(text)
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"must be more than 0, got {text[:60]}")
    return value
