"""``dvo run``: track a source and write a results folder."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import torch

import dvo
from dvo.commands import INTERRUPTED, NOTHING_TRACKED, OK
from dvo.commands.console import InterruptSwitch, TrackingProgress, device_of, seed_everything
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from dvo.metrics import Metrics, align_trajectory, associate, evaluate, fit_alignment
from dvo.odometry import results, session
from dvo.odometry.protocol import Odometry
from dvo.settings import parse_settings, read_settings
from dvo.viz.plot import plot_trajectory


class Clip(Protocol):
    """Interface of a clip to track: :class:`dvo.data.Source`, or the rendered clip of the demo.

    Attributes:
        name: of the clip.
        groundtruth: camera-to-world poses, metres; None if there are none.
    """

    name: str
    groundtruth: Trajectory | None

    @property
    def frame_count(self) -> int | None:
        """Number of frames; None if unknown."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """Assumptions and problems of reading, a sentence each."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...


def run(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo run``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code, see :func:`track`.

    Raises:
        DvoError: invalid source, weights, device or settings, or a folder that cannot be written.
    """
    device = device_of(arguments.device)
    source = dvo.open(
        arguments.source,
        calib=arguments.calib,
        times=arguments.times,
        fps=arguments.fps,
        groundtruth=arguments.groundtruth,
    )
    for warning in source.warnings:
        print(f"dvo: note: {warning}", file=sys.stderr)
    seed_everything(arguments.seed)
    odometry = load_odometry(arguments, device)
    facts = {
        "source": str(arguments.source),
        "kind": getattr(source, "kind", None),
        "calibration": arguments.calib,
        "groundtruth": arguments.groundtruth,
        "weights": arguments.weights,
        "device": str(device),
        "seed": arguments.seed,
        "stride": arguments.stride,
    }
    return track(odometry, source, arguments.out, stride=arguments.stride, facts=facts)


def load_odometry(arguments: argparse.Namespace, device: torch.device) -> Odometry:
    """Load the odometry of ``--weights`` with the settings of ``--config``, overridden by those of ``--set``.

    Args:
        arguments: of the command line.
        device: of all computation.

    Returns:
        The odometry.

    Raises:
        DvoError: no such weights, or an unknown or invalid setting.
    """
    settings = read_settings(arguments.config) if arguments.config else {}
    settings |= parse_settings(arguments.set)
    reserved = sorted(set(settings) & {"weights", "device", "seed", "config"})
    if reserved:
        raise DvoError("not a setting of the odometry", field=reserved[0], remedy="use the option of that name")
    return dvo.load(arguments.weights, device=device, seed=arguments.seed, **settings)


def track(odometry: Odometry, clip: Clip, out: str | None, *, stride: int = 1, facts: dict[str, Any]) -> int:
    """Track a clip, write the results folder and print a summary.

    The first Ctrl-C ends tracking and still writes all results; a second one aborts.

    Args:
        odometry: newly built.
        clip: frames in order of time, with or without ground truth.
        out: results folder; None for ``runs/NAME-TIME``.
        stride: distance of tracked frames, in frames of the clip.
        facts: metadata to write into run.json.

    Returns:
        Exit code: 0, 1 if no frame was tracked, 130 after Ctrl-C.

    Raises:
        DvoError: no frame could be read, or the folder cannot be written.
    """
    is_new = out is None or not Path(out).exists()
    folder = results.make_folder(out, clip.name)
    printed = set(clip.warnings)
    try:
        with InterruptSwitch() as switch, TrackingProgress(clip.frame_count) as progress:
            done = session.run(
                odometry, clip, stride=stride, on_frame=progress.update, should_stop=lambda: switch.pressed
            )
            metrics = _score(done, clip.groundtruth)
            facts = {"odometry": odometry.name, **facts, "metrics": None if metrics is None else asdict(metrics)}
            results.write_results(folder, done, facts)
            _draw(folder, done, clip, odometry.name, metrics)
    except BaseException:
        if is_new:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()
        raise
    for warning in done.warnings:
        if warning not in printed:
            print(f"dvo: warning: {warning}", file=sys.stderr)
    _report(folder, done, metrics)
    if done.interrupted:
        return INTERRUPTED
    return OK if len(done.result.trajectory) else NOTHING_TRACKED


def _score(done: session.Run, groundtruth: Trajectory | None) -> Metrics | None:
    return None if groundtruth is None else evaluate(done.result.trajectory, groundtruth, align="sim3")


def _draw(folder: Path, done: session.Run, clip: Clip, name: str, metrics: Metrics | None) -> None:
    """Write the plot, in the frame of the ground truth if there is one."""
    trajectory, points, reference = done.result.trajectory, done.result.map.points, clip.groundtruth
    if reference is not None:
        i, j = associate(trajectory, reference)
        if metrics is not None and metrics.reason is None:
            scale, rotation, shift = fit_alignment(trajectory.positions[i], reference.positions[j], "sim3")
            points = scale * points @ rotation.T + shift
            trajectory = align_trajectory(trajectory, reference, "sim3")
        else:  # without an alignment the two frames are unrelated
            reference = None
        if reference is not None:  # ground truth may be longer than the clip
            span = slice(j.min(), j.max() + 1)
            reference = Trajectory(reference.timestamps[span], reference.poses_wc[span])
    plot_trajectory(
        folder / results.PICTURE,
        trajectory,
        reference=reference,
        points=points,
        title=clip.name,
        subtitle=_headline(done, metrics),
        label=name,
    )


def _headline(done: session.Run, metrics: Metrics | None) -> str:
    counts = f"{len(done.result.trajectory)} of {done.result.frames_read} frames tracked"
    return counts if metrics is None or metrics.reason else f"{_ate(metrics)}, {counts}"


def _ate(metrics: Metrics) -> str:
    return f"ATE {metrics.ate_rmse:.3g} m ({metrics.ate_percent:.2f} % of {metrics.path_length:.3g} m)"


def _report(folder: Path, done: session.Run, metrics: Metrics | None) -> None:
    result = done.result
    print(
        f"tracked {len(result.trajectory)} of {result.frames_read} frames, {done.frames_per_second:.1f} frames/s, "
        f"{len(result.map.points)} map points"
    )
    if metrics is not None and metrics.reason:
        print(f"no error against ground truth: {metrics.reason}")
    elif metrics is not None:
        relative = f"RPE {metrics.rpe_trans:.3g} m and {metrics.rpe_rot_deg:.3g} deg a frame"
        print(f"{_ate(metrics)} after Sim(3) alignment, {relative}")
    files = (results.TRAJECTORY, results.MAP, results.PICTURE, results.SUMMARY)
    print(f"results in {folder}/: {', '.join(files)}")
