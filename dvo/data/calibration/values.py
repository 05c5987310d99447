"""Calibrations of named values: the YAML, JSON and XML of EuRoC, Kalibr, ROS, OpenCV, ORB-SLAM, VINS and dvo itself."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration import entries as fields
from dvo.data.calibration.calibration import EXPECTED, Calibration, Dialect
from dvo.data.calibration.colmap_cameras import CORNER
from dvo.data.calibration.documents import (
    is_ini,
    is_ost,
    load_documents,
    load_ini,
    load_json,
    load_ost,
    load_toml,
    load_xml,
)
from dvo.data.calibration.entries import Entries
from dvo.data.calibration.lens_names import PINHOLE, bare, is_flag, looks_like_a_lens, model_of, says_nothing
from dvo.geometry.camera import DistortionModel
from dvo.geometry.lenses import LENSES

_SKEW = 1e-6
"""Skew over focal length that is taken for rounding."""
_COEFFICIENTS = (
    "coefficients", "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distcoefs", "distcoef",
    "distortioncoeff", "distortioncoefs", "distortioncoef", "distortioncoefficient", "distcoefficients",
    "distcoefficient", "dist", "d", "distortion", "distortions", "distortionparameters", "distortionparams",
    "distparams", "distparameters", "distortionvector", "distortiondata", "distortionvalues", "coeffs", "coefs",
    "coeff", "kc", "lensdistortion", "lensdistortioncoefficients", "radialdistortion", "distortionk",
    "distcoefficientsmatrix", "dcoeffs", "lenscoefficients", "lenscoeffs", "fisheyecoefficients", "fisheyecoeffs",
    "lens", "radtan", "intrinsicdist", "distortionmatrix", "kd", "distvec", "distortioncoeffients",
)  # fmt: skip
_MODEL_KEYS = (
    "distortionmodel", "distortiontype", "distmodel", "disttype", "lensmodel", "lenstype", "lens", "distortion",
    "projectionmodel", "projectiontype", "projection", "cameramodel", "modeltype", "cameratype", "model", "cammodel",
    "intrinsicstype", "intrinsicsmodel", "cameramodeltype",
)  # fmt: skip
_RADIAL = ("radialdistortion", "radialdistortioncoefficients", "radialdistortioncoeffs", "radialcoefficients",
           "radialcoeffs")  # fmt: skip
_TANGENTIAL = tuple(name.replace("radial", "tangential") for name in _RADIAL)
_FISHEYE_FLAGS = ("fisheyemodel", "isfisheye", "fisheye", "usefisheye", "bfisheye")
_RADTAN_FLAT = LENSES["radtan"].names
_FIRST = ("cam0", "camera0", "camera", "camera1", "left", "leftcamera", "cameraleft", "camleft", "0", "l", "1", "color",
          "colour", "rgb", "rgbcamera", "colorcamera", "colourcamera", "cameracolor", "camerargb", "colorintrinsics",
          "rgbintrinsics", "colorcam", "rgbcam", "colorsensor", "rgbsensor", "cam", "cam1", "camleftrect", "leftcam",
          "00", "02")  # fmt: skip
_IF_ZERO = ("inversebrownconrady", "modifiedbrownconrady")  # RealSense: models without coefficients as a rule
_SENSORS = frozenset(["gray", "grey", "rgb", "color", "colour", "mono", "monocular", "stereo", "graydepth", "rgbdepth",
                      "rgbd", "usb", "csi", "global", "rolling", "globalshutter", "rollingshutter"])  # fmt: skip
"""Kinds of cameras that say nothing of their lens."""
_UNIT = frozenset(["unit", "units", "focalunit", "focallengthunit", "focalunits", "focallengthunits"])
_OTHER_UNITS = ("mm", "millimeter", "millimeters", "millimetre", "millimetres", "normalized", "normalised", "relative")
_SENSOR = frozenset(["sensorwidth", "sensorwidthmm", "sensorsize", "sensorsizemm", "sensor", "pixelsize", "pixelpitch",
                     "filmback", "filmwidth", "apwidth"])  # fmt: skip
_WIDEST = 0.3  # focal length, widths of the images: below it, a lens is wider than a pinhole camera shows
_USUAL = 640  # width that is assumed for this where the file states none
_LONGEST = 3.0  # baseline of a pair of cameras on one device, metres
_BRACE = re.compile(r'\s*\{\s*"')
_PAIRED = re.compile(r"(k|m|(?:camera_?)?matrix|camera_?mat|mtx|intrinsics?)_?(left|right|l|r|[0-2]|0[0-3])")
_REGION = ("x_offset", "y_offset", "width", "height")
_RECORDED = re.compile(r"^(?:original|orig|raw|distorted)|(?:original|orig|raw|(?<!un)distorted)$")
_OF_OTHERS = re.compile(r"depth|infrared|(?<![a-z])ir(?![a-z])|thermal|(?<![a-z])tof(?![a-z])", re.IGNORECASE)
_SUFFIX = re.compile(r"(.+?)_?(left|right|l|r|[0-2]|0[0-3])")
_LED = re.compile(r"(left|right|cam(?:era)?_?[0-3])_(k|(?:camera_?)?matrix|camera_?mat|mtx|intrinsics?)")


def from_matrix(matrix: np.ndarray, path: Path) -> Calibration:
    """Calibration of a matrix K, or of the K in a 3x4 or 4x4 matrix; also column by column.

    Args:
        matrix: K of a pinhole camera without skew.
        path: file that it comes from, for messages.

    Raises:
        DvoError: not a matrix of that form, or one with skew.
    """
    if matrix.shape in ((3, 4), (4, 4)):
        is_square = matrix.shape == (4, 4)
        outside = [*matrix[:3, 3], *(matrix[3, :3] if is_square else [])]
        matrix = matrix[:3, :3] if not any(outside) and (not is_square or matrix[3, 3] == 1) else np.zeros((0, 0))
    if matrix.shape == (3, 3) and not matrix[:2, 2].any() and matrix[2, :2].all() and matrix[2, 2] == 1:
        matrix = matrix.T  # Open3D, ARKit and MATLAB write columns
    if matrix.size and not matrix.any():
        raise DvoError("a matrix of zeros: the camera is not calibrated", file=path, field="intrinsics",
                       remedy="calibrate it, dvo calibrate --board")  # fmt: skip
    if matrix.shape != (3, 3) or matrix[1, 0] != 0 or (matrix[2] != [0, 0, 1]).any():
        raise DvoError("not a pinhole matrix K", file=path, field="intrinsics", remedy=EXPECTED)
    _refuse_skew(float(matrix[0, 1]), float(matrix[0, 0]), path, "intrinsics")
    return Calibration(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2]), file=path)


def _refuse_skew(skew: float, focal: float, path: Path, field: str) -> None:
    if not abs(skew) <= _SKEW * abs(focal):  # NaN fails too
        raise DvoError(
            f"dvo has no camera with skew ({skew:g})",
            file=path,
            field=field,
            remedy="calibrate without skew, which cameras of today do not have",
        )


def from_values(data: Any, path: Path, camera: int | None = None) -> Calibration:
    """Calibration of the entries of one of the dialects of :func:`dvo.data.calibration.read.read_calibration`.

    Args:
        data: dictionary of the entries, or a list of such documents.
        path: file that they come from, for messages.
        camera: number of the camera in a file of several; None for the first or the left one.

    Raises:
        DvoError: as :func:`dvo.data.calibration.read.read_calibration`; the signs of the focal lengths are not checked.
    """
    documents = [fields.plain(_merged(document)) for document in (data if isinstance(data, list) else [data])]
    mappings = [document for document in documents if isinstance(document, dict)]
    if not mappings:
        raise DvoError("no keys in it", file=path, field="intrinsics", remedy=EXPECTED)
    found = [fields.cameras(_split(document), path) for document in mappings]
    read = [_calibration(_choose(named, camera, path), path) for named in found if named]
    only = [named[0][0] for named in found if len(named) == 1]
    if len(read) == 1 and camera is None and only and (kind := _OF_OTHERS.search(only[0])):
        note = f"the only camera in it is {only[0]}: is that the camera of the images, or of {kind[0].lower()}?"
        read = [replace(read[0], notes=(*read[0].notes, note))]
    if not read:
        other = _in_other_terms(mappings)
        remedy = EXPECTED if other is None else f"give fx = fy = {other}, cx = (width - 1) / 2, cy = (height - 1) / 2"
        raise DvoError(_missing(mappings), file=path, field="intrinsics", remedy=remedy)
    if any(other != read[0] for other in read[1:]):
        message = f"a list of {len(read)} cameras that differ"
        raise DvoError(message, file=path, field="intrinsics", remedy="leave that of the images in it")
    return read[0]


def _merged(document: Any) -> Any:
    """One mapping of a list of entries, ``- K: ...`` and ``- D: ...``."""
    if not isinstance(document, list) or not all(isinstance(part, dict) and len(part) == 1 for part in document):
        return document
    merged = {key: value for part in document for key, value in part.items()}
    return merged if len(merged) == len(document) else document


def _missing(mappings: Sequence[dict[str, Any]]) -> str:
    keys = [str(key)[:40] for mapping in mappings for key in mapping]
    named = f": {', '.join(keys[:8])}{' and more' if len(keys) > 8 else ''}" if keys else ""
    return f"no fx, fy, cx, cy in it, nor a camera matrix{named}"


def _in_other_terms(mappings: Sequence[dict[str, Any]]) -> str | None:
    """Focal length in pixels of a file of a simulator or a renderer, by an angle or in millimetres; None for others."""
    keys = {bare(str(key)) for mapping in mappings for key in _keys(mapping)}
    if any(key.startswith(("fov", "hfov", "fieldofview", "anglex", "xfov", "horizontalfov")) for key in keys):
        return "width / 2 / tan(horizontal angle / 2), or height / 2 / tan(vertical angle / 2)"
    if keys & _SENSOR and any("lens" in key or "focal" in key for key in keys):
        return "focal length / width of the sensor * width"
    return None


def _keys(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield str(key)
            yield from _keys(item)
    elif isinstance(value, list):
        for item in value:
            yield from _keys(item)


def _split(value: Any) -> Any:
    """The tree with ``K_left`` and ``D_left``, ``left_K``, or ``M1`` and ``D1``, as entries of ``left`` and ``1``."""
    if isinstance(value, list):
        return [_split(item) for item in value]
    if not isinstance(value, dict):
        return value
    found: dict[str, Any] = {}
    matrices = [str(key).lower() for key, item in value.items() if isinstance(item, list) and len(item) in (3, 4, 9)]
    paired = {parts[2] for key in matrices if (parts := _PAIRED.fullmatch(key))}
    led = {parts[1] for key in matrices if (parts := _LED.fullmatch(key))}
    for key, item in value.items():
        name = str(key).lower()
        parts, head = _SUFFIX.fullmatch(name), next((head for head in led if name.startswith(f"{head}_")), None)
        if parts and isinstance(item, list) and parts[2] in paired and not isinstance(found.get(parts[2], {}), list):
            found.setdefault(parts[2], {})[parts[1]] = item
        elif head is not None and isinstance(found.get(head, {}), dict):
            found.setdefault(head, {})[name[len(head) + 1 :]] = item
        elif bare(str(key)) == "calibration" and _is_row(item) and not {"intrinsics", "coefficients"} & set(value):
            found |= {"intrinsics": item[:4], "coefficients": item[4:]}  # MASt3R-SLAM
        elif bare(str(key)) == "roi" and isinstance(item, dict) and set(_REGION) <= set(item):
            found["region_of_sensor"] = [item[part] for part in _REGION]  # ROS
        else:
            found[key] = _split(item)
    return found


def _is_row(value: Any) -> bool:
    """True for ``fx fy cx cy [k1 k2 p1 p2 ...]`` in a list."""
    is_numbers = isinstance(value, list) and all(isinstance(number, int | float) for number in value)
    return is_numbers and len(value) in (4, 8, 9, 12) and value[1] != 0


def _choose(named: list[tuple[str, Entries]], camera: int | None, path: Path) -> Entries:
    """Entries of the camera of that number, of the only one, or of the first one by name."""
    if camera is not None:
        numbers = [re.search(r"(\d+)\D*$", name) for name, _ in named]
        chosen = [named[i][1] for i, number in enumerate(numbers) if number and int(number[1]) == camera]
        if len(chosen) == 1:
            return chosen[0]
    elif len(named) == 1:
        return named[0][1]
    else:
        last = [_last(name) for name, _ in named]
        for first in _FIRST:
            if last.count(first) == 1:
                return named[last.index(first)][1]
        heads = [entries for _, entries in named if entries.index == 0]
        if len(heads) == 1:
            return heads[0]
    names = ", ".join(name or "the file itself" for name, _ in named[:8])
    if camera is not None:
        remedy = f"leave out :{camera}, or give the number of one of {names}"
        raise DvoError(f"no camera {camera} in it", file=path, field="calibration", remedy=remedy)
    raise DvoError(
        f"{len(named)} cameras in it: {names}",
        file=path,
        field="calibration",
        remedy="write the one of the images into a file of its own",
    )


def _last(name: str) -> str:
    part = re.split(r"[.\[]", name)[-1] if name else ""
    return bare(part)


def _calibration(entries: Entries, path: Path) -> Calibration:
    calibration, before = _intrinsics(entries, path)
    width, height = _size(entries, path)
    calibration = _cropped(replace(calibration, width=width, height=height), entries, path)
    calibration = _with_sensors(calibration, entries, path)
    model, coefficients = _lens(entries, before, path)
    for name, value in zip(LENSES[model].names, coefficients, strict=False):  # the same once more, by name
        for one in entries.found:
            if name in one.calls and not isinstance(one.value, bool | str | list | dict) and one.value == value:
                one.used = True
    if model == "fov" and width and height and 0 < calibration.cx < 1 and 0 < calibration.cy < 1:  # PTAM, vikit
        calibration = replace(
            calibration, fx=calibration.fx * width, fy=calibration.fy * height,
            cx=calibration.cx * width - CORNER, cy=calibration.cy * height - CORNER,
        )  # fmt: skip
    skew = entries.numbers("skew", "s", "alphac", "cameraskew", "skewness", "k12", shape="scalar")
    if skew is not None:
        _refuse_skew(float(skew.ravel()[0]), 1.0, path, "skew")
    if model != "none":
        told = entries.entry("distorted", "isdistorted", "hasdistortion")
        other = entries.entry("undistorted", "isundistorted", "rectified", "isrectified")
        if other is not None and is_flag(other.value) and not says_nothing(other.value):
            told = other
        if told is not None and (told is other or says_nothing(told.value)):
            message = f"{str(told.value).lower()}, but there are coefficients of a lens"
            raise DvoError(message, file=path, field=told.name, remedy="leave what is true of the images")
        matrix = next((one for one in entries.found if one.used and "newcameramatrix" in one.calls), None)
        if matrix is not None:
            message = "is that of undistorted images, but there are coefficients of a lens"
            raise DvoError(message, file=path, field=matrix.name, remedy="give the matrix of the recorded images")
        other = next((one for one in entries.found if not one.used and _RECORDED.search(bare(one.key))
                      and not isinstance(one.value, str) and np.size(one.value) == 9), None)  # fmt: skip
        if other is not None:
            message = "is another matrix of a camera with a lens"
            raise DvoError(message, file=path, field=other.name, remedy="leave the matrix of the recorded images alone")
    entries.refuse_unread()
    _refuse_millimetres(calibration, entries, path)
    notes = (*calibration.notes, *_notes(entries))
    return replace(calibration, model=model, coefficients=coefficients, ignored=entries.ignored, notes=notes)


def _refuse_millimetres(calibration: Calibration, entries: Entries, path: Path) -> None:
    """Refuse a focal length in another unit than pixels: one that is named, or that of a lens beside its sensor."""

    def first(names: frozenset[str]) -> fields.Entry | None:
        return next((entry for entry in entries.found if names & set(entry.calls)), None)

    unit, sensor = first(_UNIT), first(_SENSOR)
    if unit is not None and bare(str(unit.value)) in _OTHER_UNITS:
        raise DvoError(f"{str(unit.value)[:40]!r}", file=path, field=unit.name, remedy="give fx, fy, cx, cy in pixels")
    if sensor is not None and min(calibration.fx, calibration.fy) < _WIDEST * (calibration.width or _USUAL):
        raise DvoError(
            f"a focal length of {calibration.fx:g} beside {sensor.name}, as if it were in millimetres",
            file=path, field="intrinsics",
            remedy="give it in pixels: divided by the width of the sensor, times the width of the images",
        )  # fmt: skip


def _pixel_aspect(entries: Entries, path: Path) -> float:
    """``fy`` over ``fx`` of a single focal length, as files of nerfies and Theia state it; 1 by default."""
    stated = entries.numbers("pixelaspectratio", "pixelaspect", shape="scalar")
    if stated is not None:
        return float(stated.ravel()[0])
    other = entries.numbers("aspectratio", shape="scalar")
    width, height = _size(entries, path)
    if other is not None and abs(other - 1) > _SKEW and not (width and height and abs(other - width / height) < 0.01):
        message = f"{float(other):g} beside one focal length: that of the pixels, or that of the images"
        raise DvoError(message, file=path, field="aspect_ratio", remedy="give fx and fy")
    return 1.0


def _notes(entries: Entries) -> tuple[str, ...]:
    """Stereo files of ORB-SLAM2 and OpenVSLAM state the cameras as recorded too, and the rectified one as Camera."""
    left = [name for name in entries.elsewhere if name in ("LEFT", "StereoRectifier.left")]
    found = [
        f"the calibration is that of rectified images (Camera); {name} in the same file is that of the images as "
        "recorded, and was not used"
        for name in left
    ]
    used = [entry for entry in entries.found if entry.used and not says_nothing(entry.value)]
    listed = [one for one in used if set(_COEFFICIENTS) & set(one.calls) and np.size(one.value) == 4]
    named = {*_MODEL_KEYS, *_FISHEYE_FLAGS, "type", "xi", "alpha"} - set(_COEFFICIENTS)
    if listed and not any(named & set(entry.calls) for entry in used):
        found.append(
            f"{listed[0].name} has 4 numbers and no lens model is named: read as radtan, k1 k2 p1 p2 (those of a "
            "fisheye need 'model: fisheye' beside them)"
        )
    return tuple(found)


def _intrinsics(entries: Entries, path: Path) -> tuple[Calibration, list[float]]:
    """Intrinsics, and what some models of Kalibr have before them."""
    found = [entries.numbers(*names, shape="scalar") for names in (fields.FX, fields.FY, fields.CX, fields.CY)]
    focal = entries.numbers(*fields.FOCAL) if found[0] is None and found[1] is None else None
    if focal is not None and focal.size in (1, 2):
        aspect = _pixel_aspect(entries, path) if focal.size == 1 else 1.0
        found[0], found[1] = focal.ravel()[0], focal.ravel()[-1] * aspect
    centre = entries.numbers(*fields.CENTRE) if found[2] is None and found[3] is None else None
    if centre is not None and centre.size == 2:
        found[2], found[3] = centre.ravel()
    if all(value is not None for value in found):
        fx, fy, cx, cy = (float(np.ravel(value)[0]) for value in found if value is not None)
        return Calibration(fx, fy, cx, cy, file=path), []
    entry = fields.matrix_entry(entries)
    if entry is None:
        names = [name for name, value in zip(("fx", "fy", "cx", "cy"), found, strict=True) if value is None]
        raise DvoError(f"no {', '.join(names)} in it", file=path, field="intrinsics", remedy=EXPECTED)
    entry.used = True
    numbers = fields.as_numbers(entry.value, path, "intrinsics")
    if numbers.size in (9, 12, 16):
        return from_matrix(numbers.reshape(-1, 3) if numbers.size == 9 else numbers.reshape(-1, 4), path), []
    if numbers.ndim != 1 or numbers.size not in (4, 5, 6):
        raise DvoError("expected 4 numbers or a 3x3 matrix", file=path, field="intrinsics", remedy=EXPECTED)
    *before, fx, fy, cx, cy = (float(number) for number in numbers)
    return Calibration(fx, fy, cx, cy, file=path), before


def _size(entries: Entries, path: Path) -> tuple[int | None, int | None]:
    entry = entries.entry(
        "resolution", "imagesize", "imagedimension", "imageresolution", "imgsize", "imsize", "framesize", "size",
        "imagedimensions", "sensorresolution", "imagewh", "dim", "imageresolutionpx", "dims", shape="list",
    ) or entries.entry("resolution", "imagesize", "imageresolution", "size")  # fmt: skip
    pair: Any
    if entry is None:
        width = entries.take("width", "imagewidth", "cols", "w", "imgwidth", "imwidth", "xres", "resolutionx",
                             "imgw", "imagew", "imw", "pixelwidth", "resolutionwidth", shape="scalar")  # fmt: skip
        height = entries.take("height", "imageheight", "rows", "h", "imgheight", "imheight", "yres", "resolutiony",
                              "imgh", "imageh", "imh", "pixelheight", "resolutionheight", shape="scalar")  # fmt: skip
        pair = [width or 0, height or 0]
    else:
        pair = entry.value
        if isinstance(pair, str):
            pair = re.split(r"[x*, ]+", pair.strip("()[] "))
        if entries.index is not None and isinstance(pair, list) and pair and isinstance(pair[0], list):
            pair = pair[entries.index] if entries.index < len(pair) else pair  # basalt: one for each camera
    size = fields.as_numbers(pair, path, "resolution")
    size = size.ravel() if size.shape in ((1, 2), (2, 1)) else size
    if size.shape != (2,) or not ((size >= 0) & (size <= 1e6) & (size == np.rint(size))).all():
        raise DvoError("expected width and height", file=path, field="resolution", remedy="give two whole numbers")
    return int(size[0]) or None, int(size[1]) or None


def _cropped(calibration: Calibration, entries: Entries, path: Path) -> Calibration:
    """Of what ROS reads out of the sensor (``roi``, ``binning_x``): K and size are those of the whole one."""
    bins = [_binning(entries, f"binning{axis}", path) for axis in "xy"]
    numbers = entries.numbers("regionofsensor", shape="list")
    left, top, width, height = (0.0, 0.0, 0.0, 0.0) if numbers is None or numbers.shape != (4,) else numbers.tolist()
    if not (width > 0 and height > 0):  # the whole sensor
        left, top, width, height = 0.0, 0.0, calibration.width or 0, calibration.height or 0
    outside = calibration.width and calibration.height and (
        left + width > calibration.width or top + height > calibration.height
    )  # fmt: skip
    if min(left, top) < 0 or outside or any(number != int(number) for number in (left, top, width, height)):
        raise DvoError("a region beyond the image", file=path, field="roi", remedy="leave it out, or mend it")
    return replace(  # as image_geometry of ROS
        calibration, fx=calibration.fx / bins[0], fy=calibration.fy / bins[1], cx=(calibration.cx - left) / bins[0],
        cy=(calibration.cy - top) / bins[1], width=int(width) // bins[0] or None, height=int(height) // bins[1] or None,
    )  # fmt: skip


def _binning(entries: Entries, name: str, path: Path) -> int:
    """Pixels of the sensor to one of the images; ROS has 0 for 1 too."""
    value = entries.take(name, shape="scalar")
    if value in (None, 0):
        return 1
    if not isinstance(value, int | float) or not (1 <= value <= 64 and value == int(value)):
        raise DvoError("no number of pixels", file=path, field=f"binning_{name[-1]}", remedy="give 1, 2, ...")
    return int(value)


def _with_sensors(calibration: Calibration, entries: Entries, path: Path) -> Calibration:
    found: dict[str, float | None] = {}
    keys: dict[str, tuple[str, ...]] = {
        "depth_scale": ("depthscale", "depthmapfactor", "rgbddepthmapfactor", "pngdepthscale"),
        "baseline": ("baseline", "stereob"),
        "readout": ("readout",),
    }
    for name, names in keys.items():
        value: Any = entries.numbers(*names)
        if value is None and name == "baseline":
            value = entries.numbers("bf")
            if value is not None:
                value = value / calibration.fx if calibration.fx else value  # fx of 0 is refused later
        number = None if value is None else np.asarray(value)
        low, high, expected = (0, 1, "seconds, 0 to 1") if name == "readout" else (1e-6, 1e6, "one positive number")
        if number is not None and (number.shape != () or not low <= number <= high):
            raise DvoError(f"expected {expected}", file=path, field=name, remedy="give a number, or leave it out")
        found[name] = None if number is None else float(number)
    scale, baseline, readout = found["depth_scale"], found["baseline"], found["readout"] or 0.0
    notes = list(calibration.notes)
    if scale is not None and scale < 1:
        notes.append(
            f"a depth scale of {scale:g} is no number of units to a metre, and is not used: give --depth-scale"
        )
        scale = None
    if baseline is not None and baseline > _LONGEST:
        notes.append(f"a baseline of {baseline:g} m is that of no camera: give --baseline in metres if it is another")
    return replace(calibration, depth_scale=scale, baseline=baseline, readout=readout, notes=tuple(notes))


def _model(entries: Entries, path: Path) -> DistortionModel | None:
    """Lens model by name, ``none`` included; None where the file names none, or a pinhole camera."""
    named: dict[str, str] = {}
    for key in _MODEL_KEYS:
        for entry in entries.found:
            if key not in entry.calls or isinstance(entry.value, list) or entry.value is None:
                continue
            if key in ("lens", "distortion", "projection") and not isinstance(entry.value, str):
                continue
            if isinstance(entry.value, int | float) and not _has_lens(entries):
                continue  # Record3D: which of the phone's cameras
            if key == "cameratype" and bare(str(entry.value)) in _SENSORS:
                continue  # OKVIS 2: gray
            model = model_of(entry.value)
            if model is None and bare(str(entry.value)).removeprefix("distortion") in _IF_ZERO:
                lists = [one.value for one in entries.found if set(_COEFFICIENTS) & set(one.calls)]
                model = "none" if lists and all(map(says_nothing, lists)) else None
                if model is None:
                    raise DvoError(
                        f"{str(entry.value)[:60]!r} with coefficients: programs do not agree on what it means",
                        file=path, field=entry.name,
                        remedy="calibrate with dvo calibrate --board, or write radtan if they are those of OpenCV",
                    )  # fmt: skip
            if model is None:
                raise DvoError(
                    f"unknown distortion model {str(entry.value)[:60]!r}",
                    file=path,
                    field=entry.name if entry.key != "model" else "model",
                    remedy=f"use one of {', '.join(LENSES)}",
                )
            entry.used = True
            named.setdefault(model, entry.name)
    flag = entries.entry(*_FISHEYE_FLAGS, shape="scalar")
    is_wide = any(name not in ("none", "radtan", PINHOLE) for name in named)
    if flag is not None and not says_nothing(flag.value) and not is_wide:
        model = "fisheye" if is_flag(flag.value) else model_of(flag.value)
        if model is None:
            raise DvoError(f"unknown distortion model {str(flag.value)[:60]!r}", file=path, field=flag.name,
                           remedy=f"use one of {', '.join(LENSES)}")  # fmt: skip
        named.setdefault(model, flag.name)
    kind = entries.take("type", shape="scalar")
    if isinstance(kind, str) and model_of(kind) is not None:
        named.setdefault(str(model_of(kind)), "type")
    pinhole = named.pop(PINHOLE, None)
    if len(named) > 1 and "none" in named and set(named) & {"ucm", "mei", "eucm", "double_sphere", "fov"}:
        del named["none"]
    if set(named) == {"mei", "radtan"}:
        del named["radtan"]
    if len(named) > 1 or (pinhole and set(named) & {"ucm", "mei", "eucm", "double_sphere"}):
        told = " and ".join([*(f"{model} ({key})" for model, key in named.items()), *([pinhole] if pinhole else [])])
        raise DvoError(f"two lens models: {told}", file=path, field="model", remedy="leave the one of the camera")
    return next(iter(named), None)  # type: ignore[arg-type]


def _has_lens(entries: Entries) -> bool:
    """True if something but the name of a model speaks of a lens."""
    return any(
        looks_like_a_lens(entry.key, entry.value) for entry in entries.found
        if not set(_MODEL_KEYS) & set(entry.calls)
    )  # fmt: skip


def _lens(entries: Entries, before: list[float], path: Path) -> tuple[DistortionModel, tuple[float, ...]]:
    model = _model(entries, path)
    values = _apart(entries, path) if model in (None, "radtan") else []
    listed = None if values else entries.entry(*_COEFFICIENTS, shape="list") or _single(entries)
    if model is None and not _is_pinhole(entries):
        model = _wide_by_keys(entries)
    if listed is not None and model in (None, "radtan") and bare(listed.key).startswith("radial"):
        listed.used, listed = False, None  # none of them is tangential
    if listed is not None:
        values = fields.as_numbers(listed.value, path, "coefficients").ravel().tolist()
    if model == "mei":
        xi = before[:1] or _scalars(entries, path, "xi")
        return "mei", _trimmed("mei", [*xi, *(values or _flat_radtan(entries, path))], path)
    if model in ("ucm", "eucm", "double_sphere", "fov"):
        names = LENSES[model].names
        keyed = _scalars(entries, path, *(("omega", "w", "d0") if model == "fov" else names), only=len(names))
        if any(values[len(names) :]) or (before and any(values)) or (keyed and any(values)):
            raise _wrong_count(len(values), model, path)
        return model, _trimmed(model, before or keyed or values[: len(names)], path)
    if before:
        raise DvoError(f"{4 + len(before)} intrinsics of the model {model or 'pinhole'}", file=path, field="intrinsics",
                       remedy=EXPECTED)  # fmt: skip
    if model == "fisheye":
        return "fisheye", _trimmed("fisheye", values or _flat_fisheye(entries, path), path)
    if model == "none":
        return "none", _trimmed("none", values, path)
    if model not in (None, "radtan"):
        keyed = [] if values else _scalars(entries, path, *LENSES[model].names, zeros=True)
        return model, _trimmed(model, values or keyed, path)
    if model is None and not values:
        _refuse_four_radial(entries, path)
    kept = _trimmed("radtan", values or _flat_radtan(entries, path), path)
    return ("radtan", kept) if any(kept) else ("none", ())


def _apart(entries: Entries, path: Path) -> list[float]:
    """``k1 k2 p1 p2 k3`` of two or three radial and two tangential coefficients that stand in lists of their own."""
    tangential = entries.entry(*_TANGENTIAL, "tangential", shape="list")
    radial = entries.entry(*_RADIAL, *(["radial"] if tangential else []), shape="list")
    lists = [[] if one is None else fields.as_numbers(one.value, path, one.name).ravel().tolist()
             for one in (radial, tangential)]  # fmt: skip
    if len(lists[0]) not in (2, 3) or len(lists[1]) not in (0, 2):
        for one in (radial, tangential):
            if one is not None:
                one.used = False
        return []
    k1, k2, k3 = (*lists[0], 0.0)[:3]
    return [k1, k2, *(lists[1] or [0.0, 0.0]), k3]


def _single(entries: Entries) -> Any:
    """A lone number under a name of coefficients, a list of one."""
    entry = entries.entry(*(name for name in _COEFFICIENTS if name not in ("lens", "distortion")), shape="scalar")
    if entry is not None and isinstance(entry.value, str | bool):
        entry.used = False
        return None
    return entry


def _is_pinhole(entries: Entries) -> bool:
    """True for a file that names a pinhole camera, whose ``xi`` would be a contradiction."""
    return any(model_of(one.value) == PINHOLE for one in entries.found if one.used and set(_MODEL_KEYS) & set(one.calls)
               and isinstance(one.value, str) and one.value.strip())  # fmt: skip


def _wide_by_keys(entries: Entries) -> DistortionModel | None:
    """Model of a file that names none but has the parameters of one."""
    has = {name for name in ("xi", "alpha", "beta") for entry in entries.found
           if name in entry.calls and not says_nothing(entry.value)}  # fmt: skip
    models: dict[frozenset[str], DistortionModel] = {
        frozenset(["xi"]): "mei", frozenset(["xi", "alpha"]): "double_sphere", frozenset(["alpha", "beta"]): "eucm",
    }  # fmt: skip
    return models.get(frozenset(has))


def _scalars(entries: Entries, path: Path, *names: str, only: int = 0, zeros: bool = False) -> list[float]:
    """Numbers of these names, the first so many that are there; 0 for one that is missing if that is allowed."""
    found: list[float] = []
    if zeros and all(entries.entry(name, shape="scalar") is None for name in names):
        return found
    for name in names:
        value = entries.numbers(name, shape="scalar")
        if value is not None or zeros:
            found.append(0.0 if value is None else float(value.ravel()[0]))
        if only and len(found) == only:
            break
    return found


def _flat_fisheye(entries: Entries, path: Path) -> list[float]:
    """``k1`` to ``k4``; VINS and camodocal call them k2 to k5 of the projection."""
    shifted = [entries.numbers(f"projectionparametersk{n}") for n in range(2, 6)]
    if shifted[0] is not None and shifted[3] is not None:
        return [0.0 if value is None else float(value.ravel()[0]) for value in shifted]
    return _scalars(entries, path, "k1", "k2", "k3", "k4", zeros=True) or _scalars(
        entries, path, "d0", "d1", "d2", "d3", zeros=True
    )


def _flat_radtan(entries: Entries, path: Path) -> list[float]:
    """Coefficients by name; those of rpg_svo are called d0 to d4."""
    values = _scalars(entries, path, *_RADTAN_FLAT, zeros=True)
    if not any(values):
        values = _scalars(entries, path, "d0", "d1", "d2", "d3", "d4")
        return values + [0.0] * (4 - len(values)) if values else []
    used = next(count for count in (4, 5, 8, 12) if not any(values[count:]))
    return values[:used]


def _refuse_four_radial(entries: Entries, path: Path) -> None:
    """Refuse ``k1`` to ``k4`` alone, which are those of a fisheye as likely as not."""
    stated = {name for name in (*_RADTAN_FLAT[:8], "xi", "alpha") for one in entries.found if name in one.calls}
    k4 = entries.numbers("k4", shape="scalar") if stated == {"k1", "k2", "k3", "k4"} else None
    if k4 is not None and k4.any():
        message = "k1 to k4 without p1 and p2, and no lens model is named"
        remedy = "write 'model: fisheye', or p1 and p2 too if they are those of radtan"
        raise DvoError(message, file=path, field="k4", remedy=remedy)


def _trimmed(model: DistortionModel, values: Sequence[float], path: Path) -> tuple[float, ...]:
    """Coefficients of a model without the zeros that OpenCV and ROS append."""
    counts = {"none": (0,), "radtan": (0, 4, 5, 8, 12), "fisheye": (0, 4)}.get(model, LENSES[model].counts)
    kept = list(values)
    few = {"radtan": 5, "mei": 6}.get(model, max(counts))  # what files of this model usually have
    if len(kept) > few:
        kept = kept[: next((n for n in counts if n >= few and not any(kept[n:])), len(kept))]
    if len(kept) not in counts:
        raise _wrong_count(len(kept), model, path)
    try:
        LENSES[model].check(tuple(kept), model)
    except DvoError as error:
        raise DvoError(error.message, file=path, field=error.field, remedy=error.remedy or EXPECTED) from None
    return tuple(float(value) for value in kept)


def _wrong_count(count: int, model: DistortionModel, path: Path) -> DvoError:
    remedy = f"{model} has {' '.join(LENSES[model].names) or 'none'}"
    if model == "radtan":
        remedy = "radtan has k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]], fisheye k1 k2 k3 k4"
    return DvoError(f"{count} coefficients for the model {model}", file=path, field="coefficients", remedy=remedy)


def is_yaml(path: Path, text: str) -> bool:
    """True for a file with the name or the first line of a YAML.

    Args:
        path: of the file.
        text: its content.
    """
    return path.suffix.lower() in (".yaml", ".yml") or text.startswith("%YAML")


DIALECT = Dialect(is_yaml, lambda path, text, camera: from_values(load_documents(text, path), path, camera))
JSON = Dialect(
    lambda path, text: path.suffix.lower() == ".json" or _BRACE.match(text) is not None,
    lambda path, text, camera: from_values(load_json(text, path), path, camera),
)
TOML = Dialect(
    lambda path, text: path.suffix.lower() == ".toml",
    lambda path, text, camera: from_values(load_toml(text, path), path, camera),
)
XML = Dialect(
    lambda path, text: path.suffix.lower() == ".xml" or text.lstrip().startswith("<?xml"),
    lambda path, text, camera: from_values(load_xml(text, path), path, camera),
)
OST = Dialect(
    lambda path, text: is_ost(text), lambda path, text, camera: from_values(load_ost(text, path), path, camera)
)
INI = Dialect(
    lambda path, text: is_ini(text), lambda path, text, camera: from_values(load_ini(text, path), path, camera)
)
