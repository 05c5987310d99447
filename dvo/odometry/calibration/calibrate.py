"""Calibration of a camera from its own images: ``dvo.calibrate``.

The beginning of a clip is tracked with a guess of the focal length, which is then estimated from the measurements
(:mod:`dvo.odometry.global_ba.focal_length`); measurements made with a focal length far off are worse ones, so this is
repeated with what was found, as long as no more frames are tracked than the clip has, and a few. The motion may not
tell the focal length; then the guess is kept, and the result says so. The principal point is the middle of the image,
and the lens has no distortion, unless the measurements tell them closely.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, tee
from operator import length_hint
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dvo.core.arguments import checked_arguments
from dvo.core.context import in_own_context
from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.data.calibration.focal_guess import FocalGuess, guess_from_angle
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import Undistorter
from dvo.odometry.calibration.camera_estimate import SELF_CALIBRATED, SelfCalibration, simple_camera
from dvo.odometry.frames.fixed_pixels import Bars
from dvo.odometry.global_ba.focal_length import FocalProfile, find_focal
from dvo.odometry.global_ba.self_calibration import adjust_segments
from dvo.odometry.load import load
from dvo.odometry.patch.saving import closed_graph
from dvo.odometry.protocol import Estimate, Status

if TYPE_CHECKING:
    from dvo.odometry.patch.tracker import PatchOdometry

_MENDED = 5.0  # times the contrast of the round before: its measurements are of another kind
_LEFT = 0.5  # of a step of the focal length, at most, that the next round would take: measurements lean
_FARTHEST_ASIDE = 0.1  # principal points further from the middle, in longer sides of the image, are not believed
_RANGES = {
    "frames": (3, 10**6),
    "rounds": (1, 100),
    "spare": (0, 10**6),
    "interval": (0, 1e6),
    "settled": (0, 10),
    "min_contrast": (0, 100),
    "max_deviation": (0, 10),
    "inflation": (1, 1000),
    "floor": (0, 1),
    "max_aside": (0, 1),
}


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of :func:`calibrate`.

    Attributes:
        frames: tracked frames that the focal length is estimated from. If they cannot tell it, as many more are added.
        rounds: times that they are tracked, at most.
        spare: frames that all rounds together track beyond as many as the clip has; of a clip whose length is not
            known any number.
        interval: seconds between frames, at least; of a faster camera frames are left out.
        settled: change of the logarithm of the focal length in a round below which it has settled; the principal point
            has, once it moves by less than ``max_aside``, and the bend of the lens, once it changes by less than twice
            this.
        min_contrast: increase of the cost at focal lengths a fifth off below which the motion does not tell.
        max_deviation: largest standard deviation of the logarithm of the focal length that is believed.
        inflation: factor of the standard deviation that the curvature of the cost gives; measurements of a patch in
            several frames share their errors.
        floor: standard deviation, of the logarithm, of what is not modelled (distortion).
        max_aside: largest standard deviation of a coordinate of the principal point that is believed, in longer sides
            of the image; otherwise it is the middle of the image, as with 0.

    Raises:
        DvoError: a value of another type or out of range.
    """

    frames: int = 120
    rounds: int = 4
    spare: int = 60
    interval: float = 0.03
    settled: float = 0.02
    min_contrast: float = 0.02
    max_deviation: float = 0.1
    inflation: float = 3.0
    floor: float = 0.02
    max_aside: float = 0.005

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


@partial(checked_arguments, skip=("seed",))
@in_own_context
def calibrate(
    frames: Iterable[Frame],
    guess: FocalGuess | None = None,
    *,
    weights: str = "small",
    device: torch.device | str = "cpu",
    seed: int = 0,
    options: CalibrationOptions = CalibrationOptions(),  # noqa: B008 (frozen)
    on_frame: Callable[[Frame, Estimate | None], None] | None = None,
    on_round: Callable[[int, int, int], None] | None = None,
) -> SelfCalibration:
    """Estimate the camera that has recorded a clip: its focal length, barrel distortion and principal point.

    Args:
        frames: from the beginning of the clip: a :class:`dvo.data.Source`, or a list. Their cameras are not used, but
            for the readout time. An iterator is read as far as needed and its frames are kept in memory.
        guess: to begin with; None for that of the source, or the usual angle of view.
        weights: of the architecture ``patch_vo``.
        device, seed: as in :func:`dvo.load`.
        options: number of frames, and what is believed.
        on_frame: called after each frame of each round.
        on_round: called before each round with its number from 1, the largest number of rounds, and the number of
            frames that it tracks if none is left out or lost.

    Returns:
        The focal length with its standard deviation, and the distortion of the lens if it has some, or the guess if the
        images do not tell.

    Raises:
        DvoError: no frames, or weights of another architecture.

    Example:
        >>> source = dvo.open("video.mp4", guess=True)
        >>> found = dvo.calibrate(source)
        >>> print(found)
        focal length 520 +- 16 px (self-calibrated from 60 frames)
        >>> run = dvo.run(dvo.load("small"), source.recalibrated(found.calibration, found.kept))
    """
    limit = 8 * options.frames  # with those that are left out or lost
    kept = tee(frames, 1)[0] if isinstance(frames, Iterator) else None
    first = next(_readable(frames if kept is None else copy(kept)), None)
    if first is None:
        raise DvoError("no frames", field="frames", remedy="give a video or a folder with images")
    recorded = getattr(frames, "recorded_camera", first.camera)  # frames of large images are reduced
    width, height = recorded.width, recorded.height
    picture = _Picture.of(first.image, width)
    if guess is None:
        guess = getattr(frames, "guess", None) or guess_from_angle(width, height)
        if guess.source == "prior" and picture.size != (width, height):
            guess = replace(guess_from_angle(*picture.size), width=width, height=height)

    def result(
        focal: float, deviation: float, source: str, count: int, reason: str, guess: FocalGuess,
        aside: tuple[float, float] = (0.0, 0.0), *more: Any,
    ) -> SelfCalibration:  # fmt: skip
        aside = aside[0] + picture.aside[0], aside[1] + picture.aside[1]
        return SelfCalibration(focal, deviation, source, width, height, count, reason, guess, aside, *more)

    focal, aside, bend, wanted, reason, count = guess.focal, (0.0, 0.0), 0.0, options.frames, "", 0
    walk: list[tuple[float, float, float]] = []
    known = length_hint(frames, -1)  # a source may not know it before it is read
    length = known if known >= 0 else None
    left = math.inf if length is None else length + options.spare
    tracking: _Tracking | None = None
    believed: SelfCalibration | None = None
    for number in range(options.rounds):
        if on_round is not None:
            on_round(number + 1, options.rounds, int(min(wanted, left)))
        if tracking is None:
            clip = islice(_readable(frames if kept is None else copy(kept)), limit)
            x, y = (value * first.camera.width / width for value in aside)
            odometry = _loaded(weights, device, seed)
            tracking = _Tracking(odometry, clip, focal * first.camera.width / width, (x, y), bend, picture)
        left -= tracking.go_on(wanted, options.interval, left, on_frame)
        profile, count = _profile(tracking.odometry, tracking.lens)
        asked = [*walk, (math.log(focal), profile.minimum.value, profile.contrast)]
        slope = _slope(asked)
        step = profile.minimum.value / slope
        deviation = math.hypot(options.inflation * profile.minimum.deviation / slope, options.floor)
        reason = _doubt(profile, deviation, focal * math.exp(step), guess, options)
        is_last = number + 1 == options.rounds or left < min(wanted, math.inf if length is None else length) / 2
        if reason and believed is not None and count < believed.frames:
            return believed  # there were not frames enough left to settle
        if reason:
            if tracking.tracked < wanted or wanted > options.frames or is_last:
                break
            if walk:  # back to the guess; tracked with it, the clip goes on from where it is
                tracking = None
            focal, aside, bend, wanted, walk, believed = guess.focal, (0.0, 0.0), 0.0, 2 * wanted, [], None
            continue
        tracking, walk = None, asked
        before, (aside, unsure) = aside, _principal_point(profile, aside, focal, max(width, height), options)
        focal *= math.exp(step)
        bent, bend = profile.bend.value - bend, profile.bend.value
        bend_deviation = math.hypot(options.inflation * profile.bend.deviation, bent) if bend else math.inf
        if abs(step) > options.settled:  # the last round may end without having settled
            deviation = math.hypot(deviation, _LEFT * step)
        is_settled = (
            abs(step) <= options.settled
            and abs(bent) <= 2 * options.settled
            and math.dist(before, aside) <= options.max_aside * max(width, height)
        )
        believed = result(
            focal, deviation * focal, SELF_CALIBRATED, count, "", guess, aside, unsure, bend, bend_deviation
        )
        if is_settled or is_last:
            return believed
    return result(guess.focal, guess.deviation, guess.source, count, reason, guess)


def _readable(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Frames up to one that cannot be read, which the run itself will tell of; an error at the first one is raised."""
    started = False
    try:
        for frame in frames:
            checked = checked_frame(frame)
            started = True
            yield checked
    except (DvoError, OSError):
        if not started:
            raise


def _slope(walk: list[tuple[float, float, float]]) -> float:
    """Share of the way to the focal length at which the measurements ask for no further step, that they ask for.

    Measurements lean towards the focal length that they were tracked with, so that a step that they ask for is too
    short; so is the deviation of the focal length that they tell. The secant through the last two rounds tells by how
    much, unless the last one tells the focal length far better: then the one before was not tracked well.

    Args:
        walk: logarithm of the focal length of each round, the step that its measurements ask for, and their contrast.

    Returns:
        Divisor of the last step and its deviation, 0.4 to 1.
    """
    (at, step, contrast) = walk[-1]
    if len(walk) == 1 or at == walk[-2][0] or contrast > _MENDED * walk[-2][2]:
        return 1.0
    return min(max((walk[-2][1] - step) / (at - walk[-2][0]), 0.4), 1.0)


@dataclass(frozen=True)
class _Picture:
    """What is between the bars of a letterbox or pillarbox: its middle is where the principal point is looked for.

    Attributes:
        inside: rows and columns of the frames.
        size: width and height, pixels of the recorded images.
        aside: way from their middle to that of the picture, pixels.
    """

    inside: tuple[slice, slice]
    size: tuple[int, int]
    aside: tuple[float, float]

    @classmethod
    def of(cls, image: np.ndarray, width: int) -> _Picture:
        """From the first frame and the width of the recorded images."""
        factor = width / image.shape[1]
        inside = Bars().with_image(image).inside(image.shape, 1)  # a row or column may be of both
        if inside is None:
            inside = slice(0, image.shape[0]), slice(0, image.shape[1])
        ends = [(each.start, each.stop) for each in inside]
        (h, w), (y, x) = ([e - s for s, e in ends], [s + e for s, e in ends])
        aside = (x - image.shape[1]) / 2 * factor, (y - image.shape[0]) / 2 * factor
        return cls(inside, (round(w * factor), round(h * factor)), aside)


class _Tracking:
    """Tracking of the beginning of a clip with a focal length.

    Attributes:
        lens: that the images were undistorted from; None without distortion.
    """

    def __init__(
        self,
        odometry: PatchOdometry,
        frames: Iterable[Frame],
        focal: float,
        aside: tuple[float, float],
        bend: float,
        picture: _Picture,
    ) -> None:
        self.odometry, self.frames, self.focal, self.aside, self.bend = odometry, iter(frames), focal, aside, bend
        self.inside = picture.inside
        self.lens: Camera | None = None
        self._undistorter: Undistorter | None = None
        self.tracked, self.last = 0, -math.inf

    def go_on(
        self,
        wanted: int,
        interval: float,
        most: float,
        on_frame: Callable[[Frame, Estimate | None], None] | None,
    ) -> int:
        """Track until as many frames as wanted have a pose, or no more are allowed; the number of those tracked now."""
        fed = 0
        while self.tracked < wanted and fed < most and (frame := next(self.frames, None)) is not None:
            if frame.timestamp < self.last + interval:
                continue
            image = frame.image[self.inside]
            mask = None if frame.mask is None else frame.mask[self.inside]
            self.last, (height, width) = frame.timestamp, image.shape[:2]
            found = simple_camera(self.focal, self.aside, self.bend, width, height)
            camera = replace(found, readout=frame.camera.readout).camera(width, height)
            if self.bend:
                if self._undistorter is None or self._undistorter.source != camera:
                    self._undistorter, self.lens = Undistorter(camera), camera
                camera, image = self._undistorter.camera, self._undistorter(image)
                mask = None if mask is None else self._undistorter.mask(mask)
            estimate = self.odometry.track(Frame(frame.index, frame.timestamp, image, camera, mask=mask))
            if on_frame is not None:
                on_frame(frame, estimate)
            self.tracked, fed = self.tracked + (estimate.status is Status.TRACKING), fed + 1
        return fed


def _loaded(weights: str, device: torch.device | str, seed: int) -> PatchOdometry:
    """Odometry of weights that keeps its measurements."""
    from dvo.odometry.patch.tracker import PatchOdometry

    odometry = load(weights, device=device, seed=seed, loops=False)
    if not isinstance(odometry, PatchOdometry):
        raise DvoError(
            f"the odometry {odometry.name} keeps no measurements", field="weights", remedy="use weights of patch_vo"
        )
    return odometry


@torch.inference_mode()
def _profile(odometry: PatchOdometry, lens: Camera | None) -> tuple[FocalProfile, int]:
    """Profile of the longest segment so far, and its number of frames."""
    state, config = odometry.state, odometry.config
    graph = closed_graph(odometry)
    info = adjust_segments(graph, state.adjustable, state.shutter, config.estimate_readout, config.adjustment)
    longest = max(state.adjustable or [0], key=lambda segment: len(graph.members(segment)))
    shutter = replace(state.shutter, readout=float(info["readout"]))
    return find_focal(graph, longest, shutter, config.adjustment, lens=lens), len(graph.members(longest))


def _principal_point(
    profile: FocalProfile, aside: tuple[float, float], focal: float, side: int, options: CalibrationOptions
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Way from the middle of the image to the principal point and its deviations, pixels; 0 and inf if not believed."""
    found = []
    for start, minimum in zip(aside, profile.aside, strict=True):
        deviation = options.inflation * minimum.deviation * focal
        offset = start + minimum.value * focal
        sure = deviation <= options.max_aside * side and abs(offset) <= _FARTHEST_ASIDE * side
        if abs(offset - start) > options.max_aside * side:  # the last round may end without having settled
            deviation = math.hypot(deviation, offset - start)
        found.append((offset, deviation) if sure else (0.0, math.inf))
    (x, dx), (y, dy) = found
    return (x, y), (dx, dy)


def _doubt(
    profile: FocalProfile, deviation: float, focal: float, guess: FocalGuess, options: CalibrationOptions
) -> str:
    """Reason for not believing the focal length of a minimum, after the step; empty for one that is believed."""
    if not np.isfinite(deviation) and profile.contrast == 0 and profile.minimum.gain == 0:
        return "too few frames could be tracked"
    if not (deviation <= options.max_deviation and profile.contrast >= options.min_contrast):  # nan fails too
        return "the motion does not tell: the measurements fit a wide range of focal lengths"
    if not abs(math.log(focal / guess.focal)) <= 4 * guess.deviation / guess.focal:
        return f"the measurements fit {focal:.0f} px best, which is hardly possible"
    return ""
