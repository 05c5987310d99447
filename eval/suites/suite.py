"""Suites of sequences (configs/eval/*.yaml) and where their data lie."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.settings import Range, from_table
from dvo.core.yaml_files import read_yaml
from dvo.data.companions.depth_source import with_depth
from dvo.data.companions.right_source import with_right
from dvo.data.inertial import InertialSamples
from dvo.data.open import open_source
from dvo.data.source import Source
from dvo.data.trajectory import Trajectory
from dvo.metrics import Alignment, associate
from eval.scoring.metric_table import JUDGES
from eval.suites.axes import Axes, choose, expand, read_axes
from eval.suites.inertial import InertialTruth, read_stream
from eval.suites.rendered import rendered_folder

ROOT = Path(__file__).resolve().parents[2]
SUITES = ROOT / "configs" / "eval"
RENDERED = ("axes", "memory", "world", "inertial")
"""Files of rendered suites; each is also the name of all suites in it, unless one of them has this name."""
LONGEST_NAME = 100
Judge: Any = Literal[JUDGES]
"""Names of the metrics that can decide between systems."""


@dataclass(frozen=True)
class Sequence:
    """One recording, or rendering, with ground truth.

    Attributes:
        name: in the tables.
        path: folder or file, relative to the data folder; empty if rendered.
        judged_by: name of the metric that decides between systems (:mod:`eval.scoring.metric_table`):
            ``ate_percent``, where scale is weak ``rpe_rot_deg``, or ``recovery_s`` where the question is if a place is
            found again.
        about: a few words.
        calib, times, groundtruth: files relative to the folder, where the layout itself does not say.
        start, end: part of the recording: seconds since its first frame (``"2.5"``), or the number of a frame
            (``"120f"``); the end is not in it.
        depth: folder or list of depth images, where the layout itself does not say; of a 16-bit folder in millimetres.
        right: folder of the right images of a rectified stereo pair, ``baseline`` metres apart.
        rendered: options of :func:`dvo.synth.make_sequence` and ``version``, as pairs, for a sequence that is rendered
            into a cache (:mod:`eval.suites.rendered`) when it is first wanted; None for a recording.
        clip: name of the sequence whose rendering it is, if that is another one.
        inertial: options of :class:`eval.suites.inertial.Stream`, as pairs, of a rendered sequence whose frames carry
            inertial samples; None for those of the recording.
    """

    name: str
    path: str = ""
    judged_by: Judge = "ate_percent"
    about: str = ""
    calib: str | None = None
    times: str | None = None
    groundtruth: str | None = None
    start: str | None = None
    end: str | None = None
    depth: str | None = None
    right: str | None = None
    baseline: float | None = None
    rendered: tuple[tuple[str, Any], ...] | None = None
    clip: str = ""
    inertial: tuple[tuple[str, Any], ...] | None = None

    @property
    def rendering(self) -> tuple[str, dict[str, Any]]:
        """Name and options of the rendering; of a rendered sequence."""
        return self.clip or self.name, dict(self.rendered or ())


@dataclass(frozen=True)
class Suite:
    """Sequences and the protocol under which systems are compared on them.

    Attributes:
        name: of the suite, in results.csv.
        label: what the suite is used for; printed above the table.
        sequences: in the order of the table.
        alignment: fitted before errors are taken.
        rpe_gap: frame gap of the relative errors; their median is reported.
        stride: every how many-th image is fed.
        lost_below: a run with poses for a smaller part of the frames counts as failed.
        time_limit: seconds for one run.
        download: where the data can be had, if they are public.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "rpe_gap": (1, 10**6),
        "stride": (1, 10**6),
        "lost_below": (0.0, 1.0),
        "time_limit": (0.1, 10**7),
    }

    name: str
    label: str
    sequences: tuple[Sequence, ...]
    alignment: Alignment = "sim3"
    rpe_gap: int = 2
    stride: int = 1
    lost_below: float = 0.5
    time_limit: float = 1800.0
    download: str = ""

    def only(self, names: list[str]) -> Suite:
        """The suite with these sequences.

        Raises:
            DvoError: a name that is not in it.
        """
        known = {sequence.name: sequence for sequence in self.sequences}
        for name in names:
            if name not in known:
                raise DvoError(
                    f"no sequence '{name}' in the suite '{self.name}'",
                    field="--sequences",
                    remedy=f"choose from {', '.join(known)}",
                )
        return replace(self, sequences=tuple(known[name] for name in names))


def read_suites(text: str) -> list[Suite]:
    """Suites by name.

    ``fast`` is the mini tier of the validation split of a rendered axis, ``fast/test``, ``fast/large`` and
    ``fast/test/large`` the others; ``axes`` (or ``axes/test``, ...) names all twelve, ``memory`` those in which a
    place is seen again, ``world`` those of ordinary footage. Anything else is the name of a config or a file, as for
    :func:`read_suite`.

    Args:
        text: NAME, NAME/SPLIT/TIER, or a file.

    Raises:
        DvoError: no such suite.
    """
    name = text.split("/")[0]
    for group in RENDERED:
        table = _rendered(group)
        if name == group or name in table.axes:
            return [
                _suite(expand(table, axis, split, tier), SUITES / f"{group}.yaml")
                for axis, split, tier in choose(text, table, group)
            ]
    return [read_suite(text)]


def suite_names() -> list[str]:
    """Names of all suites for :func:`read_suites`: files of configs/eval, for a rendered group those of its axes."""
    files = sorted(file.stem for file in SUITES.glob("*.yaml"))
    return [name for file in files for name in (_rendered(file).axes if file in RENDERED else [file])]


def read_suite(name_or_file: str | Path) -> Suite:
    """A suite by name (configs/eval/NAME.yaml) or from a file.

    Args:
        name_or_file: name of a config, or a YAML file.

    Raises:
        DvoError: no such suite, or a file with unknown or missing settings.
    """
    path = Path(name_or_file)
    if path.suffix not in (".yaml", ".yml"):
        path = SUITES / f"{name_or_file}.yaml"
    if not path.is_file():
        names = ", ".join(dict.fromkeys([*suite_names(), *RENDERED]))
        raise DvoError("no such suite", file=path, field="--suite", remedy=f"give a file, or one of: {names}")
    return _suite(read_yaml(path), path)


def _rendered(group: str) -> Axes:
    file = SUITES / f"{group}.yaml"
    return read_axes(read_yaml(file), file)


def _suite(table: Any, path: Path) -> Suite:
    """Suite from its table, every entry checked."""
    if not isinstance(table, dict) or not isinstance(table.get("sequences"), list):
        raise DvoError("no list of sequences", file=path, field="sequences", remedy="see configs/eval/validation.yaml")
    # A file has the options of a rendered sequence as a table.
    entries = [
        {**entry, "rendered": [list(option) for option in sorted(entry["rendered"].items(), key=str)]}
        if isinstance(entry, dict) and isinstance(entry.get("rendered"), dict)
        else entry
        for entry in table["sequences"]
    ]
    suite = from_table(Suite, {**table, "sequences": entries}, path)
    names = [sequence.name for sequence in suite.sequences]
    for number, sequence in enumerate(suite.sequences):
        place = f"sequences[{number}]"
        _check_name(sequence.name, f"{place}: name", path)
        if sequence.name in names[:number]:
            raise DvoError(f"twice the name '{sequence.name}'", file=path, field=place, remedy="give another name")
        if "://" in sequence.path:
            remedy = "give a folder or file of the data"
            raise DvoError("a stream cannot be evaluated", file=path, field=f"{place}: path", remedy=remedy)
        if not sequence.path and sequence.rendered is None:
            raise DvoError(f"{sequence.name} has no path", file=path, field=f"{place}: path", remedy="add it")
    _check_name(suite.name, "name", path)
    if not names:
        raise DvoError("empty", file=path, field="sequences", remedy="see configs/eval/validation.yaml")
    return suite


def _check_name(name: str, field: str, path: Path) -> None:
    if not name.strip():
        raise DvoError("empty", file=path, field=field, remedy="give a name")
    if len(name) > LONGEST_NAME:  # it becomes the name of a folder
        message = f"longer than {LONGEST_NAME} characters"
        raise DvoError(message, file=path, field=field, remedy="give a shorter name")


def open_sequence(sequence: Sequence, data: Path, stride: int) -> tuple[Source, Trajectory]:
    """The frames of a sequence and its ground truth; rendered ones are rendered if they are not in the cache.

    Args:
        sequence: of a suite.
        data: folder of the recordings.
        stride: every how many-th image is opened.

    Raises:
        DvoError: the data are not there, or hold no ground truth.
    """
    place = data / sequence.path if sequence.rendered is None else rendered_folder(*sequence.rendering)
    source = open_source(
        place,
        calib=sequence.calib,
        times=sequence.times,
        groundtruth=sequence.groundtruth,
        stride=stride,
        start=sequence.start,
        end=sequence.end,
    )
    if sequence.depth is not None:
        source = with_depth(source, sequence.depth)
    if sequence.right is not None:
        source = with_right(source, sequence.right, sequence.baseline)
    if sequence.inertial is not None:
        source = _with_stream(source, read_stream(place, dict(sequence.inertial))[0])
    if source.groundtruth is None:
        raise DvoError("no ground truth", file=place, remedy="name its file under 'groundtruth'")
    return source, source.groundtruth


def inertial_truth(sequence: Sequence) -> InertialTruth | None:
    """Truth about the inertial samples of a sequence; None without any that are known exactly.

    Args:
        sequence: of a suite.

    Raises:
        DvoError: it cannot be rendered.
    """
    if sequence.inertial is None:
        return None
    return read_stream(rendered_folder(*sequence.rendering), dict(sequence.inertial))[1]


def _with_stream(source: Source, samples: InertialSamples) -> Source:
    """The source with other inertial samples."""
    return Source(source.recording, replace(source.reading, inertial=lambda: samples))


def reference_for(groundtruth: Trajectory, stamps: np.ndarray, max_dt: float = 0.02) -> Trajectory:
    """The ground truth of exactly the frames that were fed: one row for each that has one, at the frame's time.

    Args:
        groundtruth: of the whole sequence.
        stamps: ``(N,)`` of the frames fed, seconds.
        max_dt: largest difference of matched stamps, seconds.
    """
    fed, rows = associate(Trajectory(stamps, np.zeros((len(stamps), 7))), groundtruth, max_dt)
    return Trajectory(stamps[fed], groundtruth.poses_wc[rows])
