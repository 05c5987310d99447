"""Camera: pinhole intrinsics, the size of the image that they belong to, lens distortion, and readout of the rows.

Pixel centres lie at integer coordinates: the first pixel covers [-0.5, 0.5].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.geometry.lenses import LENSES, DistortionModel, magnification

__all__ = ["Camera", "DistortionModel"]


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with optional distortion.

    Scalars of NumPy and torch become numbers of Python, and arrays and lists of coefficients a tuple.

    Attributes:
        fx, fy, cx, cy: intrinsics in pixels of a ``width`` x ``height`` image.
        width, height: image size in pixels.
        model: ``none``, ``radtan`` (k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]], OpenCV order), ``fisheye``
            (Kannala-Brandt k1 k2 k3 k4), or another one of :mod:`dvo.geometry.lenses`.
        coefficients: distortion coefficients of that model.
        readout: seconds from the first to the last row of a rolling shutter, read from top to bottom: row r is read
            ``(r - (height - 1) / 2) readout / height`` seconds after the time of the frame, which is that of its middle
            row; 0 for a global shutter.

    Raises:
        DvoError: values that are no numbers, intrinsics that cannot belong to an image of this size, an unknown model,
            coefficients that it does not have, or a readout outside of 0 to 1 s.

    Example:
        >>> camera = dvo.Camera(500.0, 500.0, 319.5, 239.5, 640, 480)
        >>> camera.resized(320, 240).intrinsics.tolist()
        [250.0, 250.0, 159.5, 119.5]
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    model: DistortionModel = "none"
    coefficients: tuple[float, ...] = ()
    readout: float = 0.0

    def __post_init__(self) -> None:
        self._to_plain()
        values = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        if not np.isfinite(values).all():
            raise DvoError("not a finite number", field="intrinsics", remedy="give fx fy cx cy in pixels")
        if self.fx <= 0 or self.fy <= 0:
            raise DvoError(
                f"focal length must be positive, got fx={self.fx:g} fy={self.fy:g}",
                field="intrinsics",
                remedy="give fx fy cx cy in pixels",
            )
        if not (0 <= self.cx < self.width and 0 <= self.cy < self.height):
            raise DvoError(
                f"principal point ({self.cx:g}, {self.cy:g}) lies outside the {self.width}x{self.height} image",
                field="intrinsics",
                remedy="give the calibration of this image size, or scale it",
            )
        if not isinstance(self.model, str) or self.model not in LENSES:
            raise DvoError(
                f"unknown lens model {str(self.model)[:40]!r}", field="model", remedy=f"use one of {', '.join(LENSES)}"
            )
        if self.model != "none" or self.coefficients:
            LENSES[self.model].check(self.coefficients, self.model)
        if not 0 <= self.readout <= 1:  # NaN fails too
            raise DvoError(
                f"must be 0 to 1 s, got {self.readout:g}",
                field="readout",
                remedy="give seconds, or 0 for a global shutter",
            )

    def _to_plain(self) -> None:
        """Numbers of Python for what the user gives."""
        for name in ("fx", "fy", "cx", "cy", "width", "height", "readout"):
            value = getattr(self, name)
            if type(value) is int or (type(value) is float and name not in ("width", "height")):
                continue
            number: int | float = _number(value, name)
            if name in ("width", "height"):
                if number != number or number != round(number) or abs(number) == float("inf"):
                    raise DvoError(f"expected a whole number, got {number:g}", field=name, remedy="give pixels")
                number = round(number)
            object.__setattr__(self, name, number)
        coefficients: Any = self.coefficients
        if not (type(coefficients) is tuple and all(type(value) in (float, int) for value in coefficients)):
            try:
                listed = np.ravel(np.array(coefficients, dtype=np.float64)).tolist()
            except (TypeError, ValueError):
                listed = None
            if listed is None or isinstance(coefficients, str | bytes | dict):
                remedy = "give a tuple, in the order of OpenCV"
                raise DvoError("expected numbers", field="coefficients", remedy=remedy)
            object.__setattr__(self, "coefficients", tuple(listed))

    @property
    def intrinsics(self) -> np.ndarray:
        """``(4,)`` float64 ``fx fy cx cy``."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def matrix(self) -> np.ndarray:
        """``(3, 3)`` float64 K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths at the optical axis, pixels: fx and fy, of some fisheye models times a constant."""
        factor = magnification(self.model, self.coefficients)
        return self.fx * factor, self.fy * factor

    @property
    def is_distorted(self) -> bool:
        """True if any distortion coefficient differs from 0; :attr:`needs_undistortion` decides about images."""
        return self.model != "none" and any(c != 0 for c in self.coefficients)

    @property
    def needs_undistortion(self) -> bool:
        """True if images of the camera differ from those of a pinhole camera.

        A fisheye with zero coefficients needs undistortion too: its model maps the angle, not its tangent.
        """
        return self.model not in ("none", "radtan") or self.is_distorted

    def resized(self, width: int, height: int) -> Camera:
        """Camera of the same image resampled to another size: ``f' = f s``, ``c' = (c + .5) s - .5``.

        The rows together take as long as before: ``readout`` stays.

        Args:
            width, height: new size in pixels.

        Returns:
            The camera of the resampled image.
        """
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Camera of a window of the image.

        Its rows take their share of ``readout``. The time of a frame stays that of the middle row of the whole image;
        the middle row of the window is read ``(top + (height - self.height) / 2) self.readout / self.height`` seconds
        later, which is nothing for a centred window. Whoever cuts elsewhere adds it to the frame's time.

        Args:
            left, top: column and row of the window's first pixel.
            width, height: size of the window in pixels.

        Returns:
            The camera of the window.

        Raises:
            DvoError: the principal point lies outside the window.
        """
        readout = self.readout * height / self.height
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=width, height=height, readout=readout)


def _number(value: Any, name: str) -> float:
    """Number of a scalar of any library."""
    if isinstance(value, Real) or (getattr(value, "ndim", None) == 0 and not isinstance(value, str)):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass
    kind = "None" if value is None else f"an object of type {type(value).__name__}"
    raise DvoError(f"expected a number, got {kind}", field=name, remedy="give fx, fy, cx, cy, width, height in pixels")
