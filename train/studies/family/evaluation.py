"""Measurements of an odometry on held-out sequences."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.frame import Frame
from dvo.data.open import open_source
from dvo.data.trajectory import Trajectory
from dvo.metrics import Metrics
from dvo.metrics.relative_pose import join_segments, relative_pose_errors
from dvo.metrics.segment_metrics import evaluate_segments, most_worlds, worlds_of
from dvo.odometry.protocol import Odometry, Segment
from dvo.session.results import peak_memory_mb
from dvo.session.session import run
from dvo.synth.export import export_sequence
from dvo.synth.sequence import make_sequence


@dataclass(frozen=True)
class Measured:
    """Errors of a trajectory.

    Attributes:
        metrics: after alignment of each world by Sim(3), with relative errors over two frames.
        errors: degrees, of the pairs of frames by their gap, see
            :func:`dvo.metrics.relative_pose.relative_pose_errors`.
        segments: number of worlds.
        fps: frames a second of the processor; nan if nothing was tracked.
    """

    metrics: Metrics
    errors: dict[int, np.ndarray]
    segments: int
    fps: float = float("nan")

    @property
    def pooled(self) -> np.ndarray:
        """Errors of all pairs."""
        return np.concatenate([np.zeros(0), *self.errors.values()])

    def columns(self) -> dict[str, Any]:
        """Values for the table of sequences; the memory is the highest of this process so far."""
        memory = peak_memory_mb()
        return {
            "frames": self.metrics.reference_frames, "posed": self.metrics.matched, "segments": self.segments,
            "ate_percent": self.metrics.ate_percent, "rotation_ratio": self.metrics.rotation_error_ratio,
            "fps": self.fps, "memory_mb": float("nan") if memory is None else memory,
        }  # fmt: skip


def held_out_sequence(folder: Path, options: dict[str, Any]) -> tuple[list[Frame], Trajectory]:
    """Frames and ground truth of a rendered sequence, rendered now unless it lies on disk.

    Args:
        folder: of the sequence, in the layout of TUM RGB-D; it appears under its name when it is whole.
        options: of :func:`dvo.synth.make_sequence`.

    Raises:
        DvoError: options that cannot be rendered, or a folder that cannot be written.
    """
    if not folder.is_dir():
        part = folder.with_name(f".{folder.name}.{os.getpid()}")
        shutil.rmtree(part, ignore_errors=True)
        export_sequence(make_sequence(**options), part, "tum")
        try:
            part.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another process was faster, with the same bytes
                raise
            shutil.rmtree(part)
    source = open_source(folder)
    assert source.groundtruth is not None
    return list(source), source.groundtruth


def measure(odometry: Odometry, frames: Sequence[Frame], truth: Trajectory, gaps: Sequence[int]) -> Measured:
    """Track a sequence and compare the result, after the last frame, with the ground truth.

    The speed is that of the processor time from the first frame to the end of the final optimisation, with as many
    threads as this process has.

    Args:
        odometry: a new one.
        frames: of the sequence.
        truth: its ground truth, camera to world.
        gaps: frames between the two of a pair.
    """
    start = time.process_time()
    done = run(odometry, frames, strict=True)
    seconds = time.process_time() - start
    return errors_of(done.result.segments, truth, gaps, fps=len(frames) / max(seconds, 1e-9))


def errors_of(
    segments: Sequence[Segment], truth: Trajectory, gaps: Sequence[int], fps: float = float("nan")
) -> Measured:
    """Errors of a trajectory in segments.

    Args:
        segments: of a result.
        truth: ground truth of all frames, camera to world.
        gaps: frames between the two of a pair.
        fps: see :class:`Measured`.
    """
    rows, labels = join_segments(segments, truth)
    errors = {gap: relative_pose_errors(rows, truth, gap, labels=labels) for gap in gaps}
    found = evaluate_segments(segments, truth, rpe_gap=2, most=most_worlds(len(truth)))
    return Measured(found.metrics, errors, len(worlds_of(segments)), fps)


def straight_line(truth: Trajectory) -> list[Segment]:
    """Straight line along the optical axis at constant speed, without rotation: an estimate that uses no image.

    Args:
        truth: gives the times.
    """
    times = truth.timestamps
    poses_wc = np.zeros((len(times), 7))
    poses_wc[:, 2], poses_wc[:, 6] = times - times[0], 1.0
    return [Segment(Trajectory(times, poses_wc), float(times[0]), float(times[-1]))]
