"""Export of maps and trajectories by the name of a format.

A map format is a function of a :class:`~dvo.export.reconstruction.Reconstruction` and an empty folder; a trajectory
format one of a :class:`~dvo.data.trajectory.Trajectory` and a folder. Other packages can add formats of both kinds.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.data.files.output import new_folder
from dvo.data.trajectory import Trajectory
from dvo.session.files import write_error

if TYPE_CHECKING:
    from dvo.export.reconstruction import Reconstruction
    from dvo.map.keyframe_graph import KeyframeGraph
    from dvo.odometry.protocol import Odometry, Result

MAP_FORMATS = Registry(
    "map format",
    "dvo.map_formats",
    {
        "colmap": "dvo.export.colmap:write_colmap",
        "colmap-text": "dvo.export.colmap:write_colmap_text",
        "nerfstudio": "dvo.export.nerfstudio:write_nerfstudio",
    },
)
TRAJECTORY_FORMATS = Registry(
    "trajectory format",
    "dvo.trajectory_formats",
    {
        "tum": "dvo.export.trajectories:write_tum_trajectory",
        "kitti": "dvo.export.trajectories:write_kitti_trajectory",
        "euroc": "dvo.export.trajectories:write_euroc_trajectory",
    },
)
WITHOUT_TIMES = ("kitti",)
"""Trajectory formats whose rows are frames, so that a frame without a pose cannot be told from the next one."""


@checked_arguments
def export_map(
    source: Odometry | KeyframeGraph, folder: Path | str, format: str = "colmap", segment: int | None = None
) -> Reconstruction:
    """Write images, cameras and points of a segment for another program.

    Args:
        source: finished odometry that keeps a keyframe graph, or the graph.
        folder: new or empty folder.
        format: name in :data:`MAP_FORMATS`: ``colmap``, ``colmap-text`` or ``nerfstudio``.
        segment: its number; None for the longest.

    Returns:
        Content of the files.

    Raises:
        DvoError: an odometry without a keyframe graph or that is not finished, an unknown format, no keyframes in the
            segment, or a folder that is not empty or cannot be written.

    Example:
        >>> odometry = dvo.load("small")
        >>> run = dvo.run(odometry, dvo.open("video.mp4", calib="calib.txt"))
        >>> written = dvo.export_map(odometry, "video-colmap")
    """
    from dvo.export.reconstruction import longest_segment
    from dvo.map.keyframe_graph import KeyframeGraph

    graph = graph_of(source)
    if not isinstance(source, KeyframeGraph) and len(graph.window):
        raise DvoError("the sequence is not finished", field="export_map()", remedy="call finish() of the odometry")
    return export_graph(graph, longest_segment(graph) if segment is None else segment, format, folder)


def export_graph(
    graph: KeyframeGraph, segment: int, format: str, folder: Path | str, was_found: bool = False
) -> Reconstruction:
    """Write images, cameras and points of the archived keyframes of a segment.

    Args:
        graph: keyframes of its window are not written.
        segment: its number.
        format: name in :data:`MAP_FORMATS`.
        folder: new or empty folder.
        was_found: the focal length was found in the images, or is a guess.

    Returns:
        Content of the files.

    Raises:
        DvoError: an unknown format, no keyframes with an image in the segment, or a folder that is not empty or cannot
            be written.
    """
    from dvo.export.reconstruction import reconstruct

    MAP_FORMATS.target(format)
    return write_reconstruction(replace(reconstruct(graph, segment), was_found=was_found), format, folder)


def write_reconstruction(reconstruction: Reconstruction, format: str, folder: Path | str) -> Reconstruction:
    """Write images, cameras and points.

    Args:
        reconstruction: to write.
        format: name in :data:`MAP_FORMATS`.
        folder: new or empty folder.

    Returns:
        The same.

    Raises:
        DvoError: an unknown format, or a folder that is not empty or cannot be written.
    """
    write: Callable[[Reconstruction, Path], None] = MAP_FORMATS.resolve(format)
    with _written(Path(folder)) as part:
        write(reconstruction, part)
    return reconstruction


@checked_arguments
def export_trajectory(trajectory: Trajectory, folder: Path | str, format: str = "tum") -> None:
    """Write a trajectory for another program.

    Args:
        trajectory: camera-to-world poses.
        folder: new or empty folder.
        format: name in :data:`TRAJECTORY_FORMATS`: ``tum``, ``kitti`` or ``euroc``.

    Raises:
        DvoError: an unknown format, no poses, or a folder that is not empty or cannot be written.

    Example:
        >>> from dvo.data.trajectory import read_tum
        >>> dvo.export_trajectory(read_tum("runs/demo/trajectory.txt"), "demo-kitti", "kitti")
    """
    write: Callable[[Trajectory, Path], None] = TRAJECTORY_FORMATS.resolve(format)
    if not len(trajectory):
        raise DvoError("no poses", field="trajectory", remedy="export a trajectory of at least one pose")
    with _written(Path(folder)) as part:
        write(trajectory, part)


def export_run(
    odometry: Odometry, result: Result, formats: Iterable[str], folder: Path, was_found: bool = False
) -> list[str]:
    """Write the exports of a run into a new folder ``folder/NAME`` each.

    Map formats hold the longest segment and those that share its world. Trajectory formats hold the longest segment,
    and with several segments all of them in folders ``segment-0``, ``segment-1``, ...

    Args:
        odometry: finished.
        result: its result, in frames of the source, with at least one pose.
        formats: names in :data:`MAP_FORMATS` and :data:`TRAJECTORY_FORMATS`.
        folder: of the exports.
        was_found: the focal length was found in the images, or is a guess.

    Returns:
        A sentence for each format.

    Raises:
        DvoError: as :func:`export_map`.
    """
    from dvo.export.reconstruction import longest_segment

    said = []
    for name in formats:
        if name in MAP_FORMATS:
            graph = graph_of(odometry)
            chosen = longest_segment(graph) if result.longest is None else result.longest + graph.recording.segment
            said.append(f"{name}: {export_graph(graph, chosen, name, folder / name, was_found)}")
            continue
        export_trajectory(result.trajectory, folder / name, name)
        if len(result.segments) > 1:
            for number, segment in enumerate(result.segments):
                export_trajectory(segment.trajectory, folder / name / f"segment-{number}", name)
        said.append(f"{name}: {describe_rows(name, len(result.trajectory), result.frames_read)}")
    return said


def describe_rows(format: str, rows: int, frames: int | None) -> str:
    """Describe the rows of an exported trajectory.

    Args:
        format: name of the format.
        rows: number of poses.
        frames: number of frames of the source; None if unknown.

    Returns:
        A sentence, with the frames that have no pose where the format cannot show them.
    """
    text = f"{rows} poses"
    if format not in WITHOUT_TIMES:
        return text
    missing = 0 if frames is None else frames - rows
    note = f"; {missing} of {frames} frames have no pose in it and no row" if missing > 0 else ""
    return f"{text}{note}; times.txt has the time of each row"


def check_formats(formats: Iterable[str], odometry: Odometry | None = None, *, option: str = "--export") -> None:
    """Check names of formats before a run.

    Args:
        formats: the names.
        odometry: that they are asked of; None for the names alone.
        option: that names them, for messages.

    Raises:
        DvoError: an unknown name, or a map format of an odometry without a keyframe graph.
    """
    for name in formats:
        if name in MAP_FORMATS:
            if odometry is not None:
                graph_of(odometry)
        elif name not in TRAJECTORY_FORMATS:
            known = ", ".join([*MAP_FORMATS, *TRAJECTORY_FORMATS])
            raise DvoError(f"no export format '{name}'", field=option, remedy=f"use one or more of {known}")


def graph_of(source: object) -> KeyframeGraph:
    """Keyframe graph of an odometry.

    Args:
        source: odometry with an attribute ``graph``, or the graph itself.

    Returns:
        The graph.

    Raises:
        DvoError: an odometry without one.
    """
    from dvo.map.keyframe_graph import KeyframeGraph

    graph = source if isinstance(source, KeyframeGraph) else getattr(source, "graph", None)
    if isinstance(graph, KeyframeGraph):
        return graph
    raise DvoError(
        f"{getattr(source, 'name', type(source).__name__)} keeps no keyframe graph, and so no map to export",
        field="export",
        remedy=f"use patch_vo weights such as 'small', or a trajectory format: {', '.join(TRAJECTORY_FORMATS)}",
    )


@contextlib.contextmanager
def _written(folder: Path) -> Iterator[Path]:
    """:func:`dvo.data.files.output.new_folder`, with errors of the system as invalid input."""
    try:
        with new_folder(folder) as part:
            yield part
    except OSError as error:
        raise write_error(folder, error) from error
