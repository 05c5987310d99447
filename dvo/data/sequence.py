"""A sequence folder in the simplest layout: a folder of images, ``calib.txt`` and ``groundtruth_tum.txt`` beside."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.data.calibration import Calibration, read_calibration
from dvo.data.folder import camera_images
from dvo.data.images import has_images
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.stamps import choose_times
from dvo.data.trajectory import Trajectory, read_tum
from dvo.errors import DvoError

IMAGE_FOLDERS = (
    "image_0", "image_2", "image_left", "image_lcam_front", "rgb", "color", "colour", "images", "image", "imgs",
    "frames", "left", "cam0", "cam0/data",
)  # fmt: skip
CALIBRATIONS = ("calib.txt", "calibration.txt", "calib.yaml", "calibration.yaml", "camera.yaml", "intrinsics.txt")


def image_folder(path: Path) -> Path | None:
    """The folder of images in a sequence folder: a usual name, else the only one that holds images.

    Raises:
        DvoError: several, and none with a usual name.
    """
    usual = next((path / name for name in IMAGE_FOLDERS if has_images(path / name)), None)
    if usual is not None:
        return usual
    others = sorted(child for child in path.iterdir() if child.is_dir() and has_images(child))
    if len(others) > 1:
        named = ", ".join(child.name for child in others)
        raise DvoError(f"several folders of images: {named}", file=path, remedy="name one of them as the source")
    return others[0] if others else None


def find_calibration(path: Path) -> Calibration | None:
    """The calibration that lies in a folder under a usual name, if any."""
    file = next((path / name for name in CALIBRATIONS if (path / name).is_file()), None)
    return read_calibration(file) if file is not None else None


def find_groundtruth(path: Path) -> Trajectory | None:
    """``groundtruth_tum.txt``, or the only file of a name such as ``keyframes_groundtruth_cam0_tum.txt``, if any."""
    exact = path / "groundtruth_tum.txt"
    files = [exact] if exact.is_file() else sorted(path.glob("*groundtruth*_tum.txt"))
    return read_tum(files[0]) if len(files) == 1 else None


def matches(path: Path) -> bool:
    """A folder without images of its own and with one (or several) folders of images in it."""
    if not path.is_dir() or has_images(path):
        return False
    return any(has_images(path / name) for name in IMAGE_FOLDERS) or any(
        child.is_dir() and has_images(child) for child in path.iterdir()
    )


def open_sequence(path: Path, request: Request) -> Recording:
    """Read a sequence folder. Ground truth with a row per image also gives the times, if nothing else does.

    Raises:
        DvoError: no images, or a malformed calibration, ground truth or list of times.
    """
    folder = image_folder(path)
    if folder is None:
        return ImageRecording("sequence", path, [], np.zeros(0))
    warnings: list[str] = []
    images = camera_images(folder, warnings)
    groundtruth = find_groundtruth(path)

    def times_of_groundtruth() -> np.ndarray | None:
        return groundtruth.timestamps if groundtruth is not None and len(groundtruth) == len(images) else None

    times = choose_times(
        images, folder, times=request.times, fps=request.fps, warnings=warnings, fallback=times_of_groundtruth
    )
    calibration = find_calibration(path)
    return ImageRecording(
        "sequence", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings
    )


READER = Reader("sequence", matches, open_sequence)
