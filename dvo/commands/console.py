"""Helpers that the commands share: devices, seeds, Ctrl-C and the progress bar."""

from __future__ import annotations

import contextlib
import errno
import random
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, NoReturn

import cv2
import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from dvo.commands import Terminated, ending_signals
from dvo.core.arguments import checked_device
from dvo.core.errors import DvoError
from dvo.core.text import print_line, printable
from dvo.data.frame import Frame
from dvo.odometry.protocol import Estimate, Result, Status

PLAIN_INTERVAL = 10.0
"""Seconds between two lines about the progress where there is no terminal."""
LONG_RUN = 60.0
"""Seconds above which a run tells how long it will take, once the first :data:`ESTIMATED_AFTER` frames are tracked."""
ESTIMATED_AFTER = 30
GRACE = 1.5
"""Seconds after SIGTERM in which a frame is finished and results are written."""
_COLOURS = {
    Status.INITIALISING: "yellow", Status.TRACKING: "green", Status.LOST: "red", Status.INERTIAL: "magenta",
}  # fmt: skip


def device_of(name: str) -> torch.device:
    """Device of a name.

    Args:
        name: of a torch device; ``auto`` selects an accelerator that supports float64, else the CPU.

    Returns:
        The device.

    Raises:
        DvoError: the device is not available.
    """
    if name == "auto":
        accelerator = getattr(torch, "accelerator", None)  # torch 2.6 and newer
        if accelerator is None or not accelerator.is_available():
            return torch.device("cpu")
        name = accelerator.current_accelerator().type
        try:
            torch.zeros(1, device=name, dtype=torch.float64)
        except (RuntimeError, TypeError):
            name = "cpu"
        return torch.device(name)
    found: torch.device = checked_device(name, "--device")
    return found


def seed_everything(seed: int) -> None:
    """Seed the global random generators in use: Python, torch and OpenCV's RANSAC.

    Args:
        seed: of all of them.
    """
    random.seed(seed)
    torch.manual_seed(seed)
    cv2.setRNGSeed(seed % 2**31)  # takes an int of C


def say(text: str) -> None:
    """Print a line to stdout, unless its reader has closed the pipe or the terminal: the results folder says it too.

    Args:
        text: the line.

    Raises:
        DvoError: another failure of stdout, such as a full disk.
    """
    try:
        print_line(text)
    except BrokenPipeError:
        pass
    except OSError as error:
        if error.errno == errno.EIO:  # the terminal is gone
            return
        raise DvoError(error.strerror or str(error), file="standard output") from error


def say_all(value: object) -> None:
    """Print the lines of the text of a value to stdout, see :func:`say`.

    Args:
        value: whose text may have several lines.
    """
    for line in str(value).split("\n"):
        say(line)


def warn(text: str, kind: str = "warning") -> None:
    """Print a warning to stderr, if it can be written.

    Args:
        text: a sentence.
        kind: word before it.
    """
    with contextlib.suppress(OSError):
        print_line(f"dvo: {kind}: {text}", error=True)


class InterruptSwitch:
    """Context in which the first Ctrl-C, SIGTERM or SIGHUP only sets :attr:`pressed`; the second raises
    KeyboardInterrupt. A SIGHUP or SIGTERM that is ignored, as by ``nohup``, stays ignored.

    An interrupt in the middle of an update would leave the tracker in an inconsistent state; the caller checks
    :attr:`pressed` between frames instead. After SIGTERM there are :data:`GRACE` seconds, for a frame and for the
    results, until :meth:`release`; then KeyboardInterrupt is raised as by a second signal: who sends it kills soon.

    Args:
        on_press: called at the first signal, in its handler.
        patience: multiple of :data:`GRACE`, above 1 for a program that waits for others which have that time.

    Attributes:
        pressed: the first signal, None before it.
    """

    def __init__(self, on_press: Callable[[], object] | None = None, patience: float = 1.0) -> None:
        self.on_press = on_press
        self._patience = patience
        self.pressed: signal.Signals | None = None
        self._before: dict[signal.Signals, Any] = {}
        self._limited = hasattr(signal, "setitimer")

    def __enter__(self) -> InterruptSwitch:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *ending_signals()):
                if number is signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._press)
            self._limited = self._limited and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
            if self._limited:
                self._before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._end)
        return self

    @property
    def in_haste(self) -> bool:
        """SIGTERM was the first signal."""
        return self.pressed == signal.SIGTERM

    def release(self) -> None:
        """End the time limit: what matters is written."""
        if self._limited and threading.current_thread() is threading.main_thread():
            self._limited = False
            signal.setitimer(signal.ITIMER_REAL, 0)

    def __exit__(self, *_: object) -> None:
        self.release()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _press(self, number: int, frame: FrameType | None) -> None:
        if self.pressed is not None:
            raise KeyboardInterrupt if number == signal.SIGINT else Terminated(number)
        self.pressed = signal.Signals(number)
        if self.in_haste and self._limited:
            signal.setitimer(signal.ITIMER_REAL, self._patience * GRACE)
        if self.on_press is not None:
            self.on_press()

    def _end(self, number: int, frame: FrameType | None) -> NoReturn:
        raise Terminated


class StderrConsole(Console):
    """Console on stderr that falls silent when the reader of stderr is gone."""

    def __init__(self) -> None:
        super().__init__(stderr=True)

    def on_broken_pipe(self) -> None:
        """Stop printing; rich would end the program."""
        self.quiet = True


class TrackingProgress:
    """Progress bar on stderr: the phase, the rate over the last frames, the time left and the state of the tracker.

    Without a terminal there is a plain line every :data:`PLAIN_INTERVAL` seconds. A failure of stderr (closed pipe,
    full disk) ends the display, not the run.

    Args:
        total: number of frames, or None if unknown.
        phase: what is done with them.
    """

    def __init__(self, total: int | None, phase: str = "tracking") -> None:
        console = StderrConsole()
        self._name, self._total, self._done, self._rate = phase, total, 0, 0.0
        self._began = time.perf_counter()
        self._plain = not console.is_terminal
        self._ended = threading.Event()
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]:5.1f} frames/s"),
            TextColumn("{task.fields[status]}"),
            TimeRemainingColumn(),
            console=console,
        )
        self._task = self._progress.add_task(phase, total=total, rate=0.0, status="")
        self._moments: deque[float] = deque([time.perf_counter()], maxlen=ESTIMATED_AFTER)
        self._untold = phase == "tracking"  # how long it will take

    def __enter__(self) -> TrackingProgress:
        with contextlib.suppress(OSError):
            self._progress.start()
        if self._plain:
            threading.Thread(target=self._tell, name="dvo progress", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        with contextlib.suppress(OSError):
            self._progress.stop()

    def begin(self, phase: str, total: int | None = None) -> None:
        """Begin another phase.

        Args:
            phase: in words, such as ``adjusting``.
            total: number of frames; None if unknown, or where there are none to count.
        """
        self._name, self._total, self._done, self._rate = phase, total, 0, 0.0
        self._began = time.perf_counter()
        self._moments.clear()
        self._moments.append(self._began)
        with contextlib.suppress(OSError):
            self._progress.reset(self._task, description=phase, rate=0.0, status="")
        self._show_total()

    def _show_total(self) -> None:
        self._progress.tasks[0].total = self._total  # reset() and update() would leave the one before in place of none

    def name(self, phase: str) -> None:
        """Name what is done after the last frame; the counts stay.

        Args:
            phase: in words, such as ``adjusting``.
        """
        self._name, self._done, self._began = phase, 0, time.perf_counter()
        with contextlib.suppress(OSError):
            self._progress.update(self._task, description=phase)

    def begin_round(self, number: int, most: int, frames: int) -> None:
        """Begin a round of a self-calibration; callback of :func:`dvo.odometry.calibration.calibrate.calibrate`.

        Args:
            number: of the round, from 1.
            most: rounds.
            frames: that it tracks.
        """
        self.begin(f"calibrating, round {number} of at most {most}", frames)

    @property
    def line(self) -> str:
        """The phase with its counts in words."""
        seconds = time.perf_counter() - self._began
        if not self._done:
            return f"{self._name}, {seconds:.0f} s so far"
        if self._total is None:
            return f"{self._name}, {self._done} frames, {self._rate:.1f} frames/s"
        left = max(self._total - self._done, 0) / max(self._rate, 1e-9)
        return f"{self._name}, {self._done} of {self._total} frames, {self._rate:.1f} frames/s, {left:.0f} s left"

    def _tell(self) -> None:
        while not self._ended.wait(PLAIN_INTERVAL):
            warn(self.line, "progress")

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """Advance by a frame; callback of :func:`dvo.session.session.run`.

        Args:
            frame: the frame.
            estimate: of the frame; None if it was skipped.
        """
        self._moments.append(time.perf_counter())
        rate = (len(self._moments) - 1) / max(self._moments[-1] - self._moments[0], 1e-9)
        self._done, self._rate = self._done + 1, rate
        fields: dict[str, Any] = {"rate": rate}
        if self._total is not None and self._done > self._total:  # a round goes on for frames without a pose
            self._total = None
            self._show_total()
        if estimate is not None:
            fields["status"] = f"[{_COLOURS[estimate.status]}]{describe_status(estimate)}"
        with contextlib.suppress(OSError):
            self._progress.update(self._task, advance=1, **fields)
        if self._untold and self._total is not None and self._done >= ESTIMATED_AFTER:
            self._untold = False
            if self._total / rate > LONG_RUN:
                warn(f"about {spoken_time(self._total / rate)} for {self._total:,} frames", "note")

    def finish(self, result: Result) -> None:
        """Show the outcome in place of the state of the last frame: ``finish`` gives poses to earlier frames too.

        Args:
            result: of the odometry.
        """
        tracked = result.frames_tracked
        self._ended.set()
        with contextlib.suppress(OSError):
            status = f"[{'green' if tracked else 'red'}]{tracked} tracked"
            self._progress.update(self._task, description="tracking", status=status)


def spoken_time(seconds: float) -> str:
    """Time in minutes, from two hours on in hours and minutes.

    Args:
        seconds: the time.

    Returns:
        Text such as ``12 min`` or ``3 h 20 min``.
    """
    minutes = max(1, round(seconds / 60))
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def describe_status(estimate: Estimate) -> str:
    """Describe the state of the tracker, with the cause of it and the segment from the second one on.

    Args:
        estimate: of the last frame.

    Returns:
        Text such as ``lost: black image, segment 1``, as rich markup.
    """
    text = estimate.status.value
    if estimate.reason:
        text += f": {escape(printable(estimate.reason))}"
    return f"{text}, segment {estimate.segment}" if estimate.segment else text
