"""Track the real validation sequences with a training checkpoint or a weights file.

These sequences choose weights and settings; they are never a test.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.settings import parse_settings
from dvo.core.text import print_line
from dvo.data.files.root import data_root
from dvo.data.frame import Frame
from dvo.data.open import open_source
from dvo.data.trajectory import Trajectory
from dvo.metrics import Metrics
from dvo.metrics.segment_metrics import evaluate_segments, most_worlds, worlds_of
from dvo.metrics.table import ERRORS
from dvo.odometry.load import build_odometry
from dvo.odometry.protocol import Odometry
from dvo.session.session import FrameCallback, Run, run
from dvo.synth.sequence import SyntheticSequence, make_sequence
from train.engine.checkpoint import SUFFIXES, facts_of, load_any, read_state

VALIDATION_SEED = 900_001  # training seeds are small numbers
SEQUENCES = ("kitti00_120", "7scenes_redkitchen_400", "tartanair_v1_60", "tum_fr1_rpy_60")


def track_sequence(
    odometry: Odometry, frames: Iterable[Frame], truth: Trajectory, on_frame: FrameCallback | None = None
) -> tuple[Metrics, Run]:
    """Track a clip and compare it with its ground truth, each segment aligned on its own
    (:mod:`dvo.metrics.segment_metrics`).

    Ctrl-C is passed on: a part of a clip is no measurement.

    Args:
        odometry: a new one.
        frames: in the order of time.
        truth: ground truth, camera to world.
        on_frame: called after each frame.

    Returns:
        metrics after Sim(3) alignment, with relative errors over a gap of 2 frames; and the run.
    """
    done = run(odometry, frames, on_frame=on_frame, should_stop=lambda: False)
    most = most_worlds(done.frames_fed)
    return evaluate_segments(done.result.segments, truth, rpe_gap=2, most=most).metrics, done


def rendered_clip(index: int, frames: int, size: tuple[int, int], fps: float) -> SyntheticSequence:
    """A rendered validation clip, of a scene that training cannot draw.

    Args:
        index: number of the clip.
        frames: length.
        size: height and width, pixels.
        fps: frames a second.
    """
    height, width = size
    return make_sequence(VALIDATION_SEED + index, frames=frames, height=height, width=width, fps=fps, apart=True)


@torch.no_grad()
def main(arguments: list[str]) -> None:
    """``python -m train validate CHECKPOINT|WEIGHTS``.

    Raises:
        DvoError: no such file, weights whose architecture has no odometry, or sequences that are not there.
    """
    parser = OneLineParser(prog="python -m train validate", description=__doc__)
    parser.add_argument("weights", help="a training checkpoint (.ckpt, .pt), or weights by name or file")
    parser.add_argument("--frames", type=int, help="only the first frames of each sequence")
    parser.add_argument("--rendered", type=int, default=0, help="number of rendered validation clips")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--sequences", nargs="*", default=SEQUENCES)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="tracker settings to try")
    options = parser.parse_args(arguments)
    if Path(options.weights).suffix in SUFFIXES:
        print_line(str(facts_of(read_state(options.weights))))
    weights = load_any(options.weights)
    settings = parse_settings(options.set)

    def new_odometry(seed: int) -> Odometry:
        return build_odometry(weights, device=options.device, seed=seed, **settings)

    for name in options.sequences:
        for seed in range(options.seeds):
            source = open_source(data_root(required=False) / name)
            if source.groundtruth is None:
                raise DvoError("no ground truth", file=source.path, remedy="name sequences with ground truth")
            m, done = track_sequence(new_odometry(seed), islice(source, options.frames), source.groundtruth)
            errors = "  ".join(f"{metric.title} {metric.text(metric.find(m)):>7s}" for metric in ERRORS)
            print_line(
                f"{name:24s} seed {seed} {errors}  lost {done.result.frames_lost}  segments "
                f"{len(worlds_of(done.result.segments))}  {done.frames_per_second:5.1f} fps"
            )
            if m.reason:
                print_line(f"{name}: note: {m.reason}", error=True)
            for warning in done.warnings:
                print_line(f"{name}: note: {warning}", error=True)
    found = []
    for index in range(options.rendered):
        source = rendered_clip(index, 60, (240, 320), 15.0)
        m, _ = track_sequence(new_odometry(0), source, source.groundtruth)
        found.append((m.ate_percent, m.rotation_error_ratio))
        print(f"rendered clip {index}: ATE {m.ate_percent:.2f} %, rotation error/motion {m.rotation_error_ratio:.3f}")
    if found:
        print("rendered, median: ATE {:.2f} %, rotation error/motion {:.3f}".format(*np.nanmedian(found, axis=0)))
