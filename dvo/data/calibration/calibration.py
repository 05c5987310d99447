"""Calibration of a camera, and of the right camera of a stereo pair, as files and data sets state them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera, DistortionModel
from dvo.geometry.lenses import LENSES, magnification

EXPECTED = "write 'fx fy cx cy [k1 k2 p1 p2 [k3]]' on one line, or a YAML with fx, fy, cx, cy"
"""What a file of a calibration may hold, as the remedy of errors."""
_TURN = (
    "the images stand upright, the calibration is that of the sensor: turn it too (fx and fy, and cx and cy, change "
    "places)"
)
_EXCHANGED = "its principal point is the centre of images of these sides: exchange width and height in it"
_LISTED = 20  # cameras of a file that a message names
_NEAR_CORNER = 0.05  # of the sides: no principal point lies there

_OTHER_SIZE = 0.15  # of the principal point's distance from the corner: more than that of a lens that is off centre
_SAME_SHAPE = 0.06
_SIZES = [
    (320, 240), (640, 360), (640, 480), (752, 480), (800, 600), (848, 480), (960, 540), (960, 720), (1024, 768),
    (1280, 720), (1280, 960), (1280, 1024), (1440, 1080), (1600, 1200), (1920, 1080), (1920, 1200), (1920, 1440),
    (2048, 1536), (2560, 1440), (2704, 1520), (3840, 2160), (4000, 3000), (4032, 3024), (4096, 2160),
]  # fmt: skip


FOUND = "focal length found by dvo"
"""Beginning of the comment in the first line of a file, and key in JSON: of a focal length that was found in the images
of a clip, or is a guess."""
FOUND_BY_DVO = f"# {FOUND}; a run without a calibration replaces this file\n"
"""First line of a calibration file of a focal length that was found in the images of a clip."""


@dataclass(frozen=True)
class Calibration:
    """Intrinsics in pixels, without an image yet.

    Attributes:
        fx, fy, cx, cy: pixels; pixel centres at integers.
        model, coefficients: as in :class:`dvo.geometry.camera.Camera`.
        width, height: size of the images that it was made for, if the file states it.
        file: file that it was read from, for messages.
        depth_scale: units of a metre in depth images of integers that belong to the images.
        baseline: metres from the camera to the right camera of a rectified pair with the same intrinsics.
        readout: seconds in which a rolling shutter reads the rows, as in :class:`dvo.geometry.camera.Camera`.
        was_found: dvo has found it in the images of a clip, or guessed it, as the file may say (:data:`FOUND`).
        dialect: form of the file that it was read from.
        ignored: keys of the file that were not used.
        notes: what the user has to know about the file, in sentences; :meth:`doubts` has them too.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    model: DistortionModel = "none"
    coefficients: tuple[float, ...] = ()
    width: int | None = None
    height: int | None = None
    file: Path | None = None
    depth_scale: float | None = None
    baseline: float | None = None
    readout: float = 0.0
    was_found: bool = field(default=False, compare=False, repr=False)
    dialect: str = field(default="", compare=False, repr=False)
    ignored: tuple[str, ...] = field(default=(), compare=False, repr=False)
    notes: tuple[str, ...] = field(default=(), compare=False, repr=False)

    def camera(self, width: int, height: int) -> Camera:
        """Camera of images of this size.

        Args:
            width, height: size of the images in pixels.

        Raises:
            DvoError: the intrinsics do not fit: another resolution stated, a focal length below 0.1 or above 20 image
                widths, a principal point outside of the image or in its corner; or a readout outside of 0 to 1 s.
        """
        remedy = f"give the calibration of these {width}x{height} images"
        if (self.width or width, self.height or height) != (width, height):
            raise DvoError(
                f"calibration is for {self.width}x{self.height} images, but these are {width}x{height}",
                file=self.file,
                field="intrinsics",
                remedy=remedy
                if (self.width, self.height) != (height, width)
                else (_EXCHANGED if self._fits_turned(height, width) else _TURN),
            )
        LENSES[self.model].check(self.coefficients, self.model)
        factor = magnification(self.model, self.coefficients)
        for name, focal in (("fx", self.fx), ("fy", self.fy)):
            if not 0.1 * width <= focal * factor <= 20 * width:  # NaN fails too
                raise DvoError(
                    f"{name}={focal:g} does not fit an image {width} pixels wide",
                    file=self.file,
                    field="intrinsics",
                    remedy=f"{remedy}, in pixels",
                )
        if abs(self.cx) < _NEAR_CORNER * width and abs(self.cy) < _NEAR_CORNER * height:
            raise DvoError(
                f"the principal point ({self.cx:g}, {self.cy:g}) of {width}x{height} images, as if it were an offset "
                "from their centre or a share of the size",
                file=self.file,
                field="intrinsics",
                remedy=f"give cx and cy in pixels from the corner (centre: {(width - 1) / 2:g}, {(height - 1) / 2:g})",
            )
        try:
            numbers = (self.fx, self.fy, self.cx, self.cy)
            return Camera(*numbers, width, height, self.model, self.coefficients, self.readout)
        except DvoError as error:
            turned = error.field == "intrinsics" and self._fits_turned(width, height)
            remedy = _TURN if turned else error.remedy or remedy
            raise DvoError(error.message, file=self.file, field=error.field, remedy=remedy) from None

    def _fits_turned(self, width: int, height: int) -> bool:
        """True if the principal point is not near the centre of these images, but near that of the same ones turned."""
        upright, turned = (abs(self.cx - w / 2) + abs(self.cy - h / 2) for w, h in ((width, height), (height, width)))
        return width != height and turned < min(0.1 * max(width, height), 0.5 * upright)

    def _other_size(self, width: int, height: int) -> tuple[int, int] | None:
        """Size whose centre the principal point is, if it is of the same shape as these images and of another size."""
        scale = (2 * self.cx + 1) / width, (2 * self.cy + 1) / height
        mean = (scale[0] + scale[1]) / 2
        if self.width is not None or not (mean > 0 and abs(mean - 1) > _OTHER_SIZE):
            return None
        if abs(scale[0] - scale[1]) > _SAME_SHAPE * mean:
            return None
        likely = [size for size in _SIZES if abs(size[0] / (mean * width) - 1) < _SAME_SHAPE / 2]
        fitting = [size for size in likely if abs(size[0] * height / (size[1] * width) - 1) < 0.01]
        return min(fitting, key=lambda s: abs(s[0] - mean * width), default=(round(mean * width), round(mean * height)))

    def doubts(self, width: int, height: int) -> list[str]:
        """Oddities of the calibration for images of this size, in sentences; nothing in it need be wrong.

        Args:
            width, height: size of the images in pixels.
        """
        found = list(self.notes)
        looks = self._other_size(width, height)
        if self._fits_turned(width, height):
            found.append(
                f"the principal point ({self.cx:g}, {self.cy:g}) is the centre of {height}x{width} images, but these "
                f"are {width}x{height}: {_TURN}"
            )
        elif looks:
            found.append(
                f"the principal point ({self.cx:g}, {self.cy:g}) is the centre of {looks[0]}x{looks[1]} images, but "
                f"these are {width}x{height}: is the calibration that of {looks[0]}x{looks[1]} images? Then multiply "
                f"fx, fy, cx + 0.5 and cy + 0.5 by {width / looks[0]:.4g}"
            )
        elif abs(self.cx - width / 2) > width / 4 or abs(self.cy - height / 2) > height / 4:
            found.append(
                f"the principal point ({self.cx:g}, {self.cy:g}) lies far from the centre of the {width}x{height} "
                "images: is the calibration that of another resolution?"
            )
        if not 0.8 * self.fy < self.fx < 1.25 * self.fy:
            found.append(f"fx={self.fx:g} and fy={self.fy:g} differ a lot: were the images stretched?")
        return found


@dataclass(frozen=True)
class Dialect:
    """Form of a calibration file.

    Attributes:
        matches: whether a file is of this form, from its path and its text (empty for a binary file, ``*.bin``).
        read: the calibration, from path, text, and the number of the camera that the user asks for, None for none.

    Example:
        A module of an outside package, announced by an entry point of the group ``dvo.calibration_dialects``::

            def read(path: Path, text: str, camera: int | None) -> Calibration:
                focal, width, height = map(float, text.split()[1:])
                return Calibration(focal, focal, (width - 1) / 2, (height - 1) / 2, file=path)

            DIALECT = Dialect(lambda path, text: text.startswith("FOCAL "), read)
    """

    matches: Callable[[Path, str], bool]
    read: Callable[[Path, str, int | None], Calibration]


def one_of(cameras: Sequence[tuple[str, Calibration]], camera: int | None, path: Path) -> Calibration:
    """The camera of a file that is asked for.

    Args:
        cameras: of the file, with their names.
        camera: position among them; None for the only one, or for any if all are the same.
        path: of the file, for messages.

    Raises:
        DvoError: no camera at all, none of that number, or several that differ.
    """
    names = ", ".join(f"{number}: {name}" for number, (name, _) in enumerate(cameras[:_LISTED]))
    names += f" and {len(cameras) - _LISTED} more" if len(cameras) > _LISTED else ""
    if camera is not None and not 0 <= camera < len(cameras):
        remedy = f"leave out :{camera}, or give the number of one of {names or 'its cameras'}"
        raise DvoError(f"no camera {camera} in it", file=path, field="calibration", remedy=remedy)
    if not cameras:
        raise DvoError("no camera in it", file=path, field="calibration", remedy=EXPECTED)
    if camera is None and any(other != cameras[0][1] for _, other in cameras[1:]):
        remedy = f"give {path.name}:NUMBER of that of the images"
        raise DvoError(f"{len(cameras)} cameras in it: {names}", file=path, field="calibration", remedy=remedy)
    return cameras[camera or 0][1]


@dataclass(frozen=True)
class StereoRig:
    """Right camera of a stereo pair.

    Attributes:
        calibration: of the right images as recorded.
        T_left_right: ``(7,)`` pose of the right camera in the coordinates of the left one, metres.
    """

    calibration: Calibration
    T_left_right: np.ndarray


def rectified(calibration: Calibration, baseline: float) -> Callable[[], StereoRig]:
    """Loader of the right camera of a rectified pair: same intrinsics, parallel axes.

    Args:
        calibration: of both cameras.
        baseline: metres from the left to the right camera, along x.
    """
    return partial(StereoRig, calibration, np.array([baseline, 0, 0, 0, 0, 0, 1.0]))
