"""Session: run an odometry over a source, from the first frame to the result."""

from __future__ import annotations

import contextlib
import copy
import itertools
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.data.trajectory import Trajectory, interpolate
from dvo.odometry.protocol import Break, Estimate, Interim, Odometry, Result
from dvo.odometry.quality import without_calibration
from dvo.odometry.segments import find_breaks, joined
from dvo.session.second_run import compare_again, is_due

FrameCallback = Callable[[Frame, Estimate | None], None]


@dataclass(frozen=True)
class Run:
    """Record of a session.

    Attributes:
        result: result of the odometry, with rows for frames skipped by the stride; counts are frames of the source.
        frames_fed: number of frames passed to the odometry (fewer than read, with a stride).
        interrupted: True if the user stopped the run.
        warnings: problems that did not end the run, a sentence each.
        seconds: wall time of ``reading``, ``tracking`` and ``finishing``; of ``calibrating`` before them, if the focal
            length was found in the images, and of ``checking`` after them, if there was a second run.
        frame_seconds: wall time of each call of ``track``.
    """

    result: Result
    frames_fed: int
    interrupted: bool
    warnings: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    frame_seconds: tuple[float, ...] = ()

    @property
    def frames_per_second(self) -> float:
        """Tracked frames per second of wall time, reading and finishing included."""
        own = sum(value for part, value in self.seconds.items() if part not in ("calibrating", "checking"))
        return self.frames_fed / max(own, 1e-9)


@checked_arguments
def run(
    odometry: Odometry,
    source: Iterable[Frame],
    *,
    stride: int = 1,
    on_frame: FrameCallback | None = None,
    should_stop: Callable[[], bool] | None = None,
    in_haste: Callable[[], bool] | None = None,
    on_phase: Callable[[str], None] | None = None,
    strict: bool = False,
    again: Callable[[int], Odometry] | None = None,
) -> Run:
    """Run an odometry over a source.

    Every ``stride``-th frame and the last one are tracked; frames between them get interpolated poses, within a segment
    only. After an interruption, or a frame that cannot be read or used, the frames tracked so far are finished and
    returned with a warning. Every frame is checked and, where harmless, converted first
    (:func:`dvo.data.frame_checks.checked_frame`).

    Args:
        odometry: newly built; an odometry tracks one sequence.
        source: frames in order of time.
        stride: distance of tracked frames, in frames of the source.
        on_frame: called after each frame, outside the timings; the estimate is None for a skipped frame.
        should_stop: called before each frame; True ends tracking. With it the caller handles Ctrl-C; without it a
            KeyboardInterrupt ends tracking too.
        in_haste: asked when tracking has been stopped; True takes the result so far in place of the final optimisation,
            from an odometry that has one (:class:`dvo.odometry.protocol.Interim`), with a warning.
        on_phase: called with ``adjusting`` before the final optimisation, and with ``checking`` before a second run.
        strict: raise errors and interruptions instead.
        again: builds the odometry anew, with a seed for each number above 0. Where the result leaves doubt, and the
            source can be read again, its beginning is tracked a second time, backward, and compared
            (:mod:`dvo.session.second_run`).

    Returns:
        The record of the run: its ``result``, warnings and wall times. Poses are ``T_wc``.

    Raises:
        DvoError: a stride below 1, or a source without frames; with ``strict``, any error of the source or odometry.

    Example:
        >>> done = dvo.run(dvo.load("small"), dvo.open("video.mp4", calib="calib.txt"))
        >>> trajectory, verdict = done.result.trajectory, done.result.quality.verdict
    """
    if stride < 1:
        raise DvoError(f"must be 1 or more, got {stride}", field="stride", remedy="give a whole number of frames")
    feeding = _Feeding(odometry, stride, on_frame)
    interrupted = False
    warnings: list[str] = []
    frames = iter(source)
    try:
        while not (interrupted := should_stop is not None and should_stop()):
            started = time.perf_counter()
            frame = next(frames, None)
            feeding.seconds["reading"] += time.perf_counter() - started
            if frame is None:
                interrupted = should_stop is not None and should_stop()  # a live source ends when it is stopped
                break
            feeding.take(frame)
        feeding.flush()
    except KeyboardInterrupt:
        if strict or should_stop is not None:  # the caller handles the first one, so this is the second
            raise
        interrupted = True
    except (DvoError, OSError) as error:
        if strict or not feeding.fed:
            raise
        warnings.append(f"stopped at frame {feeding.frames_read}: {error}")
    if interrupted:
        warnings.append(f"interrupted after {feeding.frames_read} frames")
    elif not feeding.frames_read:
        raise DvoError("no frames", file=getattr(source, "name", None), remedy="give a video or a folder with images")

    tell = on_phase or (lambda phase: None)
    tell("adjusting")
    started = time.perf_counter()
    if interrupted and in_haste is not None and in_haste() and isinstance(odometry, Interim):
        result = odometry.current()
        warnings.append("there was no time for the final optimisation: poses are those of tracking")
    else:
        result = odometry.finish()
    feeding.seconds["finishing"] = time.perf_counter() - started
    guessed = getattr(source, "guess", None) is not None
    if result.quality is not None and (guessed or not getattr(source, "calibrated", True)):
        result = replace(result, quality=without_calibration(result.quality, guessed))
    if again is not None and not interrupted and is_due(result, source):
        tell("checking")
        started = time.perf_counter()
        stop = should_stop or (lambda: False)
        with contextlib.suppress(DvoError, OSError, KeyboardInterrupt):  # the result stands without it
            beginning = itertools.takewhile(lambda _: not stop(), source)
            result = replace(result, quality=compare_again(result, again, beginning, stride, stop))
        feeding.seconds["checking"] = time.perf_counter() - started
    return Run(
        result=over_source(
            result, np.array(feeding.fed), np.array(feeding.skipped), feeding.reasons, feeding.interruptions
        ),
        frames_fed=len(feeding.fed),
        interrupted=interrupted,
        warnings=(*getattr(source, "warnings", ()), *warnings),
        seconds=feeding.seconds,
        frame_seconds=tuple(feeding.frame_seconds),
    )


def over_source(
    result: Result,
    fed: np.ndarray,
    skipped: np.ndarray,
    reasons: Mapping[float, str],
    interruptions: Mapping[float, str] | None = None,
) -> Result:
    """Describe a result in frames of the source instead of frames of the odometry.

    Args:
        result: of the odometry.
        fed: ``(F,)`` increasing timestamps of the frames passed to the odometry, seconds.
        skipped: ``(S,)`` timestamps of the skipped frames, seconds.
        reasons: causes of lost frames by timestamp, for an odometry that reports no breaks.
        interruptions: why the time before a tracked frame is not known, by its timestamp.

    Returns:
        The result with rows for skipped frames, each between two frames of one segment; with counts and breaks in
        frames of the source; and with the breaks that the rows show if the odometry reports none.
    """
    segments, main = result.segments, result.trajectory.timestamps
    together = [k for k, s in enumerate(segments) if len(s) and np.isin(s.trajectory.timestamps, main).all()]
    if len(skipped):
        segments = tuple(replace(s, trajectory=fill_skipped(s.trajectory, fed, skipped)) for s in segments)
    times = np.sort(np.concatenate([fed, skipped]))
    owner = np.full(len(times), -1)
    for number, segment in enumerate(segments):
        owner[np.isin(times, segment.trajectory.timestamps)] = number
    causes = {time: cause for time, cause in reasons.items() if owner[np.searchsorted(times, time)] < 0}
    breaks = result.breaks or find_breaks(times, owner, causes)
    told = find_breaks(times, owner, interruptions or {})
    untold = [b for b in told if b.reason in (interruptions or {}).values() and not any(_overlap(b, a) for a in breaks)]
    breaks = tuple(sorted((*breaks, *untold), key=lambda b: -np.inf if b.start is None else b.start))
    if len(skipped):
        lost = times[owner < 0]
        breaks = tuple(replace(b, frames=_count_between(lost, b.start, b.end)) for b in breaks)
    return replace(
        result,
        trajectory=joined([segments[k].trajectory for k in together]) if together else result.trajectory,
        frames_read=len(times),
        frames_lost=len(times) - sum(len(segment) for segment in segments),
        segments=segments,
        breaks=breaks,
    )


def _overlap(one: Break, other: Break) -> bool:
    """Whether two breaks have an interval in common."""
    (start, end), (begin, stop) = (
        (-np.inf if b.start is None else b.start, np.inf if b.end is None else b.end) for b in (one, other)
    )
    return bool(start < stop and begin < end)


def _count_between(times: np.ndarray, start: float | None, end: float | None) -> int:
    after = times > (-np.inf if start is None else start)
    return int((after & (times < (np.inf if end is None else end))).sum())


def fill_skipped(trajectory: Trajectory, fed: np.ndarray, skipped: np.ndarray) -> Trajectory:
    """Add the frames skipped by a stride, interpolated between their neighbours.

    A skipped frame gets a row if the tracked frames before and after it both have one.

    Args:
        trajectory: output of the odometry, poses ``T_wc``.
        fed: ``(F,)`` increasing timestamps of the frames passed to the odometry, seconds.
        skipped: ``(S,)`` timestamps of the skipped frames, seconds.

    Returns:
        Trajectory in order of time.
    """
    has_row = np.isin(fed, trajectory.timestamps)
    after = np.searchsorted(fed, skipped)
    inside = (after > 0) & (after < len(fed))
    inside[inside] = has_row[after[inside] - 1] & has_row[after[inside]]
    between = interpolate(trajectory, skipped[inside], max_gap=np.inf)
    timestamps = np.concatenate([trajectory.timestamps, between.timestamps])
    order = np.argsort(timestamps, kind="stable")
    return Trajectory(timestamps[order], np.concatenate([trajectory.poses_wc, between.poses_wc])[order])


class _Feeding:
    """State of the loop over the frames: stride, timings and timestamps."""

    def __init__(self, odometry: Odometry, stride: int, on_frame: FrameCallback | None) -> None:
        self.odometry, self.stride, self.on_frame = odometry, stride, on_frame
        self.fed: list[float] = []
        self.skipped: list[float] = []
        self.seconds = {"reading": 0.0, "tracking": 0.0, "finishing": 0.0}
        self.frame_seconds: list[float] = []
        self.reasons: dict[float, str] = {}
        self.interruptions: dict[float, str] = {}
        self.interruption = ""  # of the frames skipped since the last tracked one
        self.silence = 0.0  # longest interval since then, see Frame.silence
        self.silence_told = False  # whether images were dropped since then
        self.previous: float | None = None  # time of the last frame
        self.pending: Frame | None = None  # last skipped frame, tracked after all if the source ends with it

    @property
    def frames_read(self) -> int:
        return len(self.fed) + len(self.skipped)

    def take(self, frame: Frame) -> None:
        frame = checked_frame(frame)
        self.interruption = frame.interruption or self.interruption
        interval = 0.0 if self.previous is None else frame.timestamp - self.previous
        self.silence = max(self.silence, interval if frame.silence is None else frame.silence)
        self.silence_told |= frame.silence is not None
        self.previous = frame.timestamp
        if self.frames_read % self.stride:
            self.pending = frame
            self.skipped.append(frame.timestamp)
            self._report(frame, None)
        else:
            self.pending = None
            self._report(frame, self._track(frame))

    def flush(self) -> None:
        """Track the last frame if it was skipped, so that the trajectory covers the whole source."""
        if self.pending is not None:
            self._track(self.pending)
            self.skipped.pop()
            self.pending = None

    def _track(self, frame: Frame) -> Estimate:
        if self.interruption:
            if not frame.interruption:  # dataclasses.replace would load depth, right image and inertial samples
                frame = copy.copy(frame)
                object.__setattr__(frame, "interruption", self.interruption)
            self.interruptions[frame.timestamp], self.interruption = self.interruption, ""
        if self.silence_told and self.silence != frame.silence:
            frame = frame.with_silence(self.silence)
        self.silence, self.silence_told = 0.0, False
        started = time.perf_counter()
        estimate = self.odometry.track(frame)
        self.frame_seconds.append(time.perf_counter() - started)
        self.seconds["tracking"] += self.frame_seconds[-1]
        self.fed.append(frame.timestamp)
        if estimate.reason:
            self.reasons[frame.timestamp] = estimate.reason
        return estimate

    def _report(self, frame: Frame, estimate: Estimate | None) -> None:
        if self.on_frame is not None:
            self.on_frame(frame, estimate)
