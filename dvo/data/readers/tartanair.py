"""TartanAir v1 (Wang et al., IROS 2020) and v2: ``image_left`` with ``pose_left.txt``, ``image_lcam_front`` with
``pose_lcam_front.txt``; and the monocular test set of the CVPR 2020 challenge, ``mono/ME000``, ``mono_gt/ME000.txt``.

Depth lies in ``depth_left`` or ``depth_lcam_front``, the right images in ``image_right`` or ``image_rcam_front``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, rectified
from dvo.data.files.files import is_file
from dvo.data.files.stamps import checked_rate, read_times
from dvo.data.images.images import has_images, list_images
from dvo.data.readers.sequence import find_calibration
from dvo.data.recording import ImageRecording, Reader, Recording, Request, rows_of_images
from dvo.data.sensors.sensors import SameName, Sensors
from dvo.data.trajectory import Trajectory, read_numbers, unit_quaternions
from dvo.geometry.poses import ned_to_camera

NOMINAL_FPS = 10.0  # the simulator has no clock of its own; v2's inertial data take images at 10 Hz
BASELINE = 0.25  # metres, of v1 and v2


@dataclass(frozen=True)
class _Layout:
    """Places of the files of one version, relative to the trajectory's folder.

    Attributes:
        images: folder of the (left) images.
        poses: one row per image.
        calibration: published with the data.
        right: folder of the right images.
        names: part of the names that differs between left and right images.
    """

    images: str
    poses: str
    calibration: Calibration
    right: str = ""
    names: tuple[str, str] = ("", "")


_V1 = Calibration(320.0, 320.0, 320.0, 240.0, width=640, height=480)
_V2 = Calibration(320.0, 320.0, 320.0, 320.0, width=640, height=640)
LAYOUTS = (
    _Layout("image_left", "pose_left.txt", _V1, "image_right", ("_left", "_right")),
    _Layout("image_lcam_front", "pose_lcam_front.txt", _V2, "image_rcam_front", ("_lcam_front", "_rcam_front")),
)


def _layout(path: Path) -> _Layout | None:
    for layout in LAYOUTS:
        if has_images(path / layout.images) and (layout is not LAYOUTS[0] or (path / layout.poses).is_file()):
            return layout
    real = path.resolve()
    for truth in (Path("..", "mono_gt"), Path("..", "..", "mono_gt")):
        if (real / truth / f"{real.name}.txt").is_file() and has_images(path):
            return _Layout("", str(truth / f"{real.name}.txt"), _V1)
    return None


def matches(path: Path) -> bool:
    """True for a folder with ``image_lcam_front``, with ``image_left`` and ``pose_left.txt``, or one of the test set.

    Args:
        path: existing file or folder.
    """
    return path.is_dir() and _layout(path) is not None


def depth_file(image: Path) -> Path | None:
    """Depth of a left image; None if there is none.

    Args:
        image: ``image_left/N_left.png`` (v1) or ``image_lcam_front/N_lcam_front.png`` (v2).

    Returns:
        File for :func:`dvo.data.sensors.depth.read_depth`: ``depth_left/N_left_depth.npy`` or ``.npz``,
        ``depth_lcam_front/N_lcam_front_depth.png``.
    """
    sequence, stem = image.parent.parent, image.stem
    options: list[Path] = []
    if image.parent.name == "image_left":
        options = [sequence / "depth_left" / f"{stem}_depth{end}" for end in (".npy", ".npz")]
    elif image.parent.name == "image_lcam_front":
        options = [sequence / "depth_lcam_front" / f"{stem}_depth.png"]
    return next((option for option in options if is_file(option)), None)


def read_ned_poses(path: Path) -> np.ndarray:
    """Read poses of the NED camera frame (x forward, y right, z down).

    Args:
        path: rows ``tx ty tz qx qy qz qw``, camera to world.

    Returns:
        ``(N, 7)`` float64 camera-to-world poses of the camera frame x right, y down, z forward.

    Raises:
        DvoError: missing file, no rows, a row that is not 7 finite numbers, or a quaternion that is none.
    """
    table, numbers = read_numbers(path, 7, "row", "tx ty tz qx qy qz qw")
    table[:, 3:] = unit_quaternions(table[:, 3:], path, numbers)
    return ned_to_camera(table)


def open_tartanair(path: Path, request: Request) -> Recording:
    """Read a TartanAir trajectory folder (``P001``), left front camera.

    Args:
        path: the folder; of the test set that of the images.
        request: options of the user.

    Raises:
        DvoError: no images, or malformed poses or times.
    """
    layout = _layout(path)
    if layout is None:
        raise DvoError("not a TartanAir trajectory", file=path, remedy="give the folder that holds image_left")
    warnings: list[str] = []
    images = list_images(path / layout.images)
    times = _times(path, images, request, warnings)
    groundtruth = None
    poses_file = path.resolve() / layout.poses
    if poses_file.is_file():
        poses = read_ned_poses(poses_file)
        rows = rows_of_images(images, len(poses))
        if rows is None:
            warnings.append(f"{layout.poses} has {len(poses)} rows for {len(images)} images: not used as ground truth")
        else:
            groundtruth = Trajectory(times, poses[rows])
    calibration = find_calibration(path) or layout.calibration
    return ImageRecording(
        "tartanair", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings,
        sensors=_sensors(path, layout, request.calibration or calibration),
    )  # fmt: skip


def _sensors(path: Path, layout: _Layout, calibration: Calibration) -> Sensors:
    if not layout.right:
        return Sensors()
    if not (path / layout.right).is_dir():
        return Sensors(depth=depth_file)
    right, rig = SameName(path / layout.right, *layout.names), rectified(calibration, calibration.baseline or BASELINE)
    return Sensors(depth=depth_file, right=right, stereo=rig)


def _times(path: Path, images: list[Path], request: Request, warnings: list[str]) -> np.ndarray:
    if request.times is not None:
        return read_times(request.times, len(images))
    clock = path / "imu" / "cam_time.txt"
    if clock.is_file():
        found = read_times(clock, None)
        rows = rows_of_images(images, len(found))
        if rows is not None:
            return found[rows]
    fps = checked_rate(request.fps)
    if fps is None:
        warnings.append(f"TartanAir has no times: assuming {NOMINAL_FPS:g} frames a second (or give --times or --fps)")
    return np.arange(len(images)) / (fps or NOMINAL_FPS)


READER = Reader("tartanair", matches, open_tartanair)
