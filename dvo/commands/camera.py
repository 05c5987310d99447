"""Camera of ``dvo run``: the calibration of the source, or a focal length that is found in the images."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from dvo.commands.console import TrackingProgress, say_all, seed_everything, warn
from dvo.data.opening import nearby_calibration
from dvo.data.source import Source
from dvo.odometry.calibration.calibrate import calibrate
from dvo.odometry.calibration.camera_estimate import SelfCalibration
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.protocol import Odometry
from dvo.session.results import CALIBRATION, files_of_run
from dvo.session.second_run import can_be_read_again


def with_calibration(
    source: Source, odometry: Odometry, arguments: argparse.Namespace, device: torch.device, folder: Path
) -> tuple[Source, dict[str, Any]]:
    """Find the focal length of a source that was opened with a guess, print it and write it into a calibration file.

    Where the images do not tell it, the guess is kept and no file is written.

    Args:
        source: to track; one with a calibration, or that can be read once, is returned as it is.
        odometry: that will track it; if it keeps no measurements, the weights ``small`` find the focal length.
        arguments: of the command line.
        device: of all computation.
        folder: results folder.

    Returns:
        The source with the camera to track it with, and the entries ``camera`` and ``self_calibration`` of run.json,
        with ``seconds.calibrating``, wall time.

    Raises:
        DvoError: no frame could be read.
        OSError: the calibration file cannot be written.
    """
    found, file, began = None, folder / CALIBRATION, time.perf_counter()
    written = False
    if source.guess is not None and can_be_read_again(source):
        warn(_announcement(source), "note")
        weights = odometry.weights or arguments.weights if isinstance(odometry, PatchOdometry) else "small"
        with TrackingProgress(None, "calibrating") as progress:
            found = calibrate(
                source, weights=weights, device=device, seed=arguments.seed, on_frame=progress.update,
                on_round=progress.begin_round,
            )  # fmt: skip
        seed_everything(arguments.seed)  # the same bytes as a run with the calibration file
        say_all(found)
        if found.found:
            written = (not file.exists() or CALIBRATION in files_of_run(folder)) and found.write(file)
            if not written:
                warn(f"{file} is not a file of an earlier run, and was not replaced")
        else:
            warn(f"the focal length is a guess: no {CALIBRATION} for the next run", "note")
        source = source.recalibrated(found.calibration, found.kept)
    has_none = found is None or not found.found
    if has_none and CALIBRATION in files_of_run(folder) and not _is_given(file, source, arguments.calib):
        file.unlink(missing_ok=True)  # of an earlier run
    factor = 1 if source.reduction is None else source.reduction.factor
    camera = {**asdict(source.recorded_camera), "turned": source.turned, "reduced_by": factor}
    facts: dict[str, Any] = {"camera": camera, "self_calibration": None if found is None else _facts(found)}
    facts["calibration_file"] = CALIBRATION if written else None
    return source, facts if found is None else facts | {"seconds": {"calibrating": time.perf_counter() - began}}


def calibration_origin(source: Source, calib: str | None) -> str | None:
    """Where the calibration of a source comes from, for run.json.

    Args:
        source: newly opened.
        calib: value of ``--calib``.

    Returns:
        The value of ``--calib``, else the file that the data set has, or that its published values are used; None
        without a calibration.
    """
    if calib is not None or source.guess is not None or source.calibration is None:
        return calib
    file = source.calibration.file
    return f"published with the data ({source.kind})" if file is None else str(file)


def _is_given(file: Path, source: Source, calib: str | None) -> bool:
    """True if a file is the one that ``--calib`` names, from the working directory or the source's folder."""
    if calib is None or not file.exists():
        return False
    base = source.path if source.path.is_dir() else source.path.parent
    return any(option.exists() and option.samefile(file) for option in (Path(calib), base / calib))


def _announcement(source: Source) -> str:
    near = nearby_calibration(source.path, source.recorded_camera.width, source.recorded_camera.height)
    hint = f" ({near} is there: is it the one?)" if near else ""
    return f"no calibration: looking for the focal length in the images; --calib FILE gives one{hint}"


def _facts(found: SelfCalibration) -> dict[str, Any]:
    size, c = [found.width, found.height], found.calibration
    deviations = [value if math.isfinite(value) else None for value in found.aside_deviation]
    centre = {"principal_point": [c.cx, c.cy], "principal_point_deviation": deviations}
    facts = {name: getattr(found, name) for name in ("focal", "deviation", "source", "frames", "reason")}
    bend = {"bend": found.bend, "bend_deviation": found.bend_deviation if found.bend else None}
    return {**facts, **centre, **bend, "image_size": size, "guess": asdict(found.guess)}
