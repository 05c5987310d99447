"""Map files of version 2, which held a tracker to go on with: what is read of it is its map."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from dvo.map.io.map_file import MapReader
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.finishing import run_information
from dvo.odometry.patch.initialisation import NOT_INITIALISED
from dvo.odometry.patch.map_tables import LoopTable, MapTable
from dvo.odometry.scale.metric_scale import settle_scale

if TYPE_CHECKING:
    from dvo.odometry.patch.tracker import PatchOdometry

OLD_VERSION = 2
"""Last version of the format of such files."""

_GONE = {"align": "always"}
"""Values of settings that are gone."""

T = TypeVar("T")


@dataclass(frozen=True)
class OldTracker:
    """Plain values of a tracker.

    Attributes:
        name, seed, config, readout, rows: see :class:`dvo.odometry.patch.map_tables.MapTable`.
        info: metadata for run.json, without those of loops and without counts.
        keyframes: number of identifiers of keyframes given so far.
        initialised: the segment in progress is.
        finished: none is in progress.
        adjustable: segments that were initialised.
    """

    name: str
    seed: int
    config: TrackerConfig
    readout: float
    rows: float
    info: dict[str, Any]
    keyframes: int
    initialised: bool
    finished: bool
    adjustable: tuple[int, ...]

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {**MapTable.RANGES, "keyframes": (0, 2**31 - 1)}

    def table(self) -> MapTable:
        """The same as that of a map."""
        return MapTable(self.name, self.seed, self.config, self.adjustable, self.readout, self.rows, self.info)


@dataclass(frozen=True)
class OldLoops:
    """Plain values of the loop closure of a tracker.

    Attributes:
        loops: confirmed ones.
        corrections: number of corrections by loops.
        adjuster: ``records`` of global adjustments, and what was in progress; None without any.
    """

    loops: tuple[LoopTable, ...]
    corrections: int
    adjuster: dict[str, Any] | None = None


def old_table(source: MapReader, kind: type[T], name: str) -> T:
    """Read a table of a file; entries that are not known are left out, such as settings that are gone.

    A setting with a value that is gone has its default.

    Args:
        source: map file of version 2; its description is changed.
        kind: dataclass of the table.
        name: of the table.

    Raises:
        DvoError: a missing or invalid value.
    """
    entry = _known(kind, source.description.get(name))
    if isinstance(entry, dict) and "config" in entry:
        settings = _known(TrackerConfig, entry["config"])
        if isinstance(settings, dict):
            settings = {k: value for k, value in settings.items() if k not in _GONE or value != _GONE[k]}
        entry["config"] = settings
    source.description[name] = entry
    return source.table(kind, name)


def close_old_sequence(source: MapReader, odometry: PatchOdometry, tracker: OldTracker, loops: OldLoops) -> MapTable:
    """Close the segment of a sequence in progress, and put the metadata of its result together.

    Args:
        source: the file.
        odometry: newly built; its graph has been read, with the keyframes of the window archived, and its loops.
        tracker, loops: tables of the file.

    Returns:
        Table of the map.

    Raises:
        DvoError: fewer keyframes than there are.
    """
    graph, config, scale = odometry.graph, tracker.config, {}
    if not tracker.finished:
        first = max((frame.identifier for frame in graph.archive), default=-1) + 1
        source.require(tracker.keyframes >= first, "fewer keyframes than there are", "tracker: keyframes")
        graph.begin_segment(tracker.keyframes, tracker.initialised, NOT_INITIALISED)
        scale = settle_scale(graph, tracker.adjustable, config.scale, odometry.loops)
    state = replace(odometry.state, adjustable=list(tracker.adjustable), info=tracker.info)
    closer = replace(odometry.loops, enabled=config.loops, corrections=loops.corrections)
    info = run_information(graph, state, config, closer, tracker.seed) | scale
    records = (loops.adjuster or {}).get("records")
    info |= {"adjustments": records} if records else {}
    return replace(tracker.table(), info={k: value for k, value in info.items() if k not in ("seed", "config")})


def _known(kind: type, entry: Any) -> Any:
    """Entries of a table that a dataclass has fields for."""
    names = {field.name for field in fields(kind)}
    return {name: value for name, value in entry.items() if name in names} if isinstance(entry, dict) else entry
