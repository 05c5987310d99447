"""Camera that was found in its own images, with its standard deviations and its calibration file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from dvo.data.calibration.calibration import FOUND_BY_DVO, Calibration
from dvo.data.calibration.focal_guess import FocalGuess, centred
from dvo.data.files.output import replaced

SELF_CALIBRATED = "self-calibration"
"""Source of a focal length that was found in the images."""


@dataclass(frozen=True)
class SelfCalibration:
    """Focal length of a camera without a calibration.

    Attributes:
        focal: fx and fy, pixels.
        deviation: standard deviation, pixels, with the set factor and floor of :class:`CalibrationOptions`.
        source: ``self-calibration``, or that of the guess that was kept
            (:class:`dvo.data.calibration.focal_guess.FocalGuess`).
        width, height: of the images, pixels.
        frames: number of frames that it was estimated from.
        reason: cause for keeping the guess; empty for a focal length that was found.
        guess: at the start.
        aside: way from the middle of the image to the principal point, to the right and down, pixels; 0 where it is not
            told.
        aside_deviation: standard deviations of the two, pixels; inf where it is not told.
        bend: barrel distortion, alpha of the lens model ``eucm`` with a beta of 1; 0 where it is not told.
        bend_deviation: its standard deviation; inf where it is not told.
    """

    focal: float
    deviation: float
    source: str
    width: int
    height: int
    frames: int
    reason: str
    guess: FocalGuess
    aside: tuple[float, float] = (0.0, 0.0)
    aside_deviation: tuple[float, float] = (math.inf, math.inf)
    bend: float = 0.0
    bend_deviation: float = math.inf

    @property
    def found(self) -> bool:
        """True if the focal length was found in the images."""
        return self.source == SELF_CALIBRATED

    @property
    def kept(self) -> FocalGuess | None:
        """Guess that was kept, for :meth:`dvo.data.source.Source.recalibrated`; None if a focal length was found."""
        return None if self.found else self.guess

    @property
    def calibration(self) -> Calibration:
        """Square pixels, the principal point at the centre and no distortion, or what was found of them."""
        return replace(simple_camera(self.focal, self.aside, self.bend, self.width, self.height), was_found=True)

    def __str__(self) -> str:
        """Sentence for people."""
        value = f"{self.focal:.0f} +- {self.deviation:.0f} px"
        if self.found:
            told = f"focal length {value} (self-calibrated from {self.frames} frames)"
            return told + self._distortion() + self._principal_point()
        origin = {"prior": "the usual angle of view", "exif": "EXIF data", "video": "metadata of the video"}
        return f"focal length: cannot tell ({self.reason}): keeps {value}, from {origin.get(self.source, self.source)}"

    def _distortion(self) -> str:
        """Further line for a lens with distortion; empty for one without."""
        if not self.bend:
            return ""
        return f"\nbarrel distortion: eucm, alpha {self.bend:.2f} +- {self.bend_deviation:.2f}, beta 1"

    def _principal_point(self) -> str:
        """Further line for a principal point of which a coordinate was found; empty for one at the centre."""
        if not any(map(math.isfinite, self.aside_deviation)):
            return ""
        c = self.calibration
        words = [
            f"{name} {value:.1f}" + (f" +- {deviation:.1f} px" if math.isfinite(deviation) else " px, the centre")
            for name, value, deviation in zip(("cx", "cy"), (c.cx, c.cy), self.aside_deviation, strict=True)
        ]
        return f"\nprincipal point {', '.join(words)}"

    def write(self, file: Path | str) -> bool:
        """Write a calibration file for the next run, unless a file that somebody else has written is in its place.

        A guess that was kept is not written: the next run would take it for a calibration.

        Args:
            file: text file, ``fx fy cx cy``, or YAML for a lens with distortion.

        Returns:
            Whether it was written.

        Raises:
            OSError: it cannot be written.
        """
        if not self.found or is_foreign(Path(file)):
            return False
        c = self.calibration
        with replaced(Path(file)) as part:
            told = str(self).replace("\n", "\n# ")
            line = f"{c.fx:.3f} {c.fy:.3f} {c.cx:.1f} {c.cy:.1f}\n"
            if self.bend:
                names = zip(("fx", "fy", "cx", "cy"), line.split(), strict=True)
                line = "".join(f"{name}: {value}\n" for name, value in names)
                line += f"model: {c.model}\nalpha: {self.bend:.4f}\nbeta: 1\n"
            part.write_text(f"{FOUND_BY_DVO}# {told}\n{line}", encoding="utf-8")
        return True


def is_foreign(file: Path) -> bool:
    """True for a file that :meth:`SelfCalibration.write` has not written.

    Args:
        file: may be missing.
    """
    if not file.exists():
        return False
    with file.open("rb") as stream:
        return stream.read(len(FOUND_BY_DVO)) != FOUND_BY_DVO.encode()


def simple_camera(focal: float, aside: tuple[float, float], bend: float, width: int, height: int) -> Calibration:
    """Calibration with square pixels, without distortion or with that of one number.

    Args:
        focal: fx and fy, pixels.
        aside: way from the middle of the image to the principal point, to the right and down, pixels.
        bend: alpha of the model ``eucm`` with a beta of 1; 0 for none.
        width, height: of the images, pixels.
    """
    middle = centred(focal, width, height)
    found = replace(middle, cx=middle.cx + aside[0], cy=middle.cy + aside[1])
    return replace(found, model="eucm", coefficients=(bend, 1.0)) if bend else found
