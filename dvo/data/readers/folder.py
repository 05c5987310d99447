"""Plain folder of images."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import visible
from dvo.data.files.stamps import choose_times, in_order, times_from_names
from dvo.data.images.images import list_images
from dvo.data.readers.groups import Streams, split_streams
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import MILLIMETRES, Sensors
from dvo.data.trajectory import read_tum

REPLICA_SCALE = 6553.5
"""Units of a metre in the depth images of the Replica renderings of NICE-SLAM (its ``cam_params.json``)."""


def matches(path: Path) -> bool:
    """True for any folder: the last reader to which a path is offered.

    Args:
        path: existing file or folder.
    """
    return path.is_dir()


def camera_images(folder: Path, warnings: list[str]) -> list[Path]:
    """List the images of one camera: in natural order, or by time if the names are stamps.

    Args:
        folder: of the images.
        warnings: receives a sentence if images were left out.

    Returns:
        Files; empty if there are none.

    Raises:
        DvoError: several streams of images, see :func:`dvo.data.readers.groups.split_streams`.
    """
    return camera_streams(folder, warnings).images


def camera_streams(folder: Path, warnings: list[str]) -> Streams:
    """Images of one camera, see :func:`camera_images`, and depth or right images among them.

    Args:
        folder: of the images.
        warnings: receives a sentence if images were left out.

    Raises:
        DvoError: as :func:`camera_images`.
    """
    streams = split_streams(list_images(folder, warnings), folder)
    if streams.note is not None:
        warnings.append(streams.note)
    images = streams.images
    times = times_from_names(images)
    if times is not None:  # 1.5 is later than 1.25, which natural order does not know
        images = [images[i] for i in np.argsort(times, kind="stable")]
    return replace(streams, images=images)


def times_of_rows(request: Request, count: int, warnings: list[str]) -> np.ndarray | None:
    """Times of the ground truth that the user named, for images without times of their own.

    Args:
        request: options of the user; a rate in frames a second wins.
        count: of the images.
        warnings: receives a sentence if there are such times.

    Returns:
        ``(count,)`` float64 seconds; None without a file of TUM's format that has a row for each image.
    """
    file = request.groundtruth
    if file is None or request.fps is not None or file.suffix == ".freiburg":
        return None
    try:
        times = read_tum(file).timestamps
    except DvoError:  # of another format, or malformed: that is told when it is read for its poses
        return None
    if len(times) != count or (count > 2 and (np.diff(times) == 1).all()):  # numbers of frames are no times
        return None
    warnings.append(f"no times found: taking those of {visible(file.name)}, which has a row for each image")
    return times


def open_folder(path: Path, request: Request) -> Recording:
    """Read a folder of images; no calibration of its own.

    Args:
        path: the folder.
        request: options of the user.

    Raises:
        DvoError: no images, several streams of them, or times that do not fit them.
    """
    warnings: list[str] = []
    streams = camera_streams(path, warnings)
    if not streams.images:  # before a times file can complain about their number
        return ImageRecording("folder", path, [], np.zeros(0))
    times = choose_times(
        streams.images, path, times=request.times, fps=request.fps, warnings=warnings,
        fallback=lambda: times_of_rows(request, len(streams.images), warnings),
    )  # fmt: skip
    images, times = in_order(streams.images, times)
    scale = REPLICA_SCALE if streams.depth is not None and _is_replica(images[0]) else MILLIMETRES
    if scale == REPLICA_SCALE:
        warnings.append(f"laid out as the Replica renderings of NICE-SLAM: --depth takes {scale:g} units for a metre")
    sensors = Sensors(depth=streams.depth, depth_scale=scale, right=streams.right)
    return ImageRecording("folder", path, images, times, warnings=warnings, sensors=sensors)


def _is_replica(image: Path) -> bool:
    """True for ``SCENE/results/frame000000.jpg`` beside ``depth000000.png``, with ``SCENE/traj.txt``."""
    depth = image.with_name(image.name.replace("frame", "depth", 1)).with_suffix(".png")
    named = re.fullmatch(r"frame\d{6}\.jpg", image.name) and depth.is_file()
    folder = image.absolute().parent
    return bool(named) and folder.name == "results" and (folder.parent / "traj.txt").is_file()


READER = Reader("folder", matches, open_folder)
