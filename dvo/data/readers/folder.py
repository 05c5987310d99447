"""Plain folder of images."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dvo.data.files.stamps import choose_times, times_from_names
from dvo.data.images.images import list_images
from dvo.data.recording import ImageRecording, Reader, Recording, Request

_STEREO_NAME = re.compile(r"[0-9]{16,19}_[01]")


def matches(path: Path) -> bool:
    """True for any folder: the last reader to which a path is offered.

    Args:
        path: existing file or folder.
    """
    return path.is_dir()


def camera_images(folder: Path, warnings: list[str]) -> list[Path]:
    """List the images of one camera: in natural order, or by time if the names are stamps.

    A folder of stereo pairs named ``<nanoseconds>_0`` and ``<nanoseconds>_1`` gives the left ones.

    Args:
        folder: of the images.
        warnings: receives a sentence if images were left out.

    Returns:
        Files; empty if there are none.
    """
    images = list_images(folder)
    if images and all(_STEREO_NAME.fullmatch(image.stem) for image in images):
        left = [image for image in images if image.stem.endswith("_0")]
        if left and len(left) < len(images):
            warnings.append(f"stereo pairs: reading the {len(left)} left images (names ending in _0)")
            images = left
    times = times_from_names(images)
    if times is not None:  # 1.5 is later than 1.25, which natural order does not know
        images = [images[i] for i in np.argsort(times, kind="stable")]
    return images


def open_folder(path: Path, request: Request) -> Recording:
    """Read a folder of images; no calibration of its own.

    Args:
        path: the folder.
        request: options of the user.

    Raises:
        DvoError: no images, or times that do not fit them.
    """
    warnings: list[str] = []
    images = camera_images(path, warnings)
    if not images:  # before a times file can complain about their number
        return ImageRecording("folder", path, [], np.zeros(0))
    times = choose_times(images, path, times=request.times, fps=request.fps, warnings=warnings)
    return ImageRecording("folder", path, images, times, warnings=warnings)


READER = Reader("folder", matches, open_folder)
