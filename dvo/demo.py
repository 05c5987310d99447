"""``dvo demo``: render a clip, track it and compare with the exact ground truth."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from rich.progress import Progress

from dvo.commands.console import StderrConsole, say, seed_everything
from dvo.commands.run import device_for, load_odometry, track
from dvo.core.threads import current_threads
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.session.results import results_folder
from dvo.synth.sequence import SyntheticSequence, make_sequence

NAME, SCENE, FAMILY, FPS = "demo", 0, "room", 30.0


@dataclass
class RenderedClip:
    """Clip in memory, so that the speed in run.json excludes rendering.

    Attributes:
        name: of the clip.
        frames: rendered frames.
        groundtruth: camera-to-world poses of these frames, metres.
        warnings: always empty; part of the interface of a source.
    """

    name: str
    frames: list[Frame]
    groundtruth: Trajectory | None
    warnings: list[str] = field(default_factory=list)

    @property
    def frame_count(self) -> int | None:
        """Number of frames."""
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)


def render_clip(frames: int) -> RenderedClip:
    """Render a clip of a hand-held camera in a furnished room, 320x240 at 30 Hz.

    Args:
        frames: number of frames.

    Returns:
        The clip, with ground truth.
    """
    with Progress(console=StderrConsole(), transient=True) as progress:
        task = progress.add_task("rendering", total=frames)
        sequence = make_sequence(SCENE, frames=frames, family=FAMILY, kind="handheld", fps=FPS)
        rendered = []
        for frame in _frames(sequence, current_threads().count):
            rendered.append(frame)
            progress.advance(task)
    return RenderedClip(NAME, rendered, sequence.groundtruth)


def _frames(sequence: SyntheticSequence, threads: int) -> Iterator[Frame]:
    """Frames of a sequence, by several threads: tensors of one are too small for those of torch."""
    yield sequence.frame(0)  # it fills caches of the scene
    if threads == 1:
        yield from (sequence.frame(index) for index in range(1, len(sequence)))
        return
    pool = ThreadPoolExecutor(threads)
    try:
        yield from pool.map(sequence.frame, range(1, len(sequence)))
    finally:
        pool.shutdown(cancel_futures=True)


def demo(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo demo``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: weights that cannot be loaded, or a folder that cannot be written.
    """
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
        code = track(odometry, render_clip(arguments.frames), folder, facts=facts)
    say("to track your own video: dvo run VIDEO --calib FILE")
    return code
