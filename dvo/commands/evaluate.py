"""``dvo evaluate``: errors of trajectories against a reference, without a run, and all of them in one picture."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from dvo.commands import NOTHING_TRACKED, OK
from dvo.commands.console import say, warn
from dvo.commands.places import check_outputs
from dvo.commands.report import error_text
from dvo.core.errors import DvoError
from dvo.data.files.output import check_place, replaced
from dvo.data.readers.groundtruth import read_groundtruth
from dvo.data.trajectory import Trajectory
from dvo.metrics import Metrics, align_trajectory, associate
from dvo.metrics import evaluate as errors_of
from dvo.metrics.table import shown
from dvo.session import results
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
    reference = _read(arguments.reference)
    found = []
    for text in arguments.estimates:
        trajectory = _read(text)
        metrics = errors_of(trajectory, reference, arguments.align, max_dt=arguments.max_dt)
        found.append(_Compared(text, trajectory, metrics))
        _print(found[-1], reference, arguments.align)
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


def _read(text: str) -> Trajectory:
    path = _file(text)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy="give trajectories (TUM), or results folders of dvo run")
    return read_groundtruth(path, None)


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
    for colour, one in enumerate(found):
        _, rows = associate(one.trajectory, reference, arguments.max_dt)
        spans += [rows.min(), rows.max()]
        aligned = align_trajectory(one.trajectory, reference, arguments.align, arguments.max_dt)
        label = f"{one.label[-40:]}, {one.metrics.ate_percent:.2f} %"
        tracks.append(Track(aligned, label, colour))
    span = slice(int(min(spans)), int(max(spans)) + 1)
    truth = Trajectory(reference.timestamps[span], reference.poses_wc[span])
    title, subtitle = Path(arguments.reference).name, f"after {arguments.align} alignment"
    try:
        with replaced(out) as part:
            plot_panels(part, [Panel(tuple(tracks), reference=truth)], title=title, subtitle=subtitle)
    except OSError as error:
        raise DvoError(error.strerror or str(error), file=out, field="--out", remedy="give another file") from error
