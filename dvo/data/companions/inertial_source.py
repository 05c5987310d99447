"""Inertial samples for the frames of a source: those that belong to its recording, or those of a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import exists, is_file
from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.data.inertial_files.gopro import read_gopro
from dvo.data.inertial_files.gpmf import has_telemetry
from dvo.data.inertial_files.imu_calibration import ImuCalibration, read_imu_calibration, read_noise
from dvo.data.inertial_files.tables import (
    RATES,
    TURN_RATIO,
    is_inertial_table,
    read_inertial_table,
    turn_of_gravity,
)
from dvo.data.inertial_files.tidy import GRAVITY_RANGE
from dvo.data.opening import locate
from dvo.data.readers import rosbag
from dvo.data.recording import Recording, Request

AUTO, NONE = "auto", "none"
"""Values of ``imu`` that are no files: the samples of the recording, and none."""

_COVERED = 0.9  # share of the time of the frames below which a note tells
_CONSTANT = 20  # samples that should differ
_VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv")
_NAMES = ("gyro_accel.csv", "imu.csv", "data.jsonl", "Gyroscope.csv")  # of MARS logger, Stray Scanner, Spectacular AI


@dataclass
class InertialInput:
    """Inertial samples of one recording with their calibration; read once, when they are first wanted.

    Attributes:
        read: reads the samples at times of the inertial sensor; with ``rough``, as they stand.
        calibration: to be applied to them.
        span: seconds of the first and the last frame; None of an end that is not known; None without frames.
        file: that the user or a name has brought to the recording, and whose samples must meet the frames; None for
            samples of the recording itself.
    """

    read: Callable[..., InertialSamples]
    calibration: ImuCalibration
    span: tuple[float, float | None] | None = None
    file: Path | None = None

    @cached_property
    def samples(self) -> InertialSamples:
        """The samples at times of the camera.

        Raises:
            DvoError: damaged samples, or times that do not meet those of the frames.
        """
        samples = self.calibration.applied(self.read())
        if self.span is not None and self.file is not None and len(samples):
            check_overlap(samples, self.span, self.file)
        told = _turns(samples) if self.file is None else []
        return replace(samples, notes=(*samples.notes, *_remarks(samples, self.span), *told))

    def rough(self) -> InertialSamples:
        """The samples as they stand, for a check: neither sorted nor refused for their times or units.

        Raises:
            DvoError: no samples can be made out.
        """
        return self.calibration.applied(self.read(rough=True))

    def __call__(self) -> InertialSamples:
        return self.samples


def choose_inertial(
    recording: Recording, imu: Path | str, request: Request, first: float
) -> tuple[InertialInput | None, list[str]]:
    """Inertial samples that the frames of a recording carry.

    Args:
        recording: as its reader found it.
        imu: :data:`AUTO`, :data:`NONE`, or a file.
        request: options of the user.
        first: seconds of the first frame.

    Returns:
        The samples, None for none; and notes for the user.

    Raises:
        DvoError: a file that is damaged, or whose times do not meet those of the frames; a calibration without samples.
    """
    given, path = str(imu), recording.path
    if given == NONE and not exists(Path(given)):
        if request.imu_calibration is not None or request.imu_topic is not None:
            field = "imu_calib" if request.imu_calibration is not None else "imu_topic"
            raise DvoError("there are no inertial samples that it is for", field=field, remedy="leave out --imu none")
        return None, []
    candidates = inertial_inputs(recording, imu, request, first)
    if given != AUTO or exists(Path(given)):
        return candidates[0], list(candidates[0].samples.notes)
    if recording.inertial is not None and recording.kind != "video":
        return candidates[0], []
    notes: list[str] = []
    for found in candidates:
        try:
            return found, [*notes, *found.samples.notes]
        except DvoError as error:
            hint = ""
            if request.times is None and (times := next(filter(is_file, _times_beside(path)), None)) is not None:
                hint = f" (is --times {times.name} on their clock?)"
            notes.append(f"inertial samples of {(found.file or path).name} are not used: {error.message}{hint}")
    if request.imu_calibration is not None:
        remedy = "give the file of the samples with --imu FILE"
        raise DvoError("there are no inertial samples that it is for", file=path, field="imu_calib", remedy=remedy)
    return None, notes


def inertial_inputs(recording: Recording, imu: Path | str, request: Request, first: float) -> list[InertialInput]:
    """Inertial samples that may be meant, the likeliest first; nothing is read yet.

    Args:
        recording: as its reader found it.
        imu: :data:`AUTO` for those in or beside the recording, or a file.
        request: options of the user.
        first: seconds of the first frame.

    Raises:
        DvoError: no such file.
    """
    calibration, path = request.imu_calibration or ImuCalibration(), recording.path
    span = (first, _last(recording, first))
    if str(imu) != AUTO or exists(Path(imu)):
        file = locate(imu, path, "imu")
        read = partial(read_inertial_file, file, request.imu_topic, recording.turned)
        return [InertialInput(read, calibration, span, file)]
    own = [] if recording.inertial is None else [InertialInput(recording.inertial, calibration, span)]
    return own + [
        InertialInput(partial(read_inertial_file, file, None, recording.turned), calibration, span, file)
        for file in beside(path, recording)
    ]


def _last(recording: Recording, first: float) -> float | None:
    """Seconds of the last frame; None if it is not known."""
    if recording.timestamps is not None and len(recording.timestamps):
        return float(recording.timestamps[-1])
    rate = getattr(recording, "rate", None)  # of a video
    return first + recording.frame_count / rate if recording.frame_count and rate else None


def check_overlap(samples: InertialSamples, span: tuple[float, float | None], file: Path | None) -> None:
    """Refuse samples of another clock than that of the frames.

    Args:
        samples: all of them.
        span: seconds of the first and the last frame; None of an end that is not known.
        file: for messages.

    Raises:
        DvoError: no sample lies between the frames.
    """
    start, end = float(samples.timestamps[0]), float(samples.timestamps[-1])
    first, last = span
    if end < first or (last is not None and start > last):
        frames = f"from {first:.6f}" + (f" to {last:.6f} s" if last is not None else " s on")
        raise DvoError(
            f"inertial samples from {start:.6f} to {end:.6f} s do not meet the frames {frames}", file=file, field="imu",
            remedy="give times of the frames on the clock of the samples with --times, or time_offset in --imu-calib",
        )  # fmt: skip


def _remarks(samples: InertialSamples, span: tuple[float, float | None] | None) -> list[str]:
    """Sentences about samples that are read as they stand, and of little use."""
    if not len(samples):
        return ["there are no inertial samples in it"]
    start, end, notes = float(samples.timestamps[0]), float(samples.timestamps[-1]), list[str]()
    if span is not None and span[1] is not None and span[1] > span[0]:
        covered = max(min(end, span[1]) - max(start, span[0]), 0.0) / (span[1] - span[0])
        if covered < _COVERED:
            whole = f"{100 * covered:.0f} % of the frames from {span[0]:.3f} to {span[1]:.3f} s"
            notes.append(f"inertial samples from {start:.3f} to {end:.3f} s cover {whole}")
    if len(samples) <= _CONSTANT:
        return notes
    for name, rows in (("gyroscope", samples.gyro), ("accelerometer", samples.accel)):
        if (rows == rows[0]).all():
            values = ", ".join(f"{value:.4g}" for value in rows[0])
            notes.append(f"the {name} is {values} in all samples: check that it is on, and its columns")
    force = float(np.median(np.linalg.norm(samples.accel, axis=1)))
    if not RATES[0] <= samples.rate <= RATES[1]:
        usual = f"{RATES[0]:g} to {RATES[1]:g}"
        notes.append(f"{samples.rate:.4g} inertial samples a second, not {usual}: see dvo imu check")
    if not GRAVITY_RANGE[0] <= force <= GRAVITY_RANGE[1]:
        notes.append(f"the median of the accelerometer is {force:.4g} m/s^2, not about 9.81: see dvo imu check")
    return notes


def _turns(samples: InertialSamples) -> list[str]:
    """Sentence about a gyroscope in another unit than the format has, as readers of tables tell it."""
    ratio = turn_of_gravity(samples.timestamps, samples.gyro, samples.timestamps, samples.accel)
    if ratio is None or TURN_RATIO[0] <= ratio <= TURN_RATIO[1]:
        return []
    return [f"gravity turns {ratio:.3g} times as fast as the gyroscope says: see dvo imu check"]


def imu_calibration_of(
    given: Path | str | Sequence[Path | str] | ImuCalibration | None, source: Path
) -> ImuCalibration | None:
    """Calibration of the option ``imu_calib``.

    Args:
        given: file or preset, several of them (a text: apart by commas), or a calibration.
        source: file or folder that is opened.

    Returns:
        None for none.

    Raises:
        DvoError: see :func:`dvo.data.inertial_files.imu_calibration.read_imu_calibration`.
    """
    if given is None or isinstance(given, ImuCalibration):
        return given
    is_listed = isinstance(given, Sequence) and all(isinstance(one, str | Path) for one in given)
    if not isinstance(given, Path) and not is_listed:
        remedy = "give a file, a preset, several of them, or an ImuCalibration"
        raise DvoError(f"must be a file, got {str(given)[:60]!r}", field="imu_calib", remedy=remedy)
    if isinstance(given, str | Path):
        text = str(given)
        given = [text] if "," not in text or exists(Path(text)) else [part.strip() for part in text.split(",")]
    parts = [one if str(one) in NOISE_PRESETS and not exists(Path(one)) else _located(one, source) for one in given]
    return read_imu_calibration(parts)


def _located(given: Path | str, source: Path) -> Path:
    """File of a calibration, with the number of a camera behind it."""
    head, mark, number = str(given).rpartition(":")
    if mark and number.isdigit() and not exists(Path(given)):
        return Path(f"{locate(head, source, 'imu-calib')}:{number}")
    return locate(given, source, "imu-calib")


def read_inertial_file(
    path: Path, topic: str | None = None, turned: int = 0, *, rough: bool = False
) -> InertialSamples:
    """Read the inertial samples of a file of any known format.

    Args:
        path: table of text (:func:`dvo.data.inertial_files.tables.read_inertial_table`), GoPro video, bag of ROS, or a
            folder with a file for each sensor.
        topic: of the samples in a bag.
        turned: degrees clockwise by which the frames of a video are turned to stand upright.
        rough: as they stand, for a check: neither sorted nor refused.

    Raises:
        DvoError: see the readers of the formats.
    """
    if rosbag.matches(path):
        return rosbag.read_inertial(path, topic, rough=rough)
    if topic is not None:
        raise DvoError("only bags have topics", file=path, field="imu_topic", remedy="leave it out")
    if path.suffix.lower() in _VIDEOS or (is_file(path) and has_telemetry(path)):
        return read_gopro(path, turned, rough=rough)
    samples = read_inertial_table(path, rough=rough)
    noise = read_noise(path.parent / "sensor.yaml") if path.parent.name.startswith("imu") else None
    return ImuCalibration(noise).applied(samples)


def beside(path: Path, recording: Recording) -> list[Path]:
    """Files of a sensor logger that belong to a video or a folder of images, by their names.

    ``NAME.csv`` and ``NAME_imu.csv`` of a video ``NAME.mp4``, ``NAMEgyro.csv`` (OpenCamera Sensors, also in a folder of
    the date), and, where the video is the only one in its folder, the names of MARS logger, Stray Scanner, Spectacular
    AI and Sensor Logger; of a folder of images, the latter in it or beside it.

    Args:
        path: file or folder that is opened.
        recording: its kind tells whether such files are looked for.

    Returns:
        Files that are there, the likeliest first.
    """
    if recording.kind == "video":
        folder, stem = path.parent, path.stem
        own = [folder / f"{stem}{end}" for end in ("_imu.csv", ".csv", ".jsonl")]
        own = [file for file in own if file.suffix == ".jsonl" or is_inertial_table(file)]
        date = re.sub("^VID_", "", stem)
        own += [place / f"{stem}{end}" for place in (folder, folder / date, folder / stem) for end in
                ("gyro.csv", "_gyro.csv")]  # fmt: skip
        is_alone = sum(child.suffix.lower() in _VIDEOS for child in folder.iterdir()) == 1
        own += [folder / name for name in _NAMES] if is_alone else []
    elif recording.kind == "folder":
        own = [place / name for place in (path, path.parent) for name in _NAMES]
    else:
        own = []
    return [file for file in own if is_file(file)]


def _times_beside(video: Path) -> list[Path]:
    """Files of times of frames that a sensor logger writes beside a video: MARS logger, OpenCamera Sensors."""
    stem, folder = video.stem, video.parent
    date = re.sub("^VID_", "", stem)
    names = [place / f"{stem}_timestamps.csv" for place in (folder, folder / date, folder / stem)]
    return [*names, folder / "frame_timestamps.txt"]


def described(samples: InertialSamples) -> str:
    """One line about inertial samples: rate, origin, calibration and noise.

    Args:
        samples: all of a recording.
    """
    preset = next((name for name, noise in NOISE_PRESETS.items() if noise == samples.noise), None)
    noise = "noise not stated, that of a phone is assumed" if samples.noise is None else "noise as stated"
    noise = noise if preset is None else f"noise of the preset {preset}"
    pose = "pose in the camera known" if samples.T_camera_imu is not None else "pose in the camera not known"
    return f"inertial: {len(samples)} samples, {samples.rate:.4g} a second, of {samples.origin}; {pose}; {noise}"
