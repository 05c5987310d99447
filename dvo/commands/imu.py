"""``dvo imu check``: what is wrong with the inertial samples of a source, and what to do about it."""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import dvo
from dvo.commands import NOTHING_TRACKED, OK
from dvo.commands.console import TrackingProgress, device_of, say, seed_everything, warn
from dvo.commands.places import check_outputs
from dvo.core.errors import DvoError
from dvo.data.companions.inertial_source import (
    AUTO,
    NONE,
    InertialInput,
    imu_calibration_of,
    inertial_inputs,
    read_inertial_file,
)
from dvo.data.files.output import check_place, write_text
from dvo.data.inertial_files.imu_calibration import ImuCalibration
from dvo.data.recording import Request
from dvo.data.source import Source
from dvo.data.streams.capture import is_stream
from dvo.geometry.poses import quaternion_to_matrix
from dvo.odometry.calibration.calibrate import calibrate
from dvo.odometry.inertial.findings import Finding, Level, SensorReport
from dvo.odometry.inertial.sensor_check import check_sensor
from dvo.session.session import run

UNUSABLE = NOTHING_TRACKED
_INPUTS = ("imu", "imu_calib", "calib", "times")
_TABLES = (".csv", ".txt", ".json", ".jsonl")


def check(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo imu check``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code: 0, or 1 if a finding makes the samples unusable.

    Raises:
        DvoError: invalid source or option, no inertial samples, samples that cannot be made out, or a file that cannot
            be written.
    """
    if is_stream(arguments.source):
        raise DvoError("a stream cannot be checked", file=arguments.source, remedy="record a clip, and give that")
    if arguments.imu == NONE:
        raise DvoError("there is nothing to check", field="--imu", remedy="leave out --imu none")
    if arguments.json is not None:
        inputs = {f"--{name.replace('_', '-')}": getattr(arguments, name) for name in _INPUTS}
        check_outputs({"--json": arguments.json}, inputs, arguments.source)
        check_place(Path(arguments.json), "--json")
    source, given = _opened(arguments)
    check_outputs({"--json": arguments.json}, {"the samples": given.file})  # found beside the source
    samples = given.rough()
    refusal = _refusal(given)
    seen, guessed = ((), None) if arguments.no_vision or source is None else _seen(source, arguments)
    report = check_sensor(samples, *seen)
    report = report.beside(refusal, None if report.alignment is None else guessed)
    _print(report, samples.origin)
    if arguments.json is not None:
        write_text(arguments.json, json.dumps(_facts(report, arguments.source, samples.origin), indent=2) + "\n")
    return OK if report.is_usable else UNUSABLE


def _opened(arguments: argparse.Namespace) -> tuple[Source | None, InertialInput]:
    """The source, None for a table of samples, and the samples, of which nothing is read yet."""
    path = Path(arguments.source)
    if path.is_file() and path.suffix.lower() in _TABLES:
        for name, given in (("--imu", arguments.imu != AUTO), ("--imu-topic", arguments.imu_topic is not None)):
            if given:
                raise DvoError(f"{path} is a table of samples itself", field=name, remedy=f"leave out {name}")
        calibration = imu_calibration_of(arguments.imu_calib, path) or ImuCalibration()
        return None, InertialInput(lambda rough=False: read_inertial_file(path, rough=rough), calibration, None, path)
    is_auto = arguments.imu == AUTO
    inertial = {"imu_calib": arguments.imu_calib, "imu_topic": arguments.imu_topic} if is_auto else {"imu": NONE}
    source = dvo.open(
        path, calib=arguments.calib, times=arguments.times, fps=arguments.fps, topic=arguments.topic,
        start=arguments.start, guess=True, **inertial,
    )  # fmt: skip
    for warning in source.warnings:
        warn(warning, "note")
    found = source.reading.inertial
    if not isinstance(found, InertialInput):  # a file, or samples beside the source that its opening refused
        request = Request(
            imu_topic=arguments.imu_topic, imu_calibration=imu_calibration_of(arguments.imu_calib, path)
        )  # fmt: skip
        first = next(iter(source)).timestamp
        found = next(iter(inertial_inputs(source.recording, arguments.imu, request, first)), None)
    if found is None:
        remedy = "give a file of them with --imu FILE"
        raise DvoError("there are no inertial samples in it or beside it", file=path, remedy=remedy)
    return source.changed(inertial=None), found


def _refusal(given: InertialInput) -> Finding | None:
    """Finding that other commands refuse the samples, or read them with notes."""
    try:
        notes = given.samples.notes
    except DvoError as error:
        remedy = error.remedy or "correct what is found below"
        return Finding("refused", Level.UNUSABLE, f"dvo run would not read them: {error.message}", remedy)
    if not notes:
        return None
    return Finding("notes", Level.NOTE, "; ".join(notes), "compare with what was recorded")


def _seen(
    source: Source, arguments: argparse.Namespace
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], Finding | None]:
    """Times, orientations and places of the longest segment of the beginning, none if no image is tracked; and a
    finding if the focal length that they rest on is a guess."""
    guessed = None
    device = device_of(arguments.device)
    seed_everything(arguments.seed)
    count = arguments.frames if source.frame_count is None else min(arguments.frames, source.frame_count)
    with TrackingProgress(count, "tracking") as progress:
        if source.guess is not None:
            found = calibrate(
                source, device=device, seed=arguments.seed, on_frame=progress.update, on_round=progress.begin_round
            )
            source = source.recalibrated(found.calibration, found.kept)
            if found.kept is not None:
                text = f"what is compared with the camera rests on a guess: {found}"
                guessed = Finding("guessed camera", Level.WARNING, text, "give a calibration with --calib")
            progress.begin("tracking", count)
        odometry = dvo.load("small", device=device, seed=arguments.seed, preset="fast", loops=False)
        done = run(odometry, itertools.islice(source, arguments.frames), on_frame=progress.update)
    result = done.result
    number = result.longest
    if number is None:
        return (np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3))), guessed
    trajectory = result.segments[number].trajectory
    poses = trajectory.poses_wc
    return (trajectory.timestamps, quaternion_to_matrix(poses[:, 3:]), poses[:, :3]), guessed


def _print(report: SensorReport, origin: str) -> None:
    """Print a table of the numbers, and the findings."""
    rows = {"samples of": origin, **{name: _shown(value) for name, value in report.values.items()}}
    width = max(map(len, rows)) + 2
    for name, row in rows.items():
        say(f"{name:<{width}}{row}")
    for finding in report.findings:
        say(str(finding))
    say("usable" if report.is_usable else "not usable as it is")


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return "  ".join(_shown(one) for one in value)
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def _facts(report: SensorReport, source: str, origin: str) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "source": source,
        "origin": origin,
        "usable": report.is_usable,
        "values": report.values,
        "findings": [asdict(finding) for finding in report.findings],
        "alignment": None,
    }
    if report.alignment is not None:
        facts["alignment"] = asdict(report.alignment)
    found: dict[str, Any] = _plain(facts)
    return found


def _plain(value: Any) -> Any:
    """The same for JSON: lists for arrays, None for numbers that are not finite."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
