"""Specifications of a rendered sequence: format, scene, motion and camera, each a small frozen dataclass.

Configuration files and keyword arguments name the settings flat (``frames``, ``family``, ``speed``, ``shutter``...);
:func:`sequence_spec` is the one place that sorts them into the specifications.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.settings import shown
from dvo.geometry.camera import DistortionModel
from dvo.synth.surroundings import check_surroundings

MOST_FRAMES = 100_000
LONGEST = 3600.0  # seconds; planning the path of an hour takes minutes
LONGEST_EDGE = 8192  # pixels
MOST_RAYS = 2**25  # of a frame; about 100 bytes each while it is rendered


@dataclass(frozen=True)
class SequenceFormat:
    """Length, image size and frame rate.

    Args:
        frames: number of frames.
        height, width: image size, pixels.
        fps: frames per second.
        supersample: rays per pixel edge for the colours.

    Raises:
        DvoError: no frame or more than :data:`MOST_FRAMES`; an image below 16x16 pixels, with an edge above
            :data:`LONGEST_EDGE` or with more than :data:`MOST_RAYS` rays; a rate that is not positive; a sequence of
            more than :data:`LONGEST` seconds.
    """

    frames: int = 300
    height: int = 240
    width: int = 320
    fps: float = 30.0
    supersample: int = 1

    def __post_init__(self) -> None:
        _check_number("frames", self.frames, 1, MOST_FRAMES, whole=True)
        _check_number("height", self.height, 16, LONGEST_EDGE, whole=True)
        _check_number("width", self.width, 16, LONGEST_EDGE, whole=True)
        _check_number("supersample", self.supersample, 1, 16, whole=True)
        _check_number("fps", self.fps, 0.001, 100_000)
        rays = self.height * self.width * self.supersample**2
        if rays > MOST_RAYS:
            message = f"too large: {rays:,} rays for a frame, {MOST_RAYS:,} at most"
            raise DvoError(message, field="height, width", remedy="give a smaller image or fewer rays per pixel")
        if self.duration > LONGEST:
            message = f"too long: {self.duration:,.0f} s, {LONGEST:,.0f} s at most"
            raise DvoError(message, field="frames, fps", remedy="give fewer frames or a higher rate")

    @property
    def duration(self) -> float:
        """Length in seconds."""
        return self.frames / self.fps


@dataclass(frozen=True)
class SceneSpec:
    """Choice of a scene and of its appearance.

    Args:
        family: name in ``dvo.synth.FAMILIES``; drawn from the training families if None.
        texture: share of the textures' contrast that is kept, in [0, 1]; small values give bare walls.
        movers: number of moving bodies.
        apart: take a scene seed that training clips never draw (``dvo.synth.sequence.APART`` or above).
        surroundings: names in ``dvo.synth.surroundings.SURROUNDINGS`` that are drawn over the scene in this order,
            joined by ``+`` (``sky+water``); empty for none.
        textures: folder of photographs to use as textures; those shipped with scikit-image if None.

    Raises:
        DvoError: a number out of range.
    """

    family: str | None = None
    texture: float = 1.0
    movers: int = 0
    apart: bool = False
    surroundings: str = ""
    textures: str | None = None

    def __post_init__(self) -> None:
        check_share("texture", self.texture)
        _check_number("movers", self.movers, 0, 1000, whole=True)
        check_surroundings(self.surroundings)


@dataclass(frozen=True)
class MotionSpec:
    """Choice of a camera path.

    Args:
        kind: one of ``dvo.synth.LONG_KINDS`` or ``dvo.synth.NATURAL_KINDS``; if None, a drive in streets and corridors
            and a hand-held walk elsewhere.
        speed: relative to a relaxed pace.
        shake: factor on the amplitude of the hand's shake.

    Raises:
        DvoError: a number out of range.
    """

    kind: str | None = None
    speed: float = 1.0
    shake: float = 1.0

    def __post_init__(self) -> None:
        _check_number("speed", self.speed, 0, 1000)
        _check_number("shake", self.shake, 0, 1000)


@dataclass(frozen=True)
class CameraSpec:
    """Camera effects. The sensor's other parameters (noise, vignetting, gamma...) are drawn from the seed.

    Args:
        sensor: False gives clean renderings: no noise, and none of the effects below except ``lens``.
        shutter: share of the frame interval during which light is gathered (motion blur along the path).
        rolling_shutter: share of the frame interval that reading the rows takes.
        lighting: strength of exposure changes (drifts and sudden jumps), stops.
        light: share of the usual light that arrives, in (0, 1]; the camera amplifies it together with the noise.
        blackout: seconds without light in the middle of the sequence.
        drop: probability that a frame is lost.
        jpeg: JPEG quality from 1 to 100, 0 for no compression.
        h264: constant rate factor of H.264 from 1 to 51, the higher the fewer bits, 0 for no compression.
        stabilised: standard deviation of the offset at which the crop of a stabilised video floats, share of the width.
        lens: ``radtan`` or ``fisheye`` draws a lens with distortion; frames are delivered distorted.

    Raises:
        DvoError: a number out of range.
    """

    sensor: bool = True
    shutter: float = 0.0
    rolling_shutter: float = 0.0
    lighting: float = 0.0
    light: float = 1.0
    blackout: float = 0.0
    drop: float = 0.0
    jpeg: int = 0
    h264: int = 0
    stabilised: float = 0.0
    lens: DistortionModel = "none"

    def __post_init__(self) -> None:
        for name in ("shutter", "rolling_shutter", "light", "drop"):
            check_share(name, getattr(self, name))
        _check_range("light", self.light > 0)
        _check_number("lighting", self.lighting, 0, 20)
        _check_number("blackout", self.blackout, 0, LONGEST)
        _check_number("jpeg", self.jpeg, 0, 100, whole=True)
        _check_number("h264", self.h264, 0, 51, whole=True)
        _check_number("stabilised", self.stabilised, 0, 0.1)


@dataclass(frozen=True)
class SequenceSpec:
    """Everything that a sequence is made from, except seed and device.

    Args:
        format: length, size and rate.
        scene: scene and appearance.
        motion: camera path.
        camera: camera effects.

    Raises:
        DvoError: a blackout that lasts as long as the sequence.
    """

    format: SequenceFormat = field(default_factory=SequenceFormat)
    scene: SceneSpec = field(default_factory=SceneSpec)
    motion: MotionSpec = field(default_factory=MotionSpec)
    camera: CameraSpec = field(default_factory=CameraSpec)

    def __post_init__(self) -> None:
        _check_range("blackout", self.camera.blackout < self.format.duration)


def sequence_spec(base: SequenceSpec | None = None, **options: Any) -> SequenceSpec:
    """Specification from flat option names, as configuration files have them.

    Args:
        base: specification that supplies the options not given; the defaults if None.
        options: fields of :class:`SequenceFormat`, :class:`SceneSpec`, :class:`MotionSpec` and :class:`CameraSpec`.

    Returns:
        The specification.

    Raises:
        DvoError: an unknown name, or a number out of range.

    Example:
        >>> sequence_spec(frames=60, family="room", kind="handheld", shutter=0.5).motion
        MotionSpec(kind='handheld', speed=1.0, shake=1.0)
    """
    base = base or SequenceSpec()
    parts = {part.name: getattr(base, part.name) for part in fields(SequenceSpec)}
    owner = {option.name: name for name, part in parts.items() for option in fields(part)}
    check_names(options, owner)
    changed = {
        name: replace(part, **{option: value for option, value in options.items() if owner[option] == name})
        for name, part in parts.items()
    }
    return SequenceSpec(**changed)


def check_names(options: dict[str, Any], known: Iterable[str]) -> None:
    """Reject options of unknown name.

    Args:
        options: by name.
        known: names that exist.

    Raises:
        DvoError: an unknown name.
    """
    names = sorted(known)
    unknown = sorted(set(options) - set(names))
    if unknown:
        remedy = f"use one of {', '.join(names)}"
        raise DvoError(f"no rendering option '{unknown[0]}'", field=unknown[0], remedy=remedy)


def _check_number(name: str, value: float, low: float, high: float, whole: bool = False) -> None:
    number = isinstance(value, numbers.Integral if whole else numbers.Real) and not isinstance(value, bool)
    if not number or not low <= value <= high:  # NaN fails too
        kind = "a whole number" if whole else "a number"
        raise DvoError(f"out of range: {shown(value)}", field=name, remedy=f"give {kind} from {low:g} to {high:g}")


def check_share(name: str, value: float) -> None:
    """Check a share or a probability.

    Args:
        name: of the setting.
        value: of the setting.

    Raises:
        DvoError: not a number from 0 to 1.
    """
    if not isinstance(value, numbers.Real) or not 0 <= value <= 1:
        raise DvoError(f"not a share: {shown(value)}", field=name, remedy="give a number from 0 to 1")


def _check_range(name: str, valid: bool) -> None:
    if not valid:
        raise DvoError("out of range", field=name, remedy="see dvo.synth.specs for its range")
