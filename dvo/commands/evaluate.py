"""``dvo evaluate``: errors of trajectories against a reference, without a run, and all of them in one picture."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvo.commands import NOTHING_TRACKED, OK
from dvo.commands.base_frame import is_metric
from dvo.commands.console import say, warn
from dvo.commands.places import check_outputs
from dvo.commands.report import error_text
from dvo.core.errors import DvoError
from dvo.data.files.output import check_place, replaced
from dvo.data.open import open_source
from dvo.data.readers.groundtruth import read_groundtruth, rows_without_times
from dvo.data.trajectory import Trajectory
from dvo.metrics import Metrics, align_trajectory, associate, other_convention
from dvo.metrics import evaluate as errors_of
from dvo.metrics.table import shown
from dvo.session import results
from dvo.session.run_facts import read_facts
from dvo.viz.plot import Panel, Track, plot_panels

PICTURES = (".png", ".pdf", ".svg", ".jpg")


@dataclass(frozen=True)
class _Compared:
    label: str
    trajectory: Trajectory
    metrics: Metrics


def evaluate(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo evaluate``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code: 0, or 1 if no estimate can be compared.

    Raises:
        DvoError: a file that cannot be read, or a picture that cannot be written.
    """
    out = None if arguments.out is None else Path(arguments.out)
    if out is not None:
        if out.suffix.lower() not in PICTURES:
            remedy = f"name it {', '.join(PICTURES)}"
            raise DvoError("not the name of a picture", file=out, field="--out", remedy=remedy)
        inputs = {f"ESTIMATE {text}": _file(text) for text in arguments.estimates}
        check_outputs({"--out": out}, {"REFERENCE": _file(arguments.reference), **inputs})
        check_place(out, "--out")
    given = [arguments.reference, *arguments.estimates]
    frames = _frames(given)
    reference = _read(arguments.reference, frames)
    if _is_up_to_scale(Path(arguments.reference)):
        say(f"note: {arguments.reference} is up to scale: m is its unit, no metre")
    found = []
    for text in arguments.estimates:
        trajectory = _read(text, frames)
        metrics = errors_of(trajectory, reference, arguments.align, max_dt=arguments.max_dt)
        found.append(_Compared(text, trajectory, metrics))
        _print(found[-1], reference, arguments.align)
        if (looks := other_convention(trajectory, reference, arguments.max_dt)) is not None:
            warn(f"{arguments.reference} looks like {looks}, or else {text} does")
    good = [one for one in found if one.metrics.reason is None]
    if out is not None and good:
        _draw(out, good, reference, arguments)
        say(f"picture in {out}")
    elif out is not None:
        warn(f"{out} is not drawn: nothing can be compared")
    return OK if good else NOTHING_TRACKED


def _file(text: str) -> Path:
    """File of a trajectory: in a results folder, the one of the run."""
    path = Path(text)
    return path / results.TRAJECTORY if path.is_dir() else path


def _frames(texts: Sequence[str]) -> np.ndarray | None:
    """Numbers of the frames in place of times, if the files have no times or such numbers (KITTI); None if all have.

    Raises:
        DvoError: a file that is not there, some with times and some without, or other numbers of rows.
    """
    for text in texts:
        if not (_file(text).is_file() or text == texts[0] and _is_data_set(text)):
            remedy = "give trajectories (TUM), or results folders of dvo run"
            raise DvoError("no such file", file=_file(text), remedy=remedy)
    rows = [None if _is_data_set(text) else rows_without_times(_file(text)) for text in texts]
    if all(count is None for count in rows):
        return None
    for text, count in zip(texts, rows, strict=True):
        if count != rows[0] and not (count is None and rows[0] and _are_numbers(_file(text), rows[0])):
            first = "times" if rows[0] is None else f"{rows[0]} rows without times"
            this = "times" if count is None else f"{count} rows without times"
            remedy = "give trajectories with times, or one row for each image in all of them"
            raise DvoError(f"{this}, but {texts[0]} has {first}", file=_file(text), remedy=remedy)
    return np.arange(rows[0] or 0, dtype=np.float64)


def _is_data_set(text: str) -> bool:
    """True for a folder that is not one of results: its ground truth is a reference, and no estimate."""
    path = Path(text)
    return path.is_dir() and not any((path / name).is_file() for name in (results.TRAJECTORY, results.SUMMARY))


def _are_numbers(file: Path, frames: int) -> bool:
    """True for times that are the numbers of frames."""
    times = read_groundtruth(file, None).timestamps
    return bool(((times == np.rint(times)) & (times >= 0) & (times < frames)).all())


def _labels(texts: Sequence[str]) -> list[str]:
    """The ends of the paths, as long as they need to be to differ."""
    parts = [Path(text).parts for text in texts]
    for count in range(1, max(map(len, parts)) + 1):
        ends = [str(Path(*part[-count:])) if part else text for part, text in zip(parts, texts, strict=True)]
        if len(set(ends)) == len(set(texts)):
            return ends
    return list(texts)


def _is_up_to_scale(path: Path) -> bool:
    """True for the results of a run without a metric scale."""
    file = path / results.SUMMARY
    return file.is_file() and not is_metric(read_facts(file)["info"])


def _read(text: str, frames: np.ndarray | None) -> Trajectory:
    if _is_data_set(text):
        groundtruth = open_source(text, guess=True, imu="none").groundtruth
        if groundtruth is None:
            remedy = "give a trajectory (TUM), or a results folder of dvo run"
            raise DvoError("a data set without ground truth", file=text, remedy=remedy)
        return groundtruth
    return read_groundtruth(_file(text), frames)


def _print(one: _Compared, reference: Trajectory, align: str) -> None:
    metrics = one.metrics
    if metrics.reason is not None:
        warn(f"{one.label}: no error: {metrics.reason} ({_span(one.trajectory)}, the reference {_span(reference)})")
        return
    relative = ", ".join(f"{text} {m.unit}" for m, text in shown(metrics, ("rpe_trans", "rpe_rot_deg")))
    scale = f", scale {metrics.scale:.4g}" if align in ("sim3", "scale") else ""
    say(f"{one.label}: {error_text(metrics)}, RPE {relative} a frame, {metrics.matched} poses{scale}")


def _span(trajectory: Trajectory) -> str:
    times = trajectory.timestamps
    return f"times from {times[0]:.3f} to {times[-1]:.3f} s" if len(times) else "no poses"


def _draw(out: Path, found: list[_Compared], reference: Trajectory, arguments: argparse.Namespace) -> None:
    """All estimates, aligned, over the part of the reference that they span."""
    tracks, spans = [], []
    labels = _labels([one.label for one in found])
    for colour, (one, name) in enumerate(zip(found, labels, strict=True)):
        _, rows = associate(one.trajectory, reference, arguments.max_dt)
        spans += [rows.min(), rows.max()]
        aligned = align_trajectory(one.trajectory, reference, arguments.align, arguments.max_dt)
        label = f"{name[-40:]}, {one.metrics.ate_percent:.2f} %"
        tracks.append(Track(aligned, label, colour))
    span = slice(int(min(spans)), int(max(spans)) + 1)
    truth = Trajectory(reference.timestamps[span], reference.poses_wc[span])
    title, subtitle = Path(arguments.reference).name, f"after {arguments.align} alignment"
    try:
        with replaced(out) as part:
            plot_panels(part, [Panel(tuple(tracks), reference=truth)], title=title, subtitle=subtitle)
    except OSError as error:
        raise DvoError(error.strerror or str(error), file=out, field="--out", remedy="give another file") from error
