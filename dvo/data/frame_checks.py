"""Checks of the frames that enter an odometry, and harmless conversions of their images and masks."""

from __future__ import annotations

import copy
import math
import operator
import sys
import warnings
from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import MAX_NUMBER
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera

_CHANNELS = (1, 3, 4)
_HALF_LEVEL = 0.5 / 255  # excess over 0..1, as resampling leaves it, that rounds to the same grey level
_TWELVE_BITS = 4096
_PIL_MODES = ("L", "RGB", "RGBA", "F", "I")  # np.asarray gives their pixels; so it does for the modes I;16
_FORMS = "give (H, W, 3) RGB or (H, W) grey"
_REMEDY_TYPE = "give uint8 (0..255), uint16 (0..65535) or float (0..1)"
_warned: set[str] = set()  # warnings that this process has given


def checked_frame(frame: Frame) -> Frame:
    """Check a frame, and convert its image to ``(H, W, 3)`` uint8 RGB where nothing is lost by it.

    Converted are grey and RGBA images (alpha is dropped), uint16 (divided by 257, rounded), floats in 0..1 (times 255,
    rounded), any memory layout, PIL images, torch tensors on any device (also ``(C, H, W)`` where the shape leaves no
    doubt) and other objects with ``__array__``. A mask becomes bool. Depth, right
    image and inertial samples are neither read nor checked.

    Args:
        frame: as given by the caller.

    Returns:
        The frame itself if there is nothing to convert, otherwise a copy with another image, time or mask.

    Raises:
        DvoError: an object that is not a frame; an index that is not a whole number; a time that is not a finite
            number, or above 1e12; an interruption that is no text, or a silence that is no number of seconds; an image
            of another form or type, without pixels, or with values not finite or out of range; no camera, or one of
            another image size; a mask of another type or size. Names the frame and the field.

    Example:
        >>> import numpy as np
        >>> camera = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
        >>> checked_frame(Frame(0, 0.0, np.ones((48, 64), np.float32), camera)).image[0, 0].tolist()
        [255, 255, 255]
    """
    if not isinstance(frame, Frame):
        raise DvoError(
            f"expected a dvo.Frame, got {_kind(frame)}",
            field="frame",
            remedy="give dvo.Frame(index, timestamp, image, camera)",
        )
    name = _name(frame.index)
    if not isinstance(frame.interruption, str):
        remedy = "give the reason, or an empty text"
        raise DvoError(
            f"expected a text, got {_kind(frame.interruption)}", field=f"{name}: interruption", remedy=remedy
        )
    if frame.silence is not None and _seconds(frame.silence, f"{name}: silence") < 0:
        raise DvoError(f"{frame.silence} is negative", field=f"{name}: silence", remedy="give seconds, or None")
    timestamp = _seconds(frame.timestamp, f"{name}: timestamp")
    image = checked_image(frame.image, frame.camera, name)
    mask = checked_mask(frame.mask, image.shape[0], image.shape[1], f"{name}: mask")
    if image is frame.image and timestamp is frame.timestamp and mask is frame.mask:
        return frame
    converted = copy.copy(frame)  # dataclasses.replace would load depth, right image and inertial samples
    object.__setattr__(converted, "image", image)
    object.__setattr__(converted, "timestamp", timestamp)
    object.__setattr__(converted, "mask", mask)
    return converted


def checked_image(image: Any, camera: Any, name: str) -> np.ndarray:
    """Check and convert the image of a frame as :func:`checked_frame` does.

    Args:
        image: as given by the caller.
        camera: of the image.
        name: of the frame, for messages.

    Returns:
        ``(H, W, 3)`` uint8 RGB, contiguous and writable; the image itself if it is that.

    Raises:
        DvoError: as :func:`checked_frame`, of the image and the camera.
    """
    if _is_ready(image):
        _check_camera(camera, image, name)
        return image
    pixels = _with_channels(_array_of(image, f"{name}: image"), f"{name}: image")
    _check_camera(camera, pixels, name)  # before the conversion, which needs memory for all pixels
    return _rgb8(pixels, f"{name}: image")


def checked_mask(mask: Any, height: int, width: int, field: str) -> np.ndarray | None:
    """Check the mask of a frame.

    Args:
        mask: ``(H, W)`` bool or uint8, 0 for pixels to ignore; None for none.
        height, width: of the image.
        field: for messages.

    Returns:
        ``(H, W)`` bool, True for pixels to use.

    Raises:
        DvoError: another type or size.
    """
    if mask is None:
        return None
    if not isinstance(mask, np.ndarray) or mask.dtype not in (np.bool_, np.uint8):
        kind = f"an array of {mask.dtype}" if isinstance(mask, np.ndarray) else _kind(mask)
        raise DvoError(f"expected a bool or uint8 array, got {kind}", field=field, remedy="give (H, W), 0: ignore")
    if mask.shape != (height, width):
        message = f"has the shape {mask.shape}, the image ({height}, {width})"
        raise DvoError(message, field=field, remedy="give a mask of the size of the image")
    return mask if mask.dtype == np.bool_ else mask != 0


def _name(index: Any) -> str:
    try:
        return f"frame {operator.index(index)}"
    except TypeError:
        raise DvoError(
            f"expected a whole number, got {_kind(index)}", field="frame: index", remedy="number the frames from 0"
        ) from None


def _seconds(time: Any, field: str) -> float:
    remedy = "give the time in seconds, for instance index / fps"
    # NumPy counts time differences among the whole numbers, but their unit is not known to be seconds.
    if isinstance(time, bool | np.timedelta64) or not isinstance(time, Real):
        raise DvoError(f"expected a number of seconds, got {_kind(time)}", field=field, remedy=remedy)
    try:
        seconds = time if isinstance(time, float) else float(time)
    except OverflowError:
        seconds = float("inf")
    if not math.isfinite(seconds):
        raise DvoError(f"{seconds} is not finite", field=field, remedy=remedy)
    if abs(seconds) > MAX_NUMBER:
        message = f"{seconds:.6g} is no number of seconds, as if it were a date in milliseconds or a finer unit"
        raise DvoError(message, field=field, remedy="divide milliseconds by 1e3, nanoseconds by 1e9")
    return seconds


def _check_camera(camera: Any, image: np.ndarray, name: str) -> None:
    remedy = "give dvo.Camera(fx, fy, cx, cy, width, height) of this image"
    if not isinstance(camera, Camera):
        raise DvoError(f"expected a dvo.Camera, got {_kind(camera)}", field=f"{name}: camera", remedy=remedy)
    height, width = image.shape[:2]
    if (camera.width, camera.height) != (width, height):
        raise DvoError(
            f"is of a {camera.width}x{camera.height} image, but the image is {width}x{height} (width x height)",
            field=f"{name}: camera",
            remedy=f"give the camera of the {width}x{height} image, for instance camera.resized({width}, {height})",
        )


def _is_ready(image: Any) -> bool:
    """True if an odometry takes the image as it is: contiguous, and writable for ``torch.from_numpy``."""
    return (
        type(image) is np.ndarray
        and image.dtype == np.uint8
        and image.ndim == 3
        and image.shape[2] == 3
        and image.size > 0
        and image.flags.carray
    )


def _rgb8(pixels: np.ndarray, field: str) -> np.ndarray:
    """``(H, W, 3)`` uint8 RGB image, contiguous and writable, of ``(H, W, C)`` pixels."""
    levels = _levels(pixels[..., :3], field)
    if levels.shape[2] == 1:
        levels = np.repeat(levels, 3, axis=2)
    return np.require(levels, requirements=["C", "W"])


def _array_of(image: Any, field: str) -> np.ndarray:
    """NumPy array of the pixels of an image."""
    if isinstance(image, np.ndarray):
        return np.asarray(image)
    torch, pil = sys.modules.get("torch"), sys.modules.get("PIL.Image")
    if torch is not None and isinstance(image, torch.Tensor):
        return _converted(lambda: _array_of_tensor(image), image, field)
    if pil is not None and isinstance(image, pil.Image):
        direct = image.mode in _PIL_MODES or image.mode.startswith("I;16")
        return _converted(lambda: np.asarray(image if direct else image.convert("RGB")), image, field)
    if hasattr(image, "__array__"):
        return _converted(lambda: np.asarray(image), image, field)
    raise DvoError(
        f"expected an array, got {_kind(image)}", field=field, remedy=f"{_FORMS}, a numpy array of uint8 (0..255)"
    )


def _array_of_tensor(image: Any) -> np.ndarray:
    """Array of a torch tensor, with the channels last.

    Args:
        image: tensor on any device, ``(H, W)``, ``(H, W, C)``, or ``(C, H, W)`` where the shape leaves no doubt.
    """
    image = image.detach()
    if image.is_floating_point():
        image = image.float()  # NumPy has no bfloat16
    array = image.cpu().numpy()
    if array.ndim == 3 and array.shape[0] in _CHANNELS and array.shape[2] not in _CHANNELS:
        return array.transpose(1, 2, 0)
    return array


def _converted(convert: Callable[[], np.ndarray], image: Any, field: str) -> np.ndarray:
    try:
        return convert()
    except Exception as error:  # the conversion is code of another package, or of the user
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DvoError(
            f"{_kind(image)} cannot be read as an array ({reason[:200]})",
            field=field,
            remedy=f"{_FORMS}, a numpy array of uint8 (0..255)",
        ) from error


def _with_channels(pixels: np.ndarray, field: str) -> np.ndarray:
    """``(H, W, C)`` view of an image, of one, three or four channels."""
    shape = " x ".join(map(str, pixels.shape)) or "a single number"
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim == 3 and pixels.shape[2] in _CHANNELS:
        if 0 in pixels.shape:
            raise DvoError(f"has no pixels ({shape})", field=field, remedy=_FORMS)
        return pixels
    remedy = _FORMS
    if pixels.ndim == 3 and pixels.shape[0] in _CHANNELS:
        remedy += "; if the channels come first, image.transpose(1, 2, 0)"
    elif pixels.ndim == 4 and pixels.shape[0] == 1:
        remedy += "; of a batch of one, image[0]"
    raise DvoError(f"is no image of 1, 3 or 4 channels ({shape})", field=field, remedy=remedy)


def _levels(pixels: np.ndarray, field: str) -> np.ndarray:
    """Grey levels 0..255 of an array of pixels, uint8."""
    kind, size = pixels.dtype.kind, pixels.dtype.itemsize
    if kind == "u" and size == 1:
        return pixels
    if kind == "u" and size == 2:
        _warn_if_twelve_bits(int(pixels.max()), field)
        return ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if kind == "f":
        return _of_floats(pixels, field)
    remedy = _REMEDY_TYPE
    if kind in "iu":
        remedy += "; image.astype(np.uint8) if all values lie in 0..255"
    elif kind == "b":
        remedy += "; a mask is no image"
    raise DvoError(f"has pixels of type {pixels.dtype}", field=field, remedy=remedy)


def _of_floats(pixels: np.ndarray, field: str) -> np.ndarray:
    lowest, highest = float(pixels.min()), float(pixels.max())  # nan if any value is
    if not (math.isfinite(lowest) and math.isfinite(highest)):
        count = int((~np.isfinite(pixels)).sum())
        raise DvoError(
            f"{count} of {pixels.size} values are not finite", field=field, remedy="replace nan and infinity"
        )
    if lowest < -_HALF_LEVEL or highest > 1 + _HALF_LEVEL:
        remedy = "scale them to 0..1"
        if lowest >= 0:
            remedy = "give uint8, or divide by 255" if highest <= 255 else "give uint16, or divide by 65535"
        raise DvoError(f"float values must lie in 0..1, got {lowest:.6g} to {highest:.6g}", field=field, remedy=remedy)
    levels = np.multiply(pixels, 255, dtype=np.float32, casting="same_kind")
    np.rint(levels, out=levels)
    return np.clip(levels, 0, 255, out=levels).astype(np.uint8)


def _warn_if_twelve_bits(highest: int, field: str) -> None:
    """Warn once per process of 16-bit images whose values end far below 65535 (a black image says nothing)."""
    if 0 < highest < _TWELVE_BITS and "twelve bits" not in _warned:
        _warned.add("twelve bits")
        warnings.warn(
            f"{field}: uint16 values up to {highest} only; they are taken as 0..65535, so the image gets dark. "
            "Multiply 12-bit data by 16, 10-bit data by 64.",
            stacklevel=6,
        )


def _kind(value: Any) -> str:
    return "None" if value is None else f"an object of type {type(value).__name__}"
