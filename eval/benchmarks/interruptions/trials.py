"""Interrupted sequences: frames without a view, other scenes, frozen images and gaps in time within good frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dvo.data.files.root import data_root
from dvo.data.frame import Frame
from dvo.data.open import open_source
from dvo.data.trajectory import Trajectory
from dvo.synth.sequence import make_sequence

BEFORE = 60  # good frames before an interruption
AFTER = 60  # good frames after it
FPS = 30.0
FAMILIES = ("hall", "courtyard", "gallery")  # families that training never draws
FIRST_SEED = {"calibration": 3_200_000_000, "test": 4_200_000_000}

WITHOUT_VIEW = ("black", "white", "noise")
OTHERS = ("other scene", "frozen", "gap")
DURATIONS = (15, 30, 60, 150)


@dataclass(frozen=True)
class Clip:
    """Good frames with ground truth.

    Attributes:
        name: of the clip.
        frames: in order of time.
        groundtruth: camera to world, one pose for each frame.
    """

    name: str
    frames: Sequence[Frame]
    groundtruth: Trajectory


@dataclass(frozen=True)
class Trial:
    """Interrupted sequence.

    Attributes:
        clip: name of the clip.
        kind: of the interruption, see :data:`WITHOUT_VIEW` and :data:`OTHERS`.
        seed: of the images of the interruption.
        frames: the sequence.
        good: ``(N,)`` bool, False for the frames of the interruption.
        without_view: ``(N,)`` bool, True for black, white and noise frames.
        cut: position of the first frame of the interruption.
        resumes: position of the first good frame after it.
        source: ``(N,)`` position of each good frame in the clip; -1 for the frames of the interruption.
        duration: of the interruption, frames.
    """

    clip: str
    kind: str
    seed: int
    frames: Sequence[Frame]
    good: np.ndarray
    without_view: np.ndarray
    cut: int
    resumes: int
    source: np.ndarray
    duration: int


def recording(name: str, count: int) -> Clip:
    """First frames of a recording.

    Args:
        name: folder of the data root.
        count: largest number of frames.

    Returns:
        The clip.

    Raises:
        DvoError: the recording is not there, or has no ground truth.
    """
    source = open_source(data_root() / name, calib=_calibration(data_root() / name))
    frames = [frame for _, frame in zip(range(count), source, strict=False)]
    assert source.groundtruth is not None
    return Clip(name, frames, source.groundtruth)


def _calibration(folder: Path) -> Path | None:
    file = folder / "calib.txt"
    return file if file.is_file() else None


@lru_cache(maxsize=3)
def rendered(seed: int, split: str, count: int) -> Clip:
    """Hand-held walk through a scene of a held-out family, 320x240 at 30 Hz.

    Args:
        seed: number of the scene, from 0.
        split: ``calibration`` or ``test``.
        count: number of frames.

    Returns:
        The clip.
    """
    options: dict[str, Any] = {"family": FAMILIES[seed % len(FAMILIES)], "kind": "handheld", "fps": FPS, "apart": True}
    sequence = make_sequence(FIRST_SEED[split] + seed, frames=count, **options)
    return Clip(f"{FAMILIES[seed % len(FAMILIES)]} {seed}", list(sequence), sequence.groundtruth)


def image_without_view(kind: str, variant: int, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draw an image that shows nothing.

    Args:
        kind: ``black``, ``white`` or ``noise``.
        variant: of the kind: exact values, with sensor noise, or with vignetting and noise; pixels, grey pixels, or
            coarse noise as compression leaves it.
        shape: height, width and channels.
        rng: of the noise.

    Returns:
        ``(H, W, 3)`` uint8.
    """
    height, width = shape[:2]
    variant %= 3
    if kind == "noise":
        if variant == 0:
            return rng.integers(0, 256, (height, width, 3), np.uint8)
        if variant == 1:
            grey = rng.normal(128, 50, (height, width, 1))
            return np.repeat(grey.clip(0, 255), 3, axis=2).astype(np.uint8)
        coarse = rng.normal(110, 60, (-(-height // 4), -(-width // 4), 3)).clip(0, 255).astype(np.uint8)
        return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    image = np.zeros((height, width, 3)) if kind == "black" else np.full((height, width, 3), 255.0)
    if variant:
        image += rng.normal(0, 3.0, image.shape)
        image += 6.0 if kind == "black" else -6.0
    if variant == 2:
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        image += (4.0 if kind == "black" else -12.0) * (x**2 + y**2)[..., None]
    return image.round().clip(0, 255).astype(np.uint8)


def interrupt(
    clip: Clip, kind: str, duration: int, seed: int, *, other: Clip | None = None, moves: bool = True
) -> Trial:
    """Interrupt a clip after :data:`BEFORE` frames (or half of a short clip).

    Args:
        clip: good frames.
        kind: of the interruption.
        duration: of the interruption, frames.
        seed: of its images.
        other: another scene, for the kind ``other scene``.
        moves: the camera moves on during the interruption, so that ``duration`` frames of the clip are replaced;
            otherwise it stands still, and frames are inserted.

    Returns:
        The trial, with at most :data:`AFTER` good frames after the interruption.
    """
    cut = min(BEFORE, len(clip.frames) // 2)
    resumes = cut + duration if moves else cut
    before, after = list(clip.frames[:cut]), list(clip.frames[resumes : resumes + AFTER])
    interval = before[-1].timestamp - before[-2].timestamp
    rng = np.random.default_rng([seed, duration, *kind.encode()])
    shown: list[Frame] = []
    for k in range(0 if kind == "gap" else duration):
        frame = replace(before[-1], timestamp=before[-1].timestamp + (k + 1) * interval)
        if kind in WITHOUT_VIEW:
            frame = replace(frame, image=image_without_view(kind, seed, frame.image.shape, rng))
        elif kind == "other scene":
            assert other is not None
            height, width = frame.image.shape[:2]
            foreign = cv2.resize(other.frames[k].image, (width, height), interpolation=cv2.INTER_AREA)
            frame = replace(frame, image=foreign)
        shown.append(frame)
    delay = 0.0 if moves else duration * interval
    after = [replace(frame, timestamp=frame.timestamp + delay) for frame in after]
    frames = [replace(frame, index=index) for index, frame in enumerate([*before, *shown, *after])]
    good = np.ones(len(frames), bool)
    good[cut : cut + len(shown)] = False
    view = ~good if kind in WITHOUT_VIEW else np.zeros(len(frames), bool)
    source = np.full(len(frames), -1)
    source[good] = [*range(cut), *range(resumes, resumes + len(after))]
    return Trial(clip.name, kind, seed, frames, good, view, cut, cut + len(shown), source, duration)
