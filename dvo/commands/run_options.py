"""Options of ``dvo run`` that other commands share, in a module that imports nothing heavy."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from dvo.commands.input_options import add_inertial_options, add_source_options
from dvo.commands.scale_options import add_scale_options
from dvo.commands.view_options import add_view_options
from dvo.core.command_line import names, positive_int, seed

INPUTS = (
    "calib", "times", "groundtruth", "extrinsics", "mask", "depth", "right", "depth_calib", "config", "map", "weights",
    "imu", "imu_calib",
)  # fmt: skip
"""Options whose value is, or may be, a file or folder that is read."""
OUTPUTS = ("save_map", "overlay", "rerun")
"""Options whose value is a file that is written."""


def add_folder_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about the results folder of one run.

    Args:
        parser: of the command.
    """
    parser.add_argument("--out", metavar="DIR", help="results folder (default: runs/NAME-TIME)")
    parser.add_argument("--overwrite", action="store_true", help="replace the results of an earlier run in --out")


def add_tracking_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about the odometry.

    Args:
        parser: of the command.
    """
    system = parser.add_mutually_exclusive_group()
    system.add_argument("--weights", metavar="NAME|FILE", default="small", help="default: %(default)s")
    system.add_argument(
        "--system", metavar="NAME", help="an odometry without weights: keyframe, klt-pnp, direct, monoslam or msckf"
    )
    parser.add_argument(
        "--device", metavar="D", default="auto", help="torch device (default: accelerator if available)"
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--preset", metavar="NAME", help="settings of the odometry: default, fast or accurate (default: default)"
    )
    parser.add_argument("--config", metavar="FILE", help="YAML file with settings of the odometry")
    parser.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], help="one setting, such as patches=48; repeatable"
    )
    parser.add_argument("--no-loops", action="store_true", help="pure odometry: do not close loops (--set loops=false)")


def add_image_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about the images of an exported map.

    Args:
        parser: of the command.
    """
    parser.add_argument(
        "--export-images",
        choices=("keyframes", "source"),
        help="images of exported maps: the working images of the keyframes, or images of the source, which is read "
        "again, at their recorded size without lens distortion",
    )
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument(
        "--every", type=positive_int, metavar="N", help="of the source, the sharpest image of every N tracked frames"
    )
    choice.add_argument(
        "--count",
        type=positive_int,
        metavar="N",
        help="of the source, the sharpest image of each of N stretches of equal length (default: 300)",
    )


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a run of a recording, those of :func:`add_folder_options` aside.

    Args:
        parser: of the command.
    """
    parser.add_argument(
        "--calib",
        metavar="FILE",
        help="'fx fy cx cy [k1 k2 p1 p2 [k3]]' in pixels, a YAML file, or COLMAP's cameras.txt[:ID] (default: that of "
        "a data set, else the focal length is found in the images)",
    )
    add_tracking_options(parser)
    add_source_options(parser)
    parser.add_argument("--groundtruth", metavar="FILE", help="TUM trajectory (camera to world) to compare with")
    parser.add_argument(
        "--export",
        type=names,
        default=[],
        metavar="NAMES",
        help="write the results for other programs too: colmap, colmap-text, nerfstudio, tum, kitti, euroc; by commas",
    )
    add_image_options(parser)
    parser.add_argument("--save-map", metavar="FILE", help="map file (.dvo) to write at the end, for a later --map")
    parser.add_argument("--map", metavar="FILE", help="map file (.dvo) of an earlier recording, to be localised in")
    parser.add_argument(
        "--extrinsics",
        metavar="FILE",
        help="pose of the camera in a base frame, 4x4 matrix or 'x y z qx qy qz qw': writes trajectory_base.txt too",
    )
    add_inertial_options(parser)
    add_view_options(parser)
    add_scale_options(parser)


def add_batch_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``dvo batch``: its own, and those of :func:`add_run_options`.

    Args:
        parser: of the command.
    """
    parser.description = (
        "Each video has the results folder DIR/NAME that `dvo run` would write. The same command again goes on with "
        "what is not done. In options that name a file, {stem} is the name of the video without its extension and "
        "{name} that of its results folder: --calib {stem}.calib.txt is looked up from the working directory, then "
        "beside each video."
    )
    parser.add_argument(
        "videos", metavar="VIDEO", nargs="+", help="videos, folders of images, dataset sequences; no streams"
    )
    parser.add_argument(
        "--out", metavar="DIR", required=True, help="a folder for each video, the table batch.csv, and logs/"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace results in --out that other options gave")
    parser.add_argument(
        "--jobs",
        type=positive_int,
        metavar="N",
        help="videos at a time, which share the cores (default: one for every 4 cores, at least 1)",
    )
    parser.add_argument("--ray", metavar="ADDRESS", help="track on a Ray cluster: auto, ray://HOST:PORT, or local")
    add_run_options(parser)


def given_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of :func:`add_run_options` that are not at their default.

    Args:
        arguments: of the command line.

    Returns:
        Values by name, such as ``{"save_map": "a.dvo"}``.
    """
    parser = argparse.ArgumentParser(add_help=False)
    add_run_options(parser)
    defaults = vars(parser.parse_args([]))
    return {name: found for name, value in defaults.items() if (found := getattr(arguments, name)) != value}


def as_arguments(options: Mapping[str, Any]) -> list[str]:
    """Command line of some options.

    Args:
        options: of :func:`given_options`.

    Returns:
        Arguments that are parsed to the same options, whatever follows them behind ``--``.
    """
    line: list[str] = []
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        if value is True:
            line.append(flag)
        elif name == "export":
            line.append(f"{flag}={','.join(value)}")
        elif name == "set":
            line += [f"{flag}={one}" for one in value]
        elif name == "distance":
            line += [part for one in value for part in (flag, *map(str, one))]
        else:
            line.append(f"{flag}={value}")
    return line
