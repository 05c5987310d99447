"""Sequence folder in the simplest layout: a folder of images, ``calib.txt`` and ``groundtruth_tum.txt`` beside it.

Depth images (``depth`` beside the images, the same number in the name) and right images are used only where the
calibration states their ``depth_scale`` or ``baseline``: neither can be guessed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, rectified
from dvo.data.calibration.read import read_calibration
from dvo.data.files.stamps import choose_times, in_order
from dvo.data.images.images import has_images, natural_key
from dvo.data.readers.folder import camera_streams, times_of_rows
from dvo.data.readers.groups import Streams, choose_folder, others_beside
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import MILLIMETRES, Finder, SameName, SameNumbers, Sensors
from dvo.data.trajectory import Trajectory, read_tum

IMAGE_FOLDERS = (
    "image_0", "image_2", "image_left", "image_lcam_front", "rgb", "color", "colour", "images", "image", "imgs",
    "frames", "left", "cam0", "cam0/data",
)  # fmt: skip
RIGHT_OF = {
    "image_0": "image_1", "image_2": "image_3", "image_left": "image_right", "image_lcam_front": "image_rcam_front",
    "left": "right", "cam0": "cam1", "cam0/data": "cam1/data",
}  # fmt: skip
CALIBRATIONS = ("calib.txt", "calibration.txt", "calib.yaml", "calibration.yaml", "camera.yaml", "intrinsics.txt")


def image_folder(path: Path) -> Path | None:
    """Folder of images in a sequence folder: a usual name, else the only one that holds images, or the left one.

    Args:
        path: the sequence folder.

    Raises:
        DvoError: several, whose names do not tell which one to read.
    """
    usual = next((path / name for name in IMAGE_FOLDERS if has_images(path / name)), None)
    if usual is not None:
        return usual
    others = folders_of_images(path)
    chosen = choose_folder(others) if len(others) > 1 else next(iter(others), None)
    if chosen is None and others:
        named = ", ".join(child.name for child in others)
        raise DvoError(f"several folders of images: {named}", file=path, remedy="name one of them as the source")
    return chosen


def folders_of_images(path: Path) -> list[Path]:
    """Folders that hold images directly, in natural order.

    Args:
        path: the folder that they lie in.
    """
    found = (child for child in path.iterdir() if child.is_dir() and has_images(child))
    return sorted(found, key=lambda child: natural_key(child.name))


def find_calibration(path: Path) -> Calibration | None:
    """Calibration that lies in a folder under a usual name, if any.

    Args:
        path: the folder.

    Raises:
        DvoError: a malformed file.
    """
    file = next((path / name for name in CALIBRATIONS if (path / name).is_file()), None)
    return read_calibration(file) if file is not None else None


def find_groundtruth(path: Path) -> Trajectory | None:
    """Read ``groundtruth_tum.txt``, or the only file of a name such as ``keyframes_groundtruth_cam0_tum.txt``, if any.

    Args:
        path: the sequence folder.

    Raises:
        DvoError: a malformed file.
    """
    exact = path / "groundtruth_tum.txt"
    files = [exact] if exact.is_file() else sorted(path.glob("*groundtruth*_tum.txt"))
    return read_tum(files[0]) if len(files) == 1 else None


def matches(path: Path) -> bool:
    """True for a folder without images of its own and with one (or several) folders of images in it.

    Args:
        path: existing file or folder.
    """
    if not path.is_dir() or has_images(path):
        return False
    return any(has_images(path / name) for name in IMAGE_FOLDERS) or any(
        child.is_dir() and has_images(child) for child in path.iterdir()
    )


def open_sequence(path: Path, request: Request) -> Recording:
    """Read a sequence folder. Ground truth with a row per image also gives the times, if nothing else does.

    Args:
        path: the folder.
        request: options of the user.

    Raises:
        DvoError: no images, or a malformed calibration, ground truth or list of times.
    """
    folder = image_folder(path)
    if folder is None:
        return ImageRecording("sequence", path, [], np.zeros(0))
    warnings: list[str] = []
    streams = camera_streams(folder, warnings)
    images = streams.images
    groundtruth = find_groundtruth(path)

    def times_of_groundtruth() -> np.ndarray | None:
        if request.groundtruth is not None:
            return times_of_rows(request, len(images), warnings)
        return groundtruth.timestamps if groundtruth is not None and len(groundtruth) == len(images) else None

    times = choose_times(
        images, folder, times=request.times, fps=request.fps, warnings=warnings, fallback=times_of_groundtruth
    )
    images, times = in_order(images, times)
    calibration = find_calibration(path)
    sensors = _sensors(path, folder, request.calibration or calibration, streams)
    used = [folder, *(one.folder for one in (sensors.depth, sensors.right) if isinstance(one, SameNumbers | SameName))]
    unused = [other for other in folders_of_images(path) if other not in used]
    if unused:
        warnings.append(others_beside(folder, unused))
    return ImageRecording(
        "sequence", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings,
        sensors=sensors,
    )  # fmt: skip


def _sensors(path: Path, folder: Path, calibration: Calibration | None, streams: Streams) -> Sensors:
    scale = None if calibration is None else calibration.depth_scale
    baseline = None if calibration is None else calibration.baseline
    depth: Finder | None = streams.depth
    right: Finder | None = streams.right
    other = RIGHT_OF.get(folder.relative_to(path).as_posix())
    if depth is None and scale and (path / "depth").is_dir():
        depth = SameNumbers(path / "depth")
    if right is None and baseline and other and (path / other).is_dir():
        right = SameName(path / other)
    rig = rectified(calibration, baseline) if right is not None and calibration is not None and baseline else None
    return Sensors(depth=depth, depth_scale=scale or (MILLIMETRES if streams.depth else None), right=right, stereo=rig)


READER = Reader("sequence", matches, open_sequence)
