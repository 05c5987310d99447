"""Checks of the options with which a source is opened."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from numbers import Integral
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.calibration.colmap_cameras import is_calibration_file
from dvo.data.calibration.read import read_calibration
from dvo.data.files.files import is_file, is_folder
from dvo.data.images.image_header import no_image
from dvo.data.recording import Log, RawFrame, Recording

_CALIBRATION = "calib.txt"
_OF_A_CAMERA = re.compile(
    r"(?!.*(?:depth|right|imu|noise|infra)).*(?:calib|camera|intrinsic|camchain|transforms|cam_params).*"
    r"\.(?:txt|ya?ml|json|xml|toml|ini|cfg|csv|npz|bin)", re.IGNORECASE
)  # fmt: skip
_BESIDE = ("", "sparse/0", "intrinsic", "intrinsics", "calibration")
_ENTRIES, _TRIED, _SMALL = 2000, 10, 2**20  # of a folder; files that are read; bytes of one


def check_stride(stride: object) -> None:
    """Check a stride.

    Args:
        stride: as given by the user.

    Raises:
        DvoError: no whole number of at least 1.
    """
    if not isinstance(stride, Integral) or int(stride) < 1:
        raise DvoError(f"stride {str(stride)[:40]}", field="stride", remedy="give a whole number of at least 1")


def check_invert(mask: object, invert: bool) -> None:
    """Check that only a mask that is there is inverted.

    Args:
        mask: as given by the user.
        invert: white pixels are ignored.

    Raises:
        DvoError: there is none.
    """
    if invert and mask is None:
        raise DvoError("there is no mask to invert", field="mask_invert", remedy="give --mask too, or leave it out")


def locate(given: Path | str, source: Path, field: str) -> Path:
    """File of an option, looked up from the working directory, then from the folder of the source.

    Args:
        given: by the user.
        source: file or folder that is opened; the name of a stream, which has no folder.
        field: name of the option.

    Returns:
        The file; of a mask, depth images, right images or inertial samples, possibly a folder.

    Raises:
        DvoError: no such file.
    """
    path = Path(given)
    base = source if is_folder(source) else source.parent
    may_be_folder, is_calibration = field in ("mask", "depth", "right", "imu"), field in ("calib", "depth-calib")
    for option in (path, base / path):
        if is_calibration_file(option) if is_calibration else is_file(option):
            return option
        if may_be_folder and is_folder(option):
            return option
    kind = "file or folder" if may_be_folder else "file"
    raise DvoError(f"no such {kind}", file=path, field=field, remedy=f"give an existing {kind} to --{field}")


def first_frame(recording: Recording) -> RawFrame:
    """First frame that decodes.

    Args:
        recording: as opened, from its first frame on.

    Raises:
        DvoError: there is none.
    """
    log = Log()
    found = next(islice(recording.frames(log), 1), None)
    if found is None:
        if log.missing and not log.unreadable:
            remedy = "mend the links, or the names in the list"
            raise DvoError(f"none of the {len(log.missing)} images is there", file=recording.path, remedy=remedy)
        count = len(log.unreadable)
        absent = f"; {len(log.missing)} others are not there" if log.missing else ""
        what = no_image(recording.images[0]) if recording.images else None
        known = f": {recording.images[0].name} is {what}" if recording.images and what else ""
        raise DvoError(
            f"none of the {count} images decodes{known}{absent}",
            file=recording.path,
            remedy="check that the files are images that other programs can show",
        )
    return found


def nearby_calibration(path: Path, width: int, height: int) -> Path | None:
    """A calibration of images of this size that lies in or beside a source and was not asked for.

    Args:
        path: file or folder that is opened.
        width, height: of its images.

    Returns:
        ``calib.txt``, or else a file with a name of a calibration that can be read and fits; None if there is none.
    """
    folders = [path, path.parent] if is_folder(path) else [path.parent]
    for folder in folders:
        if is_file(folder / _CALIBRATION):
            return folder / _CALIBRATION
    for file in islice(_files_of_cameras(folders), _TRIED):
        try:
            read_calibration(file).camera(width, height)
        except DvoError:
            continue
        return file
    return None


def _files_of_cameras(folders: Sequence[Path]) -> Iterator[Path]:
    for place in (folder / name for folder in folders for name in _BESIDE):
        try:
            names = sorted(entry.name for entry in islice(os.scandir(place), _ENTRIES))
        except OSError:
            continue
        for file in (place / name for name in names if _OF_A_CAMERA.fullmatch(name)):
            if is_file(file) and file.stat().st_size <= _SMALL:
                yield file


def no_calibration(path: Path, width: int, height: int, warnings: Sequence[str] = ()) -> DvoError:
    """Error of a source without a calibration, with the name of one that lies near.

    Args:
        path: file or folder that is opened.
        width, height: of its images.
        warnings: of the recording; what they say about a calibration that is there is the reason.
    """
    nearby = nearby_calibration(path, width, height)
    hint = f" (is it {nearby}?)" if nearby else ""
    return DvoError(
        "; ".join(["no calibration", *(text for text in warnings if "camera_info" in text)]),
        file=path,
        field="calib",
        remedy=f"give --calib FILE{hint}: a text file with 'fx fy cx cy [k1 k2 p1 p2 [k3]]' in pixels, or a YAML; or "
        "guess=True, and dvo.calibrate",
    )
