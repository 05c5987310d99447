"""``dvo demo``: render a clip, track it and compare with the exact ground truth.

With two cores another process renders (``python -m dvo.demo FRAMES``) while this one imports torch, loads weights and
kernels, and tracks the frames that are there.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Iterator
from queue import SimpleQueue
from typing import IO, TYPE_CHECKING, Any

from dvo.commands.kernels import room_beside
from dvo.core.threads import process_environment

if TYPE_CHECKING:
    from dvo.data.frame import Frame
    from dvo.data.trajectory import Trajectory
    from dvo.synth.sequence import SyntheticSequence

NAME, SCENE, FAMILY, FPS = "demo", 0, "room", 30.0
MEMORY = 700 * 2**20
"""Bytes of the process that renders."""


class Renderer:
    """Process that renders the clip. Its messages are queued here, so that it never waits.

    Args:
        frames: number of frames.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, frames: int) -> None:
        command = [sys.executable, "-m", "dvo.demo", str(frames)]
        self._process = subprocess.Popen(
            command, env=process_environment(1), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self._messages: SimpleQueue[bytes] = SimpleQueue()
        try:
            threading.Thread(target=self._listen, args=(self._process.stdout,), daemon=True).start()
        except RuntimeError as error:  # a limit of threads
            self.close()
            raise OSError(str(error)) from error

    def _listen(self, stream: IO[bytes]) -> None:
        with stream:
            while len(message := stream.read(int.from_bytes(stream.read(8), "little"))):
                self._messages.put(message)
        self._messages.put(b"")

    def next(self) -> Any:
        """The ground truth, and then frame after frame; None when the process has ended."""
        message = self._messages.get()
        if not message:
            self._messages.put(message)
            return None
        return pickle.loads(message)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


class RenderedClip:
    """Frames of a hand-held camera in a furnished room, 320x240 at 30 Hz.

    They are in memory, or come from another process, so that the speed in run.json excludes rendering.

    Args:
        frames: number of frames.
        renderer: process that renders them; what it does not bring is rendered here.

    Attributes:
        name: of the clip.
        groundtruth: camera-to-world poses of these frames, metres.
        warnings: always empty; part of the interface of a source.
    """

    def __init__(self, frames: int, renderer: Renderer | None = None) -> None:
        self.name, self._count = NAME, frames
        self.warnings: list[str] = []
        self._frames: list[Frame] = []
        truth = None if renderer is None else renderer.next()
        self._renderer = None if truth is None else renderer
        self._sequence = make_clip(frames) if truth is None else None
        self.groundtruth: Trajectory | None = truth if self._sequence is None else self._sequence.groundtruth
        self._keep(1 if self._renderer is not None else frames)

    def _keep(self, count: int) -> None:
        """Have the first frames in memory."""
        from rich.progress import Progress

        from dvo.commands.console import StderrConsole

        with Progress(console=StderrConsole(), transient=True) as progress:
            for _ in progress.track(range(count), description="rendering"):
                self._frames.append(self._next())

    def _next(self) -> Frame:
        frame = None if self._renderer is None else self._renderer.next()
        if frame is None:  # the process was ended, by a limit of memory perhaps
            self._renderer = None
            self._sequence = self._sequence or make_clip(self._count)
            frame = self._sequence.frame(len(self._frames))
        return frame

    @property
    def frame_count(self) -> int | None:
        """Number of frames."""
        return self._count

    def __iter__(self) -> Iterator[Frame]:
        for index in range(self._count):
            if index == len(self._frames):
                self._frames.append(self._next())
            yield self._frames[index]


def make_clip(frames: int) -> SyntheticSequence:
    """The clip, rendered when its frames are read.

    Args:
        frames: number of frames.
    """
    from dvo.synth.sequence import make_sequence

    return make_sequence(SCENE, frames=frames, family=FAMILY, kind="handheld", fps=FPS)


@contextlib.contextmanager
def rendering(frames: int) -> Iterator[Renderer | None]:
    """Have a process render the clip meanwhile.

    Args:
        frames: number of frames.

    Yields:
        The process; None without a core or memory for it.
    """
    renderer = None
    if room_beside(MEMORY):
        with contextlib.suppress(OSError):
            renderer = Renderer(frames)
    try:
        yield renderer
    finally:
        if renderer is not None:
            renderer.close()


def demo(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo demo``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: weights that cannot be loaded, or a folder that cannot be written.
    """
    with rendering(arguments.frames) as renderer:
        # Imported here, since the process is to start before torch is imported.
        from dvo.commands.console import say, seed_everything
        from dvo.commands.run import device_for, load_odometry, track
        from dvo.core.context import core_left
        from dvo.session.results import results_folder

        device = device_for(arguments)
        seed_everything(arguments.seed)
        facts = {
            "source": f"rendered: {FAMILY}, seed {SCENE}",
            "weights": arguments.weights if arguments.system is None else None,
            "device": str(device),
            "seed": arguments.seed,
            "stride": 1,
        }
        with results_folder(arguments.out, NAME, overwrite=arguments.overwrite) as folder:
            odometry = load_odometry(arguments, device)  # before rendering, so that errors appear early
            with core_left(renderer is not None):
                code = track(odometry, RenderedClip(arguments.frames, renderer), folder, facts=facts)
        say("to track your own video: dvo run VIDEO --calib FILE")
        return code


def main(frames: int) -> None:
    """Render the clip, and write ground truth and frames to standard output.

    Args:
        frames: number of frames.
    """
    stream = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # nothing else is written there
    sequence = make_clip(frames)
    _write(stream, sequence.groundtruth)
    for frame in sequence:
        _write(stream, frame)


def _write(stream: IO[bytes], message: object) -> None:
    data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    stream.write(len(data).to_bytes(8, "little") + data)
    stream.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
