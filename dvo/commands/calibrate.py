"""``dvo calibrate``: a camera from a video of a board, or from one of any scene."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
from pathlib import Path
from typing import Any

from rich.progress import Progress, TextColumn

import dvo
from dvo.boards.board import Board, CharucoBoard, Checkerboard
from dvo.boards.calibrate import HEADER, BoardCalibration, BoardOptions, calibrate_board
from dvo.commands import NOTHING_TRACKED, OK
from dvo.commands.console import StderrConsole, TrackingProgress, device_of, say, say_all, seed_everything, warn
from dvo.commands.input_options import source_settings
from dvo.commands.places import check_apart, check_outputs
from dvo.core.errors import DvoError
from dvo.data.calibration.read import read_calibration
from dvo.data.files.files import is_file
from dvo.data.files.output import replaced, write_text
from dvo.data.source import Source
from dvo.data.streams.capture import is_stream
from dvo.geometry.lenses import LENSES
from dvo.odometry.calibration.calibrate import calibrate as self_calibrate
from dvo.odometry.calibration.camera_estimate import is_foreign
from dvo.session import results

FISHEYE = "calib.yaml"
"""Calibration file of a fisheye, which the text file cannot hold."""
PICTURE = "calibration.png"
FACTS = "calibration.json"


def calibrate(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo calibrate``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code: 0, or 1 if a scene without a board does not tell the focal length.

    Raises:
        DvoError: invalid source or option, no board, too few views, views that do not determine the focal length, or a
            calibration file to show that is not understood.
    """
    if arguments.show is not None:
        return _show(arguments)
    if arguments.source is None:
        raise DvoError("missing", field="SOURCE", remedy="give a video or a folder of images, or --show FILE")
    if is_stream(arguments.source):
        raise DvoError("a stream cannot be calibrated", file=arguments.source, remedy="record a clip, and give that")
    board = _board(arguments)
    options = BoardOptions(fisheye=arguments.fisheye, k3=arguments.k3, frames=arguments.frames)
    if board is None and (arguments.fisheye or arguments.k3):
        raise DvoError("needs a board", field="--fisheye" if arguments.fisheye else "--k3", remedy="give --board CxR")
    settings = source_settings(arguments)
    if board is not None:
        for name in ("mask", "max_pixels"):
            if getattr(arguments, name) is not None:
                message, field = "a board is searched in whole images, as recorded", f"--{name.replace('_', '-')}"
                raise DvoError(message, field=field, remedy="leave it out")
        settings["max_pixels"] = None
        if all(settings[name] is None for name in ("times", "fps", "start", "end")):
            settings["fps"] = 30.0  # times do not matter unless something asks for them
    source = dvo.open(arguments.source, guess=True, undistort=False, stride=arguments.stride, **settings)
    for warning in source.warnings:
        warn(warning, "note")
    file = FISHEYE if options.fisheye else results.CALIBRATION
    with results.locked_folder(arguments.out, source.name) as folder:
        names = (file,) if board is None else (file, FACTS, PICTURE)
        taken = [name for name in names if os.path.lexists(folder / name)]
        results.check_free(folder, taken, names if _is_ours(folder / file) else (), arguments.overwrite)
        inputs = {"--weights": arguments.weights} if board is None else {}
        inputs |= {"--times": arguments.times, "--mask": arguments.mask}
        check_outputs({"--out": folder / file}, inputs, arguments.source)
        if board is not None:
            check_apart(folder, arguments.source, source.recording.images)
        if board is None:
            return _without_board(source, folder, arguments)
        return _with_board(source, board, options, folder)


def _show(arguments: argparse.Namespace) -> int:
    """Print how a calibration file is read."""
    if arguments.source is not None:
        remedy = "leave out one of them"
        raise DvoError("shows a file and calibrates nothing", field="--show", remedy=remedy)
    found = read_calibration(arguments.show)
    lens = LENSES[found.model]
    values = zip(lens.names, found.coefficients, strict=False)
    rows = {
        "file": str(found.file or arguments.show),
        "dialect": found.dialect,
        "model": found.model,
        "intrinsics": f"fx {found.fx:.9g}  fy {found.fy:.9g}  cx {found.cx:.9g}  cy {found.cy:.9g}",
        "coefficients": "  ".join(f"{name} {value:.9g}" for name, value in values) or "none",
        "size": f"{found.width}x{found.height}" if found.width and found.height else "not stated",
        "origin": "found in the images of a clip, not measured" if found.was_found else None,
        "depth scale": None if found.depth_scale is None else f"{found.depth_scale:g}",
        "baseline": None if found.baseline is None else f"{found.baseline:g} m",
        "readout": f"{found.readout:g} s" if found.readout else None,
        "ignored": ", ".join(found.ignored) or "nothing",
    }
    for name, row in rows.items():
        if row is not None:
            say(f"{name:<13}{row}")
    for note in found.doubts(found.width, found.height) if found.width and found.height else found.notes:
        warn(note, "note")
    return OK


def _is_ours(file: Path) -> bool:
    """True for a calibration file that dvo has written."""
    if not is_file(file):
        return False
    try:
        with file.open("rb") as stream:
            found = stream.read(len(HEADER)).startswith(HEADER.encode())
    except OSError:
        return False
    return found or not is_foreign(file)


def _board(arguments: argparse.Namespace) -> Board | None:
    if arguments.board is not None:
        columns, rows = arguments.board
        return Checkerboard(columns, rows, arguments.square)
    if arguments.charuco is not None:
        columns, rows = arguments.charuco
        return CharucoBoard(columns, rows, arguments.square, arguments.marker, arguments.dictionary)
    return None


def _with_board(source: Source, board: Board, options: BoardOptions, folder: Path) -> int:
    from dvo.viz.board import plot_board_calibration

    columns = (TextColumn("searching the board"), TextColumn("{task.fields[text]}"))
    with Progress(*columns, console=StderrConsole()) as progress:
        task = progress.add_task("", text="")

        def show(frames: int, views: int) -> None:
            with contextlib.suppress(OSError):
                progress.update(task, text=f"{frames} of {source.frame_count or '?'} frames, {views} views")

        found = calibrate_board(source, board, options, name=str(source.path), on_frame=show)
    say_all(found)
    for warning in found.warnings:
        warn(warning)
    file = folder / (FISHEYE if options.fisheye else results.CALIBRATION)
    found.write(file)
    write_text(folder / FACTS, json.dumps(_facts(found, str(source.path)), indent=2) + "\n")
    with replaced(folder / PICTURE) as part:
        plot_board_calibration(part, found)
    say(f"calibration in {file}, picture in {folder / PICTURE}")
    return OK


def _facts(found: BoardCalibration, source: str) -> dict[str, Any]:
    solution = found.solution
    return {
        "source": source,
        "board": found.board,
        "image_size": [found.width, found.height],
        "model": found.calibration.model,
        "parameters": {n: {"value": v, "deviation": d} for n, (v, d) in found.parameters.items()},
        "rms": solution.rms,
        "coverage": found.coverage,
        "examined": found.examined,
        "found": found.found,
        "views": [
            {"frame": view.index, "rms": float(rms), "tilt": float(tilt), "corners": len(view.corners)}
            for view, rms, tilt in zip(found.views, solution.view_rms, solution.tilts, strict=True)
        ],
        "rejected": [view.index for view in found.rejected],
        "warnings": list(found.warnings),
    }


def _without_board(source: Source, folder: Path, arguments: argparse.Namespace) -> int:
    device = device_of(arguments.device)
    seed_everything(arguments.seed)
    with TrackingProgress(None, "calibrating") as progress:
        found = self_calibrate(
            source, weights=arguments.weights, device=device, seed=arguments.seed, on_frame=progress.update,
            on_round=progress.begin_round,
        )  # fmt: skip
    say_all(found)
    file = folder / results.CALIBRATION
    if not found.write(file):
        warn(f"the focal length is a guess: no {file.name} is written", "note")
        return NOTHING_TRACKED
    say(f"calibration in {file}")
    return OK
