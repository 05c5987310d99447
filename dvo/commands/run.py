"""``dvo run``: track a source and write a results folder."""

from __future__ import annotations

import argparse
import contextlib
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch

import dvo
from dvo.commands import NOTHING_TRACKED, OK, Terminated
from dvo.commands.base_frame import base_observers
from dvo.commands.camera import calibration_origin, with_calibration
from dvo.commands.console import InterruptSwitch, TrackingProgress, device_of, say, seed_everything, warn
from dvo.commands.export import SOURCE, check_image_options, export_images, image_choice
from dvo.commands.input_options import input_facts, input_settings, print_input
from dvo.commands.maps import load_in_map
from dvo.commands.observers import open_observers
from dvo.commands.picture import draw
from dvo.commands.places import check_apart, check_outputs
from dvo.commands.report import Scores, describe_seconds, headline, print_report, score
from dvo.commands.request import request_facts
from dvo.commands.run_options import INPUTS
from dvo.commands.scale import scale_observers, scale_settings, scaled_source
from dvo.commands.streams import print_counts, stream_facts
from dvo.commands.summary import Pages
from dvo.core.allocator import without_old_garbage
from dvo.core.errors import DvoError
from dvo.core.settings import parse_settings, read_settings
from dvo.data.files.output import check_place
from dvo.data.frame import Frame
from dvo.data.source import Source
from dvo.data.streams.capture import is_stream, shown
from dvo.data.trajectory import Trajectory
from dvo.export.formats import TRAJECTORY_FORMATS, check_formats, export_run
from dvo.export.recorded import ImageChoice
from dvo.metrics import other_convention
from dvo.odometry.load import check_early
from dvo.odometry.protocol import Estimate, Odometry, Saveable
from dvo.odometry.registry import SYSTEMS, build_system
from dvo.session import results, session
from dvo.session.frame_table import FrameTable
from dvo.session.observer import Observer, graph_of
from dvo.session.recorder import Recorder
from dvo.viz.thumbnails import Thumbnails

_ABORTED = "aborted by a second Ctrl-C, SIGTERM or SIGHUP"


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
        DvoError: invalid source, weights, device, settings or export, or a folder that cannot be written.
    """
    check_formats(arguments.export)
    check_image_options(arguments, arguments.export, "--export", arguments.source)
    device = device_for(arguments)
    check_settings_early(arguments)
    early: Odometry | None = None
    if is_stream(arguments.source):  # frames arrive from its opening on
        seed_everything(arguments.seed)
        early = load_odometry(arguments, device)
    source = dvo.open(
        arguments.source,
        calib=arguments.calib,
        groundtruth=arguments.groundtruth,
        guess=True,
        queue=arguments.queue,
        **input_settings(arguments),
    )
    source = scaled_source(source, arguments)
    for warning in source.warnings:
        warn(warning, "note")
    facts = {
        "source": shown(str(arguments.source)),
        "kind": getattr(source, "kind", None),
        **stream_facts(source),
        "calibration": calibration_origin(source, arguments.calib),
        "readout": source.camera.readout,
        "groundtruth": arguments.groundtruth,
        "weights": arguments.weights if arguments.system is None else None,
        "device": str(device),
        "seed": arguments.seed,
        "stride": arguments.stride,
        **input_facts(arguments, source),
        **request_facts(arguments),
    }
    seed_everything(arguments.seed)
    folders = results.results_folder(
        arguments.out, source.name, overwrite=arguments.overwrite, exports=arguments.export
    )  # checked before the weights load
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(folders)
        _check_outputs(arguments, folder, source)
        observers = stack.enter_context(open_observers(arguments, source.name, folder))
        observers += base_observers(arguments, folder, source.path)
        observers += scale_observers(arguments, folder)
        odometry = early or load_odometry(arguments, device)
        images = image_choice(arguments) if arguments.export_images == SOURCE else None
        if images is None:
            check_formats(arguments.export, odometry)
        save_map = None if arguments.save_map is None else _map_file(arguments.save_map, odometry)
        facts["map"] = arguments.map
        if arguments.map is not None and isinstance(odometry, Saveable):
            facts["weights"] = getattr(odometry, "weights", "") or arguments.weights
        print_input(source)  # behind what may fail, so that an error is one line
        source, camera = with_calibration(source, odometry, arguments, device, folder)
        code = track(
            odometry,
            source,
            folder,
            stride=arguments.stride,
            facts=facts | camera,
            export=arguments.export,
            images=images,
            save_map=save_map,
            observers=observers,
            again=None if arguments.map else lambda number: load_odometry(_reseeded(arguments, number), device),
        )
        print_counts(source)
        return code


def _check_outputs(arguments: argparse.Namespace, folder: Path, source: Source) -> None:
    """Refuse outputs that are inputs, and places that cannot be written."""
    outputs = {"--save-map": arguments.save_map, "--overlay": arguments.overlay, "--rerun": arguments.rerun}
    inputs = {f"--{name.replace('_', '-')}": getattr(arguments, name) for name in INPUTS}
    check_outputs(outputs, inputs, arguments.source, folder)
    check_apart(folder, arguments.source, source.recording.images)
    found = {"the samples": getattr(source.reading.inertial, "file", None)}  # beside the source
    if source.calibration is not None:
        found["the calibration"] = source.calibration.file
    check_outputs(outputs, found)
    if arguments.save_map is not None:
        check_place(Path(arguments.save_map), "--save-map")


def _reseeded(arguments: argparse.Namespace, number: int) -> argparse.Namespace:
    """Arguments with another seed."""
    return argparse.Namespace(**{**vars(arguments), "seed": (arguments.seed + number) % 2**63})


def _map_file(text: str, odometry: Odometry) -> Path:
    """File of ``--save-map``, if the odometry can be saved."""
    if not isinstance(odometry, Saveable):
        message = f"the odometry {odometry.name} has no map that can be saved"
        raise DvoError(message, field="--save-map", remedy="use weights of patch_vo, such as small")
    return Path(text)


def device_for(arguments: argparse.Namespace) -> torch.device:
    """Device of ``--device``; an odometry without weights computes on the CPU.

    Args:
        arguments: of the command line.

    Returns:
        The device.

    Raises:
        DvoError: the device is not available, or the odometry cannot use it.
    """
    if arguments.system is None:
        return device_of(arguments.device)
    if arguments.device not in ("auto", "cpu"):
        raise DvoError("an odometry without weights computes on the CPU", field="--device", remedy="leave it out")
    return torch.device("cpu")


def check_settings_early(arguments: argparse.Namespace) -> None:
    """Check preset and settings of weights before the source is opened.

    Args:
        arguments: of the command line.

    Raises:
        DvoError: no such preset, or an unknown or invalid setting.
    """
    settings = _settings(arguments)
    if arguments.system is None and arguments.map is None:
        check_early(arguments.weights, None, settings)


def _settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Settings of ``--config``, ``--set``, ``--preset``, ``--no-loops`` and the scale; the later ones win."""
    settings = read_settings(arguments.config) if arguments.config else {}
    settings |= parse_settings(arguments.set)
    if arguments.preset is not None:
        settings["preset"] = arguments.preset
    if arguments.no_loops and (arguments.system is None or "loops" in settings):
        settings["loops"] = False
    settings |= scale_settings(arguments)
    reserved = sorted(set(settings) & {"weights", "device", "seed", "config"})
    if reserved:
        raise DvoError("not a setting of the odometry", field=reserved[0], remedy="use the option of that name")
    return settings


def load_odometry(arguments: argparse.Namespace, device: torch.device) -> Odometry:
    """Load the odometry of ``--weights`` with the settings of ``--preset``, ``--config``, ``--set`` and ``--no-loops``.

    The later ones win. With ``--map`` it is that of a new recording in a map.

    Args:
        arguments: of the command line.
        device: of all computation.

    Returns:
        The odometry.

    Raises:
        DvoError: no such weights, or an unknown or invalid setting.
    """
    settings = _settings(arguments)
    if getattr(arguments, "map", None) is not None:
        if arguments.system is not None:
            raise DvoError("a map is tracked in by weights", field="--system", remedy="leave out --system or --map")
        return load_in_map(arguments.map, arguments.weights, device, arguments.seed, settings)
    if arguments.system is not None:
        if arguments.system not in SYSTEMS:
            raise DvoError(
                f"no system {shown(arguments.system)}", field="--system", remedy=f"use one of {', '.join(SYSTEMS)}"
            )
        return build_system(arguments.system, arguments.seed, settings)
    return dvo.load(arguments.weights, device=device, seed=arguments.seed, **settings)


def track(
    odometry: Odometry,
    clip: Clip,
    folder: Path,
    *,
    stride: int = 1,
    facts: dict[str, Any],
    export: Sequence[str] = (),
    images: ImageChoice | None = None,
    save_map: Path | None = None,
    observers: Sequence[Observer] = (),
    again: Callable[[int], Odometry] | None = None,
) -> int:
    """Track a clip, fill the results folder and print a summary.

    Results are written from the first frame on (:class:`dvo.session.recorder.Recorder`) and replaced at the end. The
    first Ctrl-C or SIGHUP ends tracking and still writes all results. SIGTERM, after which a container is killed in
    10 s, writes what there is within two: no final optimisation, plot, page and maps for other programs. A second
    signal aborts, and what the recorder has written stays.

    Args:
        odometry: newly built.
        clip: frames in order of time, with or without ground truth.
        folder: of the results (:func:`dvo.session.results.results_folder`).
        stride: distance of tracked frames, in frames of the clip.
        facts: metadata to write into run.json.
        export: formats to write the results in too, into ``export/NAME`` of the results folder.
        images: of the clip for the exported maps; None for those of the keyframes.
        save_map: map file to write at the end; the odometry is :class:`dvo.odometry.protocol.Saveable`.
        observers: told of every frame and of the result; the caller closes them.
        again: builds the odometry anew with a seed for each number above 0, for a result that leaves doubt.

    Returns:
        Exit code: 0, 1 if no frame was tracked, 129, 130 or 143 after SIGHUP, Ctrl-C or SIGTERM.

    Raises:
        DvoError: no frame could be read, or a result cannot be written.
    """
    printed = set(clip.warnings)
    for observer in observers:
        observer.begin(odometry)
    facts = {"odometry": odometry.name, **facts, "export": list(export)}
    recorder, table, thumbnails = Recorder(folder, odometry, facts, warn=warn), FrameTable(), Thumbnails()

    def on_frame(frame: Frame, estimate: Estimate | None) -> None:
        recorder.update(frame, estimate)
        table.update(frame, estimate)
        thumbnails.update(frame, estimate)
        for observer in observers:
            observer.update(frame, estimate)
        progress.update(frame, estimate)

    with without_old_garbage(), InterruptSwitch(getattr(clip, "stop", None)) as switch:
        with TrackingProgress(clip.frame_count) as progress:
            try:
                done = session.run(
                    odometry, clip, stride=stride, on_frame=on_frame, should_stop=lambda: switch.pressed is not None,
                    in_haste=lambda: switch.in_haste, on_phase=progress.name, again=again,
                )  # fmt: skip
            except KeyboardInterrupt:
                recorder.stop(interrupted=True, reason=_ABORTED)
                raise
            except Exception as error:
                recorder.stop(interrupted=False, reason=f"ended by {type(error).__name__}: {error}")
                raise
            new_warnings = [warning for warning in done.warnings if warning not in printed]
            done = replace(
                done,
                warnings=(*done.warnings, *recorder.warnings),
                seconds={**facts.get("seconds", {}), **done.seconds},
            )
            scores = score(done, clip.groundtruth)
            if clip.groundtruth is not None and (looks := other_convention(done.result.trajectory, clip.groundtruth)):
                warn(f"the poses of the ground truth look like {looks}")
            writer = None if save_map is None else partial(_save, odometry, save_map)
            pages = Pages(clip.name, done, table, odometry, clip.groundtruth, thumbnails.images)
            hasty = done.interrupted and switch.in_haste
            views = True
            if hasty:
                views = _write_in_haste(folder, done, scores, clip, facts, pages)
            switch.release()
            if not hasty or writer is not None:
                _write(folder, done, scores, clip, facts, writer, pages, views=views)
            for observer in observers:
                observer.finish(done)
            if views:
                pages.add_warnings(
                    folder, [text for observer in observers for text in getattr(observer, "warnings", ())]
                )
            progress.finish(done.result)
        for warning in new_warnings:
            warn(warning)
        if facts.get("inertial") and "inertial" not in done.result.info:
            warn("the inertial samples are not used by this odometry with these settings", "note")
        print_report(folder, done, scores, [results.CALIBRATION] * (facts.get("calibration_file") is not None))
        for observer in observers:
            file = getattr(observer, "file", None)
            # Files in the folder are listed already; a video without a frame is removed.
            if file is not None and file.exists() and file.resolve().parent != folder.resolve():
                say(f"{getattr(observer, 'option', '').removeprefix('--')} in {file}")
        if save_map is not None:
            say(f"map in {save_map}")
        say(describe_seconds(done.seconds))
        if hasty and (left := [name for name in export if name not in TRAJECTORY_FORMATS]):
            warn(f"{', '.join(left)}: not exported, there was no time for the final optimisation")
            export = [name for name in export if name not in left]
        if export and not done.result.frames_tracked:
            warn("nothing to export")
        elif export:
            maps = [name for name in export if images is not None and name not in TRAJECTORY_FORMATS]
            others, place = [name for name in export if name not in maps], folder / results.EXPORT
            said = export_run(odometry, done.result, others, place, not getattr(clip, "calibrated", True))
            if images is not None and isinstance(clip, Source) and maps:
                places, check = {name: place / name for name in maps}, _stopped_by(switch)
                rows, graph = pages.rows(), graph_of(odometry)
                said += export_images(clip, done.result, rows, graph, places, images, check=check)
            for sentence in said:
                say(f"exported to {place}/{sentence}")
    if done.interrupted:
        return 128 + (switch.pressed or signal.SIGINT)
    return OK if done.result.frames_tracked else NOTHING_TRACKED


def _stopped_by(switch: InterruptSwitch) -> Callable[[], None]:
    """Function that ends the program if a signal has come since; one that has ended tracking does not count."""
    before = switch.pressed

    def check() -> None:
        if switch.pressed is not None and switch.pressed is not before:
            raise Terminated(switch.pressed)

    return check


def _save(odometry: Odometry, file: Path) -> dict[str, Any]:
    """Write the map file; gives the entry of run.json that names it."""
    assert isinstance(odometry, Saveable)
    odometry.save(file)
    return {"map_file": str(file.resolve())}


def _write_in_haste(
    folder: Path, done: session.Run, scores: Scores, clip: Clip, facts: dict[str, Any], pages: Pages
) -> bool:
    """Write what matters at once, and plot and page if there is time for them; True if there was."""
    _write(folder, done, scores, clip, facts, None, pages, views=False)
    try:
        _write(folder, done, scores, clip, facts, None, pages)
    except Terminated:
        _write(folder, done, scores, clip, facts, None, pages, views=False)
        return False
    return True


def _write(
    folder: Path,
    done: session.Run,
    scores: Scores,
    clip: Clip,
    facts: dict[str, Any],
    save_map: Callable[[], dict[str, Any]] | None,
    pages: Pages,
    views: bool = True,
) -> None:
    """Replace the files of the recorder with the final ones, and write the map file, which run.json names; ``views``:
    plot and page too."""
    facts = {**facts, "map_file": None, "metrics": None if scores.longest is None else asdict(scores.longest)}

    def picture(path: Path) -> None:
        draw(
            path,
            done.result,
            clip.groundtruth,
            title=clip.name,
            subtitle=headline(done, scores),
            label=facts["odometry"],
        )

    try:
        results.write_results(
            folder,
            done,
            facts,
            draw=picture if views else None,
            more={results.FRAMES: pages.frames},
            page=pages.page if views else None,
            segment_facts=scores.segment_facts,
            also=save_map,
        )
    except KeyboardInterrupt:
        aborted = replace(done, interrupted=True, warnings=(*done.warnings, _ABORTED))
        with contextlib.suppress(OSError):
            results.write_summary(folder, {**facts, **results.summary(aborted), "finished": False})
        raise
