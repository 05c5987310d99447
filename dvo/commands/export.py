"""``dvo export``: write the trajectory of a results folder, or a map file, for another program."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dvo.commands.camera import CALIBRATION
from dvo.commands.console import say
from dvo.core.errors import DvoError
from dvo.data.open import open_source
from dvo.data.source import Source
from dvo.data.trajectory import read_tum
from dvo.export.formats import (
    MAP_FORMATS,
    TRAJECTORY_FORMATS,
    check_formats,
    describe_rows,
    export_graph,
    export_trajectory,
    write_reconstruction,
)
from dvo.export.recorded import reconstruct_recorded
from dvo.map.io.serialisation import load_graph
from dvo.odometry.protocol import SparseMap
from dvo.odometry.segments import result_of_log
from dvo.session import results
from dvo.session.files import read_ply
from dvo.session.run_facts import read_facts


def export(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo export``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: no results folder or map, a format of maps for a results folder or none at all, no such segment, or a
            folder that is not empty.
    """
    folder, name = Path(arguments.source), arguments.to
    if folder.is_file():
        return _export_map_file(folder, arguments.out, name, arguments.segment)
    if not folder.is_dir():
        raise DvoError(
            "not a results folder", file=folder, remedy="give a folder that dvo run has written, or a map file"
        )
    if name in MAP_FORMATS and name not in TRAJECTORY_FORMATS:
        return _export_recorded(folder, arguments.out, name, arguments.segment)
    TRAJECTORY_FORMATS.target(name)  # before any file is read
    trajectory = read_tum(_trajectory_file(folder, arguments.segment))
    export_trajectory(trajectory, arguments.out, name)
    say(f"exported to {arguments.out}: {describe_rows(name, len(trajectory), _frames_read(folder))}")
    return 0


def _export_recorded(folder: Path, out: str, name: str, segment: int | None) -> int:
    """Write a map of a results folder: of the map file that the run has saved, or of the images of its source."""
    facts = read_facts(folder / results.SUMMARY)
    saved = facts.get("map_file")
    if isinstance(saved, str) and Path(saved).is_file():
        return _export_map_file(Path(saved), out, name, segment)
    trajectory = read_tum(_trajectory_file(folder, segment))
    is_main = segment is None or len(trajectory) == len(read_tum(folder / results.TRAJECTORY))
    points = read_ply(folder / results.MAP) if is_main and (folder / results.MAP).is_file() else SparseMap()
    found = reconstruct_recorded(_reopened(folder, facts), trajectory, points)
    write_reconstruction(found, name, out)
    say(f"exported to {out}: {len(found.jpegs)} images of the source, {len(found.points)} points without observations")
    return 0


def _reopened(folder: Path, facts: dict[str, Any]) -> Source:
    """The source of a run, read as the run has read it."""
    inputs, options = facts.get("inputs") or {}, facts.get("options") or {}

    def path(name: str) -> str | None:
        found = (inputs.get(name) or {}).get("path") if isinstance(inputs, dict) else None
        return found if isinstance(found, str) else None

    source = path("source")
    if source is None or not Path(source).exists():
        raise DvoError(
            f"the source of the run is not there ({source or 'a stream'})",
            file=folder,
            remedy="put it back, or track again with --save-map and export the map file",
        )
    own, was_found = folder / CALIBRATION, facts.get("calibration_file")
    if was_found and not own.is_file():
        raise DvoError("the calibration that the run has found is not there", file=own, remedy="put it back")
    calib = str(own) if was_found else path("calib") or options.get("calib")
    names = ("fps", "topic", "start", "end", "mask_invert")
    more = {name: options[name] for name in names if options.get(name) is not None}
    if options.get("max_pixels") is not None:
        more["max_pixels"] = options["max_pixels"] or None
    return open_source(source, calib=calib, times=path("times"), mask=path("mask"), guess=True, **more)


def _export_map_file(file: Path, out: str, name: str, segment: int | None) -> int:
    """Write the last recording of a map file: a segment, or the world with the most poses."""
    check_formats([name])
    graph = load_graph(file)
    result, main = result_of_log(graph.log, {}, None, graph.worlds, graph.recording)
    if segment is not None and segment >= len(result.segments):
        raise DvoError(f"no segment {segment}", file=file, field="--segment", remedy=f"it has {len(result.segments)}")
    if name in MAP_FORMATS:
        chosen = graph.recording.segment + (main if segment is None else segment)
        say(f"exported to {out}: {export_graph(graph, chosen, name, out)}")
        return 0
    trajectory = result.trajectory if segment is None else result.segments[segment].trajectory
    export_trajectory(trajectory, out, name)
    say(f"exported to {out}: {describe_rows(name, len(trajectory), result.frames_read)}")
    return 0


def _trajectory_file(folder: Path, segment: int | None) -> Path:
    if segment is None:
        return folder / results.TRAJECTORY
    if segment == 0 and not (folder / results.segment_file(0)).exists():  # the only one
        return folder / results.TRAJECTORY
    if not (folder / results.segment_file(segment)).is_file():
        raise DvoError(f"no segment {segment}", file=folder, field="--segment", remedy="see segments in run.json")
    return folder / results.segment_file(segment)


def _frames_read(folder: Path) -> int | None:
    """Number of frames of the source, if run.json tells."""
    try:
        return int(read_facts(folder / results.SUMMARY)["frames"]["read"])
    except DvoError:
        return None
