"""Options about the input of a command, in a module that imports nothing heavy."""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import asdict
from typing import Any

from dvo.core.command_line import positive_float, positive_int, whole


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about the images of a source and their times, of every command that opens one.

    Args:
        parser: of the command.
    """
    parser.add_argument("--stride", type=positive_int, default=1, metavar="N", help="take every N-th frame")
    times = parser.add_mutually_exclusive_group()
    times.add_argument(
        "--times",
        metavar="FILE",
        help="file with the time of each image, in any unit (a header such as 'time [ms]' names it)",
    )
    times.add_argument(
        "--fps", type=positive_float, metavar="F", help="frames per second, if the source does not define it"
    )
    parser.add_argument(
        "--start", metavar="T", help="first frame to take: seconds since the first frame, or its number, such as 120f"
    )
    parser.add_argument("--end", metavar="T", help="frame to stop before, in the same form; also of a stream")
    parser.add_argument(
        "--mask",
        metavar="FILE|FOLDER",
        help="image of the size of those of the source, or a folder with one for each: white is used, black is ignored",
    )
    parser.add_argument("--mask-invert", action="store_true", help="of the mask, black is used and white is ignored")
    parser.add_argument(
        "--max-pixels",
        metavar="N",
        type=whole,
        help="images with more pixels are reduced when they are read (4000000); 0: never",
    )
    parser.add_argument("--topic", metavar="NAME", help="topic of the images in a bag of ROS 1 or 2, or an MCAP file")


def add_inertial_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about inertial samples.

    Args:
        parser: of the command.
    """
    parser.add_argument(
        "--imu",
        metavar="FILE|auto|none",
        default="auto",
        help="inertial samples: a table, bag or GoPro video; auto: those of the recording or beside it (default)",
    )
    parser.add_argument(
        "--imu-calib",
        metavar="FILE[,FILE]",
        help="calibration of the inertial sensor: Kalibr's imu.yaml and camchain-imucam.yaml, EuRoC's sensor.yaml, a "
        "YAML file, or a preset of its noise: phone, action, euroc",
    )
    parser.add_argument("--imu-topic", metavar="NAME", help="topic of inertial samples in a bag, if there are several")


def source_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Arguments of :func:`dvo.open` for the options of :func:`add_source_options`, the stride aside.

    Args:
        arguments: of the command line.
    """
    names = ("times", "fps", "start", "end", "mask", "mask_invert", "topic")
    pixels = {} if arguments.max_pixels is None else {"max_pixels": arguments.max_pixels or None}
    return {name: getattr(arguments, name) for name in names} | pixels


def input_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Arguments of :func:`dvo.open` for the options of ``dvo run`` about its input, the stride aside.

    Args:
        arguments: of the command line.
    """
    inertial = {"imu": arguments.imu, "imu_calib": arguments.imu_calib, "imu_topic": arguments.imu_topic}
    return source_settings(arguments) | inertial


def print_input(source: Any) -> None:
    """Print what a person compares with what was recorded, to stderr.

    Number of images, duration and rate, where the times are known before the images are read, of a video as its file
    states them; the range of depth, inertial samples that frames carry, and positions of a satellite receiver.

    Args:
        source: newly opened.

    Raises:
        DvoError: damaged inertial samples or positions.
    """
    from dvo.commands.console import warn
    from dvo.core.text import print_line
    from dvo.data.companions.depth_source import depth_range
    from dvo.data.companions.inertial_source import described

    recording = getattr(source, "recording", None)
    times, count = getattr(source, "timestamps", None), getattr(recording, "frame_count", None)
    text, rate = None, getattr(recording, "rate", None)
    if times is not None and len(times) > 1:
        span = float(times[-1] - times[0])
        text = f"{len(times)} images in {span:.4g} s"
        text += f", {(len(times) - 1) / span:.4g} a second" if span > 0 else ""
    elif count is not None and rate:
        text = f"{count} frames of a video, {rate:.4g} a second: {count / rate:.4g} s"
    lines = [] if text is None else [text]
    depth = depth_range(source) if hasattr(source, "reading") else None
    if depth is not None:
        lines.append(f"depth: most of it {depth[0]:.4g} to {depth[1]:.4g} m")
    samples, positions = getattr(source, "inertial", None), getattr(source, "positions", None)
    if samples is not None:
        lines.append(described(samples))
    if positions is not None:
        lines.append(positions.describe())
    with contextlib.suppress(OSError):
        for line in lines:
            print_line(line, error=True)
    for note in samples.notes if samples is not None else ():
        if note not in source.warnings:
            warn(note, "note")


def input_facts(arguments: argparse.Namespace, source: Any) -> dict[str, Any]:
    """Entries of run.json about the options, and about the other sensors of the source.

    Args:
        arguments: of the command line.
        source: as it was opened.

    Returns:
        ``interval``: start and end as given, None without them; ``extrinsics``: the file;
        ``mask``: file or folder, and whether it was inverted; ``inertial``: origin, number, rate, noise and pose of the
        inertial samples that frames carry; ``gps``: see :meth:`dvo.data.positions.Positions.summary`.

    Raises:
        DvoError: damaged inertial samples or positions.
    """
    bounds = {"start": arguments.start, "end": arguments.end}
    given = any(bound is not None for bound in bounds.values())
    mask = None if arguments.mask is None else {"file": arguments.mask, "inverted": arguments.mask_invert}
    samples, positions = getattr(source, "inertial", None), getattr(source, "positions", None)
    inertial = None
    if samples is not None:
        pose = None if samples.T_camera_imu is None else samples.T_camera_imu.tolist()
        noise = None if samples.noise is None else asdict(samples.noise)
        inertial = {"origin": samples.origin, "count": len(samples), "rate": samples.rate, "noise": noise,
                    "T_camera_imu": pose}  # fmt: skip
    return {
        "interval": bounds if given else None,
        "extrinsics": arguments.extrinsics,
        "mask": mask,
        "inertial": inertial,
        "gps": None if positions is None else positions.summary(),
    }
