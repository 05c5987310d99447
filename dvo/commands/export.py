"""``dvo export``: write the trajectory of a results folder, or a map file, for another program."""

from __future__ import annotations

import argparse
from pathlib import Path

from dvo.commands.console import say
from dvo.core.errors import DvoError
from dvo.data.trajectory import read_tum
from dvo.export.formats import (
    MAP_FORMATS,
    TRAJECTORY_FORMATS,
    check_formats,
    describe_rows,
    export_graph,
    export_trajectory,
)
from dvo.map.io.serialisation import load_graph
from dvo.odometry.segments import result_of_log
from dvo.session import results
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
        raise DvoError(
            f"a results folder holds no keyframes, which '{name}' needs",
            field="--to",
            remedy=f"track again with dvo run --export {name}, or use one of {', '.join(TRAJECTORY_FORMATS)}",
        )
    TRAJECTORY_FORMATS.target(name)  # before any file is read
    trajectory = read_tum(_trajectory_file(folder, arguments.segment))
    export_trajectory(trajectory, arguments.out, name)
    say(f"exported to {arguments.out}: {describe_rows(name, len(trajectory), _frames_read(folder))}")
    return 0


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
