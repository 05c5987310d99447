"""Gate of an odometry: what each frame has to pass, and what is known of it before anything is measured.

Every odometry of this package asks the same of its frames, in the same order: the sequence is not finished, the frame
is valid, has no lens distortion, follows the frame before it in time and has its size; then, whether its image repeats
that of the frame before it, whether there is a gap in time, and whether the image shows anything.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.geometry.camera import Camera

RECENT = 30
"""Number of intervals that the usual one is the median of."""
_USUAL = ((6, 2), (RECENT, 3))  # among so many of the newest intervals, so many half as long make a long one usual
_MULTIPLE = 8  # of which the sides of a working image are

MASK_MARGIN = 12
"""Distance from ignored pixels within which nothing is measured: the size of a patch of three feature pixels, at a
quarter of the resolution."""
MASKED = "masked image"
"""Reason of a loss of a frame of which its mask leaves too little."""

_BLOCK = 8  # side of the blocks whose means show structure, pixels of the working image
_CONTRAST = 2.5  # least difference of neighbouring blocks that counts as structure without noise, grey levels
_NOISE = 6.0  # and its share of the expected difference of blocks of independent noise
_STRONG_NOISE = 10.0  # difference of neighbouring pixels that sensor noise stays below, grey levels
_DARK, _BRIGHT = 64.0, 192.0
_LEAST_USED = 0.05  # share of the pixels that a mask leaves, beside a margin


@dataclass(frozen=True)
class Gap:
    """Time without a new image.

    Attributes:
        seconds: its length.
        frozen: frames were there, but with an old image.
        reason: why its length is not known; empty where it is.
    """

    seconds: float
    frozen: bool
    reason: str = ""

    def __str__(self) -> str:
        if self.reason:
            return self.reason
        return f"image frozen for {self.seconds:.2f} s" if self.frozen else f"gap of {self.seconds:.2f} s"


@dataclass(frozen=True)
class RequiredSize:
    """Size of the working images of the map that a recording is tracked in.

    Attributes:
        size: width and height.
        pixels: of the working images of the recording, see :func:`dvo.odometry.frames.gate.working_size`.
    """

    size: tuple[int, int]
    pixels: int

    def check(self, frame: Frame) -> None:
        """Check the working size of the first frame.

        Args:
            frame: the frame.

        Raises:
            DvoError: it is another one.
        """
        height, width = frame.image.shape[:2]
        found = working_size(width, height, self.pixels)
        if found != self.size:
            wanted = "x".join(map(str, self.size))
            raise DvoError(
                f"a working image of {found[0]}x{found[1]} from {width}x{height}, the images of the map are {wanted}",
                field=f"frame {frame.index}",
                remedy=f"give a recording of the same aspect and at least that size, or pixels={math.prod(self.size)}",
            )


class FrameSequence:
    """Order, size and intervals of the frames of a sequence.

    Args:
        max_gap: time without an image above which two images are separated by a gap, in medians of the recent
            intervals. Time in which images were received and dropped (:attr:`dvo.data.frame.Frame.silence`) is none,
            and neither is an interval as there have been two among the newest six, or three among the newest thirty:
            frames are taken at irregular times, or the rate has changed.

    Attributes:
        required: size of the working images, if a map demands one.

    Example:
        >>> sequence = FrameSequence(max_gap=4)
        >>> [str(sequence.tick(time) or "") for time in (0.0, 0.1, 0.2, 5.2)]
        ['', '', '', 'gap of 5.00 s']
    """

    def __init__(self, max_gap: float) -> None:
        self.max_gap = max_gap
        self.required: RequiredSize | None = None
        self._intervals: deque[float] = deque(maxlen=RECENT)
        self._size: tuple[int, int] | None = None
        self._last: float | None = None  # time of the last frame
        self._new = 0.0  # time of the first frame with the image of the last one

    def check(self, frame: Frame) -> None:
        """Check that a frame continues the sequence.

        Args:
            frame: the next frame.

        Raises:
            DvoError: a timestamp that does not increase, or an image of another size than the first.
        """
        if self._last is not None and frame.timestamp <= self._last:
            raise DvoError(
                f"time {frame.timestamp} does not come after {self._last}",
                field=f"frame {frame.index}",
                remedy="give frames in order of time",
            )
        size = (frame.image.shape[1], frame.image.shape[0])
        if self._size not in (None, size):
            raise DvoError(
                f"is {size[0]}x{size[1]}, the frames before are {self._size[0]}x{self._size[1]}",
                field=f"frame {frame.index}",
                remedy="give frames of one size",
            )
        if self._size is None and self.required is not None:
            self.required.check(frame)
        self._size = size

    def tick(self, time: float, interruption: str = "", silence: float | None = None) -> Gap | None:
        """Record a frame with a new image.

        Args:
            time: seconds.
            interruption: why the time since the frame before is not known; empty where it is.
            silence: longest time since the frame before without an image, seconds, where some were dropped.

        Returns:
            Gap since the image before it was first seen; None if there is none.
        """
        last, new, self._last, self._new = self._last, self._new, time, time
        if last is None:
            return None
        if interruption:
            return Gap(time - last, frozen=False, reason=interruption)
        usual = median(self._intervals) if len(self._intervals) > 1 else None
        quiet, frozen = _quiet(time - last, silence), last - new
        alike = [2 * interval >= quiet for interval in self._intervals]
        is_usual = any(sum(alike[-newest:]) >= count for newest, count in _USUAL)
        self._intervals.append(quiet)
        if usual is None or quiet + frozen <= self.max_gap * usual:
            return None
        if quiet > self.max_gap * usual and not is_usual:
            return Gap(quiet, frozen=False)
        return Gap(frozen, frozen=True) if frozen > 0 else None

    def repeat(self, time: float, silence: float | None = None) -> None:
        """Record a frame with the image of the frame before it.

        Args:
            time: seconds.
            silence: as of :meth:`tick`.
        """
        if self._last is not None:
            self._intervals.append(_quiet(time - self._last, silence))
        self._last = time


def _quiet(interval: float, silence: float | None) -> float:
    """Time without an image between two frames."""
    return interval if silence is None else min(max(silence, 0.0), interval)


@dataclass(frozen=True)
class Admitted:
    """Frame that has passed a gate.

    Attributes:
        frame: checked; depth, right image and inertial samples are not read yet.
        image: ``(h, w, 3)`` uint8 RGB working image.
        camera: of the working image.
        mask: ``(h, w)`` bool, pixels that count; None for all.
        repeated: the image is that of the frame before it.
        gap: time without a new image before it; None if there is none, or for a repeated image.
        problem: why the image shows nothing, such as ``"black image"``; empty for an image with content.
    """

    frame: Frame
    image: np.ndarray
    camera: Camera
    mask: np.ndarray | None
    repeated: bool
    gap: Gap | None
    problem: str

    @property
    def timestamp(self) -> float:
        """Time of the frame, seconds."""
        return self.frame.timestamp


class Gate:
    """Admission of the frames of one sequence, for any odometry.

    Args:
        pixels: of the working image, see :func:`dvo.odometry.frames.gate.working_size`; None for the image as
            it is given.
        max_gap: see :class:`FrameSequence`.
        masks: whether the odometry uses masks; otherwise a frame with one is refused.

    Attributes:
        sequence: order, size and intervals of the frames.
        finished: no frame is admitted any more.

    Example:
        >>> from dvo.geometry.camera import Camera
        >>> gate = Gate(pixels=None)
        >>> image, camera = np.zeros((48, 64, 3), np.uint8), Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
        >>> for index in range(2):
        ...     with gate.admit(Frame(index, 0.1 * index, image, camera)) as admitted:
        ...         print(admitted.problem, admitted.repeated)
        black image False
        black image True
    """

    def __init__(self, pixels: int | None, max_gap: float = math.inf, *, masks: bool = False) -> None:
        self.pixels, self.masks = pixels, masks
        self.sequence = FrameSequence(max_gap)
        self.finished = False
        self._last: tuple[np.ndarray, str] | None = None  # image of the last frame, and its problem

    @contextmanager
    def admit(self, frame: Frame) -> Iterator[Admitted]:
        """Check the next frame, bring it to the working size, and process it in the body of the ``with`` statement.

        A frame whose processing raises has been seen by nobody: the one after it repeats no image.

        Args:
            frame: as given by the caller.

        Yields:
            The frame; of a repeated image with the problem that it had before.

        Raises:
            DvoError: a call after :meth:`finish`, a frame that :func:`dvo.data.frame_checks.checked_frame` refuses, a
                camera with lens distortion, a mask that the odometry does not use, a timestamp that does not increase,
                or an image of another size than the first.
        """
        if self.finished:
            raise DvoError("the sequence is finished", field="track()", remedy="build an odometry for each sequence")
        frame = checked_frame(frame)
        if frame.mask is not None and not self.masks:
            raise DvoError(
                "this odometry does not use masks", field="mask", remedy="use weights of patch_vo, or no mask"
            )
        image, camera, mask = working_image(frame, self.pixels)
        self.sequence.check(frame)
        repeated, gap = self._last is not None and np.array_equal(image, self._last[0]), None
        if repeated:
            self.sequence.repeat(frame.timestamp, frame.silence)
        else:
            gap = self.sequence.tick(frame.timestamp, frame.interruption, frame.silence)
            self._last = image, missing_content(image, mask)
        assert self._last is not None
        try:
            yield Admitted(frame, image, camera, mask, repeated=repeated, gap=gap, problem=self._last[1])
        except BaseException:
            self._last = None
            raise

    def finish(self) -> bool:
        """Admit no frame from now on.

        Returns:
            True on the first call.
        """
        begun, self.finished = not self.finished, True
        return begun


def working_size(width: int, height: int, pixels: int) -> tuple[int, int]:
    """Size of the working image; larger than the image at most by the rounding.

    Args:
        width, height: of the image.
        pixels: number of pixels to aim for; 0 keeps the size up to the rounding.

    Returns:
        Width and height, multiples of 8 and at least 32, of nearly the same aspect.
    """
    scale = 1.0 if pixels <= 0 else min(1.0, math.sqrt(pixels / (width * height)))
    return tuple(max(_MULTIPLE * 4, _MULTIPLE * round(side * scale / _MULTIPLE)) for side in (width, height))  # type: ignore[return-value]


def working_image(frame: Frame, pixels: int | None) -> tuple[np.ndarray, Camera, np.ndarray | None]:
    """Resize a frame by area resampling, and its mask by the nearest pixels.

    Args:
        frame: checked, without lens distortion.
        pixels: see :func:`working_size`; None for the image as it is.

    Returns:
        ``(h, w, 3)`` uint8 RGB image, its camera, and its ``(h, w)`` bool mask, None without one.

    Raises:
        DvoError: the frame's camera has distortion, which the odometries do not model.
    """
    if frame.camera.needs_undistortion:
        raise DvoError(
            f"frames with {frame.camera.model} distortion cannot be tracked",
            field="camera",
            remedy="undistort them first: dvo.geometry.undistort.Undistorter, or dvo.open, which does this",
        )
    given = frame.camera.width, frame.camera.height
    width, height = given if pixels is None else working_size(*given, pixels)
    if (width, height) == given:
        # Copies: a caller may use its buffers for the next frame.
        mask = None if frame.mask is None else np.array(frame.mask, order="C")
        return np.array(frame.image, order="C"), frame.camera, mask
    image = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    camera = frame.camera.resized(width, height)
    if frame.mask is None:
        return image, camera, None
    return image, camera, cv2.resize(frame.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0


def missing_content(image: np.ndarray, mask: np.ndarray | None = None) -> str:
    """Find out if an image shows nothing: its blocks differ no more than those of uniform light and sensor noise would.

    Noise is estimated from the median difference of neighbouring pixels. The mean of an ``8x8`` block averages
    independent noise to an eighth, while differences of a view grow with the distance. Strong noise could be a fine
    texture; only the measurements in several images tell them apart.

    Args:
        image: ``(H, W, 3)`` uint8 RGB working image.
        mask: ``(H, W)`` bool, the only pixels that are looked at; None for all. If less than a twentieth of them is
            left beside a margin, the image is masked.

    Returns:
        Description, such as ``"black image"``; empty for an image with content.

    Example:
        >>> missing_content(np.zeros((240, 320, 3), np.uint8))
        'black image'
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if mask is not None:
        return _missing_in_mask(grey, mask)
    height, width = (max(2, side // _BLOCK) for side in grey.shape)
    blocks = cv2.resize(grey.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    steps = np.concatenate([np.abs(np.diff(blocks, axis=axis)).ravel() for axis in (0, 1)])
    structure = float(np.percentile(steps, 99))
    noise = float(np.median(cv2.absdiff(grey[::4, 1:], grey[::4, :-1])))
    return _judged(structure, noise, float(blocks.mean()))


def _missing_in_mask(grey: np.ndarray, mask: np.ndarray) -> str:
    """Description of an image of which a part is used, as :func:`missing_content`: by the blocks that lie in it."""
    margin = np.ones((2 * MASK_MARGIN + 1,) * 2, np.uint8)
    if cv2.erode(mask.astype(np.uint8), margin).mean() < _LEAST_USED:
        return MASKED
    height, width = (max(2, side // _BLOCK) for side in grey.shape)
    share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    blocks = cv2.resize(grey * mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    blocks = np.where(share > 0.5, blocks / np.maximum(share, 0.5), np.nan)
    steps = np.concatenate([np.abs(np.diff(blocks, axis=axis)).ravel() for axis in (0, 1)])
    pairs = mask[::4, 1:] & mask[::4, :-1]
    if not (np.isfinite(steps).any() and pairs.any()):
        return MASKED
    noise = float(np.median(cv2.absdiff(grey[::4, 1:], grey[::4, :-1])[pairs]))
    return _judged(float(np.nanpercentile(steps, 99)), noise, float(np.nanmean(blocks)))


def _judged(structure: float, noise: float, mean: float) -> str:
    """Description of an image by the differences of its blocks and of its pixels, and its brightness."""
    if noise > _STRONG_NOISE or structure > _CONTRAST + _NOISE * noise / _BLOCK:
        return ""
    return "black image" if mean < _DARK else "white image" if mean > _BRIGHT else "image without content"
