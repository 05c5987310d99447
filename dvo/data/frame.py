"""Frame: one image with its time and camera, and what other sensors measured at that time."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from dvo.data.inertial import InertialSamples
from dvo.geometry.camera import Camera

T = TypeVar("T")


@dataclass(frozen=True)
class StereoView:
    """Image of the right camera of a stereo pair, exposed together with the frame's own image.

    The pair is rectified only if the data set is (KITTI, TartanAir): undistortion alone does not turn the cameras
    parallel (EuRoC).

    Attributes:
        image: ``(H, W, 3)`` uint8 RGB.
        camera: camera of exactly this image (same size).
        T_left_right: ``(7,)`` float64 ``tx ty tz qx qy qz qw``, right camera to left camera, metres: the translation is
            the centre of the right camera in the coordinates of the left one.
    """

    image: np.ndarray
    camera: Camera
    T_left_right: np.ndarray

    @property
    def baseline(self) -> float:
        """Distance between the two camera centres in metres."""
        return float(np.linalg.norm(self.T_left_right[:3]))


class Lazy(Generic[T]):
    """Optional field of a frozen dataclass that holds a value, or a function that is called when it is first read.

    Descriptor-typed field (see :mod:`dataclasses`); its default is None. ``dataclasses.replace`` and ``==`` read the
    field, and so load it.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._key = f"_{name}"

    def __get__(self, instance: Any, owner: type | None = None) -> T | None:
        if instance is None:  # dataclasses looks up the default
            return None
        value = instance.__dict__.get(self._key)
        if callable(value):
            value = value()
            instance.__dict__[self._key] = value
        return value

    def __set__(self, instance: Any, value: T | Callable[[], T | None] | None) -> None:
        instance.__dict__[self._key] = value


class LazyNumber(Lazy[float]):
    """:class:`Lazy` field of a number, whose default is not None.

    Args:
        default: value of an instance that is given none.
    """

    def __init__(self, default: float) -> None:
        self._default = default

    def __get__(self, instance: Any, owner: type | None = None) -> float:
        found = super().__get__(instance, owner)
        return self._default if found is None else found


@dataclass(frozen=True)
class Frame:
    """One image with its time and camera, and what other sensors measured at that time.

    Depth, right image and inertial samples are None where the source has none. Readers pass functions, so that a file
    is decoded only when the field is first read: an odometry that uses images alone pays nothing for them.

    Attributes:
        index: position in the source, counted from 0 before any stride.
        timestamp: seconds, float64.
        image: ``(H, W, 3)`` uint8 RGB.
        camera: camera of exactly this image (same size).
        depth: ``(H, W)`` float32 metres along the optical axis (Z, not the length of the ray) of the pixels of
            ``image``; nan where it is not known.
        right: view of the right camera of a stereo pair.
        inertial: samples later than the previous frame of the same pass, up to this frame's time; without samples for
            the first frame.
        mask: ``(H, W)`` bool or uint8, 0 (False) for pixels of ``image`` to ignore; None: all are used.
        interruption: why the time since the frame before it is not known, such as a clock that was set back; empty
            where it is.
        silence: where images between the frame before it and this one were received and dropped, the longest time in
            which none was received, seconds: a camera that goes on has no gap. None: none was dropped, and it is the
            time since the frame before it.

    Example:
        >>> camera = dvo.Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
        >>> image, depth = np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32)
        >>> frame = dvo.Frame(0, 0.0, image, camera, depth=depth)
        >>> frame.depth.shape, frame.right
        ((48, 64), None)
    """

    index: int
    timestamp: float
    image: np.ndarray
    camera: Camera
    depth: Lazy[np.ndarray] = Lazy()
    right: Lazy[StereoView] = Lazy()
    inertial: Lazy[InertialSamples] = Lazy()
    mask: np.ndarray | None = None
    interruption: str = ""
    silence: float | None = None

    def with_silence(self, seconds: float) -> Frame:
        """The frame after images that were dropped; depth, right image and inertial samples are not read for it.

        Args:
            seconds: see :attr:`silence`.
        """
        told = copy.copy(self)  # dataclasses.replace would load what is read at its first use
        object.__setattr__(told, "silence", seconds)
        return told
