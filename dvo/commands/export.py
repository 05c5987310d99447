"""``dvo export``: write the trajectory of a results folder, or a map file, for another program."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.commands.console import TrackingProgress, say
from dvo.commands.picture import world_root
from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.files.output import check_empty
from dvo.data.frame import Frame
from dvo.data.open import open_source
from dvo.data.source import Source
from dvo.data.streams.capture import is_stream
from dvo.data.trajectory import Trajectory, read_tum
from dvo.export.formats import (
    MAP_FORMATS,
    TRAJECTORY_FORMATS,
    check_formats,
    describe_rows,
    export_graph,
    export_trajectory,
    write_reconstruction,
)
from dvo.export.reconstruction import Reconstruction, observe
from dvo.export.recorded import MOST_IMAGES, ImageChoice, recorded_images
from dvo.geometry.camera import Camera
from dvo.map.io.serialisation import load_graph
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.protocol import Result, Status
from dvo.odometry.segments import result_of_log
from dvo.session import results
from dvo.session.frame_table import SKIPPED, FrameRow, near
from dvo.session.results_reader import read_results
from dvo.session.run_facts import REMEDY, read_facts

SOURCE = "source"  # value of --export-images


def export(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo export``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: no results folder or map, no such format or segment, options of images that do not fit, a source that
            is not there any more, or a folder that is not empty.
    """
    check_empty(Path(arguments.out))  # before images are read
    names = list(dict.fromkeys(name.strip() for name in arguments.to.split(",")))
    check_formats(names, option="--to")
    if arguments.every is not None or arguments.count is not None:
        arguments.export_images = arguments.export_images or SOURCE
    check_image_options(arguments, names, "--to")
    folders = [arguments.out] if len(names) == 1 else [str(Path(arguments.out) / name) for name in names]
    for name, out in zip(names, folders, strict=True):
        _export(argparse.Namespace(**{**vars(arguments), "to": name, "out": out}))
    return 0


def _export(arguments: argparse.Namespace) -> None:
    """To one format."""
    folder, name = Path(arguments.source), arguments.to
    if folder.is_file():
        if arguments.export_images == SOURCE:
            message, remedy = "a map file does not know its source", "give the results folder of the run"
            raise DvoError(message, file=folder, field="--export-images", remedy=remedy)
        return _export_map_file(folder, arguments.out, name, arguments.segment)
    if not folder.is_dir():
        raise DvoError(
            "not a results folder", file=folder, remedy="give a folder that dvo run has written, or a map file"
        )
    if name in MAP_FORMATS and name not in TRAJECTORY_FORMATS:
        return _export_recorded(folder, arguments, image_choice(arguments))
    file = _trajectory_file(folder, arguments.segment)
    if not file.is_file():
        raise DvoError("not a results folder", file=folder, remedy="give a folder that dvo run has written")
    trajectory = read_tum(file)
    export_trajectory(trajectory, arguments.out, name)
    say(f"exported to {arguments.out}: {describe_rows(name, len(trajectory), _frames_read(folder))}")


def check_image_options(
    arguments: argparse.Namespace, formats: Sequence[str], option: str, source: Path | str | None = None
) -> None:
    """Refuse options of exported images that mean nothing beside the others.

    Args:
        arguments: of the command line.
        formats: that are exported to.
        option: of the command line that names them.
        source: that is tracked; None if there is none.

    Raises:
        DvoError: images without a format of maps, a choice of images that are not of the source, or images of a stream.
    """
    images = arguments.export_images
    chosen = next((name for name in ("every", "count") if getattr(arguments, name) is not None), None)
    if chosen is not None and images != SOURCE:
        raise DvoError("chooses images of the source", field=f"--{chosen}", remedy="add --export-images source")
    if images is None:
        return
    if not any(name in MAP_FORMATS for name in formats):
        remedy, field = f"use {option} colmap or nerfstudio", f"--{chosen or 'export-images'}"
        raise DvoError("there are images in exported maps alone", field=field, remedy=remedy)
    if images == SOURCE and source is not None and is_stream(source):
        remedy = "record it and track the recording, or leave the option out"
        raise DvoError("a stream cannot be read again", field="--export-images", remedy=remedy)


def image_choice(arguments: argparse.Namespace) -> ImageChoice:
    """Choice of the images of the source.

    Args:
        arguments: of the command line.
    """
    return ImageChoice(arguments.every, arguments.count or MOST_IMAGES)


def export_images(
    source: Source,
    result: Result,
    rows: Sequence[FrameRow],
    graph: KeyframeGraph | None,
    places: Mapping[str, Path],
    choice: ImageChoice,
    segment: int | None = None,
    check: Callable[[], None] = lambda: None,
) -> list[str]:
    """Write images of a source at its recorded size with their poses and the points of a map, for other programs.

    Args:
        source: of the run.
        result: of the run.
        rows: of its frames; those that the stride has left out, and those that inertial samples alone have given a
            pose, are not chosen.
        graph: of the run; None without one: the points of the map are then written without observations.
        places: new folder of each format of maps.
        choice: of the images.
        segment: whose world is written, with all segments in it; None for the longest.
        check: called at every frame; may raise.

    Returns:
        A sentence for each format.

    Raises:
        DvoError: no such segment, no image with a pose, or a folder that is not empty or cannot be written.
    """
    number = result.longest if segment is None else segment
    if number is None or number >= len(result.segments):
        remedy = f"there are {len(result.segments)}"
        raise DvoError(f"no segment {number or 0}", field="--segment", remedy=remedy)
    roots = [world_root(result, k) for k in range(len(result.segments))]
    members = [k for k, root in enumerate(roots) if root == roots[number]]
    trajectory = _tracked([result.segments[k].trajectory for k in members], rows)
    recorded = source.at_recorded_size()
    said = []
    with contextlib.ExitStack() as stack:
        progress = stack.enter_context(TrackingProgress(recorded.frame_count, "reading images"))

        def on_frame(frame: Frame) -> None:
            check()
            progress.update(frame, None)

        images = stack.enter_context(recorded_images(recorded, trajectory, choice, on_frame))
        found = images if graph is None else observe(graph, graph.recording.segment + number, images)
        if found is images and result.longest in members:
            points, colors = result.map.points.astype(np.float64), result.map.colors
            found = replace(images, points=points, colors=colors, errors=np.zeros(len(points)))
        found = replace(found, was_found=not source.calibrated)
        for name, place in places.items():
            write_reconstruction(found, name, place)
            said.append(f"{name}: {_describe(found, sorted(set(range(len(roots))) - set(members)))}")
    return said


def _tracked(parts: Sequence[Trajectory], rows: Sequence[FrameRow]) -> Trajectory:
    """Poses of some segments in order of time, without those that are interpolated or predicted."""
    times = np.concatenate([part.timestamps for part in parts])
    poses = np.concatenate([part.poses_wc for part in parts])
    without = np.array([row.timestamp for row in rows if row.status in (SKIPPED, Status.INERTIAL)])
    chosen = np.flatnonzero(~near(times, without))
    chosen = chosen[np.argsort(times[chosen], kind="stable")]
    return Trajectory(times[chosen], poses[chosen])


def _describe(found: Reconstruction, others: Sequence[int]) -> str:
    sizes = " and ".join(dict.fromkeys(f"{camera.width}x{camera.height}" for camera in found.cameras))
    text = f"{len(found.jpegs)} images of {sizes} from the source{', with masks' if found.masks else ''}"
    text += f", {len(found.points)} points, "
    if len(found.residuals):
        text += f"{len(found.residuals)} observations, mean reprojection error {found.mean_error:.2f} px"
    else:
        text += "without observations"
    if others:
        numbers = ", ".join(map(str, others))
        own = f"segment {numbers} with a world of its own"
        text += f"; left out: {own if len(others) == 1 else f'segments {numbers} with worlds of their own'}"
    return text


def _export_recorded(folder: Path, arguments: argparse.Namespace, choice: ImageChoice) -> None:
    """Write a map of a results folder: of the map file that the run has saved, or of the images of its source."""
    out, name, segment = Path(arguments.out), arguments.to, arguments.segment
    stored = read_results(folder)
    saved = stored.facts.get("map_file")
    file = Path(saved) if isinstance(saved, str) and Path(saved).is_file() else None
    if file is not None and arguments.export_images != SOURCE:
        return _export_map_file(file, arguments.out, name, segment, bool(stored.facts.get("self_calibration")))
    if arguments.export_images not in (None, SOURCE):
        message, remedy = "the run has saved no map file", "track with --save-map, or use --export-images source"
        raise DvoError(message, file=folder, field="--export-images", remedy=remedy)
    graph = None if file is None else load_graph(file)
    source = _reopened(folder, stored.facts)
    for sentence in export_images(source, stored.result, stored.rows, graph, {name: out}, choice, segment):
        say(f"exported to {out}: {sentence.removeprefix(f'{name}: ')}")


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
    calib = path("calib") or options.get("calib")
    if facts.get("self_calibration"):  # found in the images, or a guess, of which there is no file
        calib = _recorded_calibration(facts, folder / results.SUMMARY)
    names = ("fps", "topic", "start", "end", "mask_invert")
    more = {name: options[name] for name in names if options.get(name) is not None}
    if options.get("max_pixels") is not None:
        more["max_pixels"] = options["max_pixels"] or None
    return open_source(source, calib=calib, times=path("times"), mask=path("mask"), guess=True, **more)


def _recorded_calibration(facts: dict[str, Any], file: Path) -> Calibration:
    """Calibration that a run has used, from its run.json."""
    entry = facts.get("camera") or {}
    names = ("fx", "fy", "cx", "cy", "width", "height", "model", "coefficients")
    try:
        camera = Camera(*(entry[name] for name in names))
    except (DvoError, KeyError) as error:
        message = error.message if isinstance(error, DvoError) else "missing"
        raise DvoError(message, file=file, field="camera", remedy=REMEDY) from None
    return Calibration(**asdict(camera), file=file, was_found=True)


def _export_map_file(file: Path, out: str, name: str, segment: int | None, was_found: bool = False) -> None:
    """Write the last recording of a map file: a segment, or the world with the most poses."""
    graph = load_graph(file)
    result, main = result_of_log(graph.log, {}, None, graph.worlds, graph.recording)
    if segment is not None and segment >= len(result.segments):
        raise DvoError(f"no segment {segment}", file=file, field="--segment", remedy=f"it has {len(result.segments)}")
    if name in MAP_FORMATS:
        chosen = graph.recording.segment + (main if segment is None else segment)
        say(f"exported to {out}: {export_graph(graph, chosen, name, out, was_found)}")
        return
    trajectory = result.trajectory if segment is None else result.segments[segment].trajectory
    export_trajectory(trajectory, out, name)
    say(f"exported to {out}: {describe_rows(name, len(trajectory), result.frames_read)}")


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
