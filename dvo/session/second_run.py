"""Second run over the beginning of a sequence, backward and with another seed, where the first one leaves doubt.

Where the two differ and the second fits its measurements no better than the first, a third one, forward and with a
seed of its own, decides: what chance has found it rarely finds twice. Against a second run that fits better nothing is
decided: runs forward may share what misleads them.

Images and masks alone are tracked: with measured depths there is no second solution, and no second run.

Measurements may fit a wrong motion nearly as well as the right one: of a flat scene, say, or a picture of which little
moves. Which of them a run finds is then a matter of chance and of where it begins, so that two runs differ. Runs that
agree prove nothing: what is fixed to the camera holds them all. Nor does one that fits its own measurements clearly
worse, unless it is doubtful by itself: it then is the one that went wrong. One that fits them better, or as well and is
doubtful by itself, leaves doubt by a smaller difference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.data.trajectory import Trajectory
from dvo.geometry import sim3
from dvo.geometry.alignment import align
from dvo.odometry.frames.gate import working_image
from dvo.odometry.protocol import Odometry, Result
from dvo.odometry.quality import FILM, Quality, leaves_doubt

FRAMES = 150
"""Frames that are tracked again."""
MIN_COMMON_FRAMES = 10
"""Common frames with poses that a comparison needs."""
MAX_PIXELS = 640 * 480
"""Size of the images that are kept for it, about, at most."""
MAX_DIFFERENCE = 3.0
"""Largest RMS difference of the two after a similarity, percent of the path."""
MAX_DISPUTED = 1.0
"""Largest RMS difference, percent of the path, of two runs that are one solution: of a third run and the first, which
then outvote the second, and of the first and a second one that is at least as good."""
MAX_RESIDUAL_RATIO = 1.25
"""Residual of a second run over that of the first above which it fits its measurements worse."""


def can_be_read_again(source: object) -> bool:
    """Tell if frames can be read a second time: a recording or a list, not what arrives as it is.

    Args:
        source: of frames.
    """
    return not isinstance(source, Iterator) and not hasattr(source, "stop")


def is_due(result: Result, source: object) -> bool:
    """Tell if a second run is to be made: the first one leaves doubt, measured no depths, and can be repeated.

    Args:
        result: of the first run.
        source: of its frames.
    """
    measured = result.info.get("scale", {}).get("source") in ("depth", "stereo")
    return leaves_doubt(result.quality) and not measured and can_be_read_again(source)


def compare_again(
    result: Result,
    build: Callable[[int], Odometry],
    frames: Iterable[Frame],
    stride: int = 1,
    should_stop: Callable[[], bool] = lambda: False,
) -> Quality:
    """Track the beginning of a sequence again, from its end to its start, and compare.

    Args:
        result: of the first run, with its quality.
        build: makes the odometry anew, with a seed for each number above 0.
        frames: of the sequence, from the first on.
        stride: distance of tracked frames.
        should_stop: called before each frame; True ends the second run, and what it has is compared.

    Returns:
        The quality with the difference. It is doubtful if the difference is large (a smaller one is enough where the
        second run fits its measurements better, or as well and is doubtful itself), unless the second run is good and
        fits its measurements worse, or fits them no better and a third run agrees with the first; and if the second
        run finds no motion to compare where the first one has.
    """
    assert result.quality is not None
    mine = result.quality
    kept = [_kept(checked_frame(frame)) for frame in islice(frames, 0, FRAMES * stride, stride)]
    # Backward the rows are read from the last one on, which no camera states: without a readout time.
    backward = [
        replace(frame, timestamp=kept[-1].timestamp - frame.timestamp, camera=replace(frame.camera, readout=0.0))
        for frame in reversed(kept)
    ]
    times = {turned.timestamp: frame.timestamp for turned, frame in zip(backward, reversed(kept), strict=True)}
    again, stopped = _tracked(build(1), backward, should_stop)
    found = again.trajectory
    forward = Trajectory(np.array([times[time] for time in found.timestamps[::-1]]), found.poses_wc[::-1])
    difference, other = _difference(forward, result.trajectory), again.quality
    if np.isnan(difference) and not stopped and _has_begun(mine, kept):
        reason = "a second run, backward with another seed, finds no motion"
        return replace(mine, verdict="doubtful", reason=reason, remedy=FILM)
    ratio = math.nan if other is None or not mine.residual > 0 else other.residual / mine.residual
    is_good = other is not None and other.verdict == "good"
    # One that fits better, or as well and is doubtful, has found a solution that is no worse than the first.
    rivals = ratio < 1 or (ratio <= MAX_RESIDUAL_RATIO and not is_good)
    if is_good and ratio > MAX_RESIDUAL_RATIO or not difference > (MAX_DISPUTED if rivals else MAX_DIFFERENCE):
        return replace(mine, second=difference)  # also where it is NaN: nothing is known
    if not rivals:
        third, stopped = _tracked(build(2), kept, should_stop)
        if not stopped and _difference(third.trajectory, result.trajectory) <= MAX_DISPUTED:
            return replace(mine, second=difference)
    reason = f"a second run, backward with another seed, differs by {difference:.0f}% of the path"
    return replace(mine, second=difference, verdict="doubtful", reason=reason, remedy=FILM)


def _tracked(odometry: Odometry, frames: Iterable[Frame], should_stop: Callable[[], bool]) -> tuple[Result, bool]:
    """Result of tracking frames, and whether it was stopped before their end."""
    for frame in frames:
        if should_stop():
            return odometry.finish(), True
        odometry.track(frame)
    return odometry.finish(), False


def _has_begun(quality: Quality, frames: list[Frame]) -> bool:
    """True if the run has measured poses in the second half of the frames at least, and they are enough to compare."""
    later = frames[len(frames) // 2 :]
    return (
        len(later) >= MIN_COMMON_FRAMES
        and quality.initialised_at is not None
        and quality.initialised_at <= later[0].timestamp
    )


def _kept(frame: Frame) -> Frame:
    """Image of a frame and its mask, of few pixels, since many are kept."""
    image, camera, mask = working_image(frame, MAX_PIXELS)
    return Frame(frame.index, frame.timestamp, image, camera, mask=mask)


def _difference(one: Trajectory, other: Trajectory) -> float:
    """RMS distance after a similarity, percent of the path of the second; NaN with fewer than ten common frames."""
    _, i, j = np.intersect1d(one.timestamps, other.timestamps, return_indices=True)
    source, target = one.positions[i], other.positions[j]
    length = float(np.linalg.norm(np.diff(target, axis=0), axis=1).sum()) if len(j) else 0.0
    if len(j) < MIN_COMMON_FRAMES or length == 0:
        return float("nan")
    moved = sim3.act(align(source, target), torch.from_numpy(source)).numpy()
    return 100 * float(np.sqrt(((moved - target) ** 2).sum(1).mean())) / length
