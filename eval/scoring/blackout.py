"""Errors on sequences that go dark for a while: of each lit part, and the time until the pose is right again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import Alignment, associate, fit_alignment, transform
from dvo.metrics.segment_metrics import worlds_of
from dvo.odometry.protocol import Segment

DARK_MEAN, DARK_SPREAD = 20.0, 6.0  # grey levels of 255
WHITE_MEAN = 235.0
NOISE_CORRELATION = 0.1  # of neighbouring pixels; images of a scene have more, also in low light
SHORTEST = 5  # frames; a flicker is no blackout
SEGMENT_FRAMES = 10  # frames with a pose that a lit part needs to be judged
NEAR_PERCENT, NEAR_DEGREES = 10.0, 10.0  # found again: within this part of the path before, and this angle


@dataclass(frozen=True)
class BlackoutErrors:
    """Errors of a run on a sequence with stretches of dark.

    Attributes:
        blackouts: number of stretches.
        segment_ate_percent: every lit part aligned on its own; root mean square error in percent of the lit path; inf
            if a lit part has no trajectory, or none of its segments holds half of its poses. Of several segments in a
            lit part, the one with the most poses is judged. Low if tracking works again after the dark, in any world.
        recovery_s: mean time from the return of light until the pose is right again in the world of before the dark.
            inf if it never is: only a system that relocalises has a number here, or one that has guessed the motion;
            a new segment has another world.
    """

    blackouts: int = 0
    segment_ate_percent: float = math.nan
    recovery_s: float = math.nan


def is_dark(image: np.ndarray) -> bool:
    """Return True if a ``(H, W, 3)`` uint8 image shows nothing.

    Args:
        image: RGB.
    """
    sample = image[::4, ::4].astype(np.float32)
    return float(sample.mean()) < DARK_MEAN and float(sample.std()) < DARK_SPREAD


def without_view(image: np.ndarray) -> bool:
    """Return True if a ``(H, W, 3)`` uint8 image is black, white, or noise: no pose can be found from it.

    Independent of the criteria of the systems that are judged by it (:mod:`dvo.odometry.window.pose_validation`).

    Args:
        image: RGB.
    """
    rows = image[::4, :, 1].astype(np.float32)
    if float(rows.std()) < DARK_SPREAD:
        return is_dark(image) or float(image[::4, ::4].mean()) > WHITE_MEAN
    left, right = rows[:, :-1] - rows[:, :-1].mean(), rows[:, 1:] - rows[:, 1:].mean()
    power = float(np.sqrt((left**2).mean() * (right**2).mean()))
    return abs(float((left * right).mean())) < NOISE_CORRELATION * power


def dark_spans(stamps: np.ndarray, dark: np.ndarray) -> list[tuple[float, float]]:
    """Stretches of at least five dark frames with light before and after: first and last dark stamp of each, seconds.

    Args:
        stamps: ``(N,)`` of the frames fed.
        dark: ``(N,)`` bool.
    """
    edges = np.diff(np.concatenate([[0], dark.astype(np.int8), [0]]))
    pairs = zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1, strict=True)
    return [
        (float(stamps[first]), float(stamps[last]))
        for first, last in pairs
        if last - first + 1 >= SHORTEST and first > 0 and last < len(stamps) - 1
    ]


def blackout_errors(
    segments: Sequence[Segment], reference: Trajectory, spans: list[tuple[float, float]], align: Alignment
) -> BlackoutErrors:
    """Judge a run on a sequence with stretches of dark (``spans``, from :func:`dark_spans`).

    Args:
        segments: of the run; a system that keeps its world has one.
        reference: camera to world, metres and seconds.
        spans: first and last dark stamp of each stretch, seconds.
        align: alignment of each lit part.
    """
    if not spans or not len(reference):
        return BlackoutErrors()
    worlds = [_joined([segments[number].trajectory for number in numbers]) for numbers in worlds_of(segments)]
    return BlackoutErrors(
        len(spans),
        _segment_ate(worlds, reference, spans, align),
        float(np.mean([_recovery(worlds, reference, spans, number, align) for number in range(len(spans))])),
    )


def _segment_ate(
    worlds: list[Trajectory], reference: Trajectory, spans: list[tuple[float, float]], align: Alignment
) -> float:
    bounds = [-math.inf, *(edge for span in spans for edge in span), math.inf]
    squares, path = [], 0.0
    for begin, end in zip(bounds[::2], bounds[1::2], strict=True):
        truth = _between(reference, begin, end)
        if len(truth) < SEGMENT_FRAMES:
            continue
        parts = [_between(world, begin, end) for world in worlds]
        track = max(parts, key=len, default=Trajectory(np.zeros(0), np.zeros((0, 7))))
        i, j = associate(track, truth)
        if len(i) < SEGMENT_FRAMES or 2 * len(track) < sum(map(len, parts)):
            return math.inf
        scale, rotation, shift = fit_alignment(track.positions[i], truth.positions[j], align)
        aligned = scale * track.positions[i] @ rotation.T + shift
        squares.append(((aligned - truth.positions[j]) ** 2).sum(axis=1))
        path += truth.path_length
    if not squares or path <= 0:
        return math.nan
    return 100 * float(np.sqrt(np.concatenate(squares).mean())) / path


def _recovery(
    worlds: list[Trajectory], reference: Trajectory, spans: list[tuple[float, float]], number: int, align: Alignment
) -> float:
    """Seconds from the end of a span; inf if the pose is never right again before the next span or the end.

    The pose must be right in the world that holds most of the lit part before the span.
    """
    light = spans[number][1]
    until = spans[number + 1][0] if number + 1 < len(spans) else math.inf
    since = spans[number - 1][1] if number else -math.inf
    before, lit = _between(reference, since, spans[number][0]), _between(reference, light, until)
    pairs = [(world, *associate(world, before)) for world in worlds]
    if not pairs:
        return math.inf
    world, i, j = max(pairs, key=lambda pair: len(pair[1]))
    if len(i) < SEGMENT_FRAMES:
        return math.inf
    placed = transform(world, *fit_alignment(world.positions[i], before.positions[j], align))
    i, j = associate(placed, lit)
    if not len(i):
        return math.inf
    off = np.linalg.norm(placed.positions[i] - lit.positions[j], axis=1)
    cosine = np.abs((placed.poses_wc[i, 3:] * lit.poses_wc[j, 3:]).sum(axis=1))
    turned = np.degrees(2 * np.arccos(np.clip(cosine, 0, 1)))
    near = (off <= NEAR_PERCENT / 100 * before.path_length) & (turned <= NEAR_DEGREES)
    return float(lit.timestamps[j][near][0] - light) if near.any() else math.inf


def _joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Rows of segments that share a world."""
    return Trajectory(
        np.concatenate([part.timestamps for part in parts]), np.concatenate([part.poses_wc for part in parts])
    )


def _between(trajectory: Trajectory, begin: float, end: float) -> Trajectory:
    """Rows strictly between two times."""
    keep = (trajectory.timestamps > begin) & (trajectory.timestamps < end)
    return Trajectory(trajectory.timestamps[keep], trajectory.poses_wc[keep])
