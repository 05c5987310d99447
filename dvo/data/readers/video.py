"""Video files, decoded by OpenCV's FFmpeg."""

from __future__ import annotations

import mmap
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import visible
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.files.files import is_file, lookups
from dvo.data.files.output import spelled_in_text
from dvo.data.files.stamps import NOMINAL_FPS, RATES, checked_rate, read_times
from dvo.data.images.fields import DEINTERLACE, INTERLACED, LOOKED_AT, are_interlaced
from dvo.data.images.halves import FLAT
from dvo.data.images.image_header import MAX_PIXELS, holds_several
from dvo.data.images.images import SUFFIXES, to_rgb8
from dvo.data.images.orientation import MIRRORED, mirrors, oriented, turn
from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.gopro import gopro_notes, read_gopro, read_gopro_positions
from dvo.data.inertial_files.gpmf import has_telemetry
from dvo.data.positions import Positions
from dvo.data.readers.avi_index import is_misindexed
from dvo.data.readers.container import count_videos, is_sphere, is_whole, orientation, shown_seconds
from dvo.data.recording import EVERYTHING, Log, RawFrame, Reader, Recording, Request, Selection
from dvo.data.trajectory import Trajectory

if TYPE_CHECKING:
    import cv2

# A damaged packet fails one grab, and the packets after it may be good; the end of the file fails every grab.
# Half a minute of 30 Hz video without a frame is taken for the end.
_GIVE_UP_AFTER = 900
_FASTEST = 1000.0  # frames a second of a file: faster cameras write files to be played slowly
_LATE = 3  # frames in a row that show that a clock was set back, as of parts put together
_JUMP = 5000.0  # milliseconds: frames in another order than that of their times lie far less apart
_HELD_BACK = 4  # frames that a codec needs before it gives the first one
_BINARY = re.compile(rb"[^\t\n\r\x0c\x20-\x7e\x80-\xff]")
_NAMES_FILES = re.compile(rb"(\xef\xbb\xbf)?\s*(ffconcat|#EXTM3U|<\?xml|v=0)", re.IGNORECASE)
_SECONDS = 4  # to open, and to find the next frame: gigabytes without one are no video


def matches(path: Path) -> bool:
    """True for any file; folders are for the other readers.

    Args:
        path: existing file or folder.
    """
    return path.is_file()


@contextmanager
def _capture(path: Path) -> Iterator[cv2.VideoCapture]:
    """The opened video, closed again at the end."""
    import cv2

    if not is_file(path):  # a pipe or a device would never end, or never begin
        raise DvoError("no video file", file=path, remedy="give a file; images of a camera go to dvo.stream")
    with lookups(path), path.open("rb") as file:
        head = file.read(1024)  # a disk that sleeps wakes before time counts
    if _NAMES_FILES.match(head) or not (_BINARY.search(head) or head.startswith(b"YUV4MPEG") or not head):
        # FFmpeg would follow the names in it, or show the text itself
        raise DvoError("a text file is no video", file=path, remedy="give a video or the folder that holds the images")
    if path.suffix.lower() in SUFFIXES:  # FFmpeg would read it as a video of one frame
        if holds_several(path):
            remedy = "take its images apart into a folder, or make a video of it"
            raise DvoError("an animated image, or one of several pages, is no video", file=path, remedy=remedy)
        raise DvoError("one image is no video", file=path, remedy="give the folder that holds the images")
    with ExitStack() as opened:
        capture = _open(path, opened)
        if not capture.isOpened() and (other := _no_video(path, head)) is not None:
            raise DvoError(f"{other} is no video", file=path, remedy="give a video or the folder that holds the images")
        if not capture.isOpened():
            raise DvoError(
                "this video does not decode",
                file=path,
                remedy="check that it plays; a recording that was cut off before its index was written must be "
                "repaired first",
            )
        size = [capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if size[0] * size[1] > MAX_PIXELS:
            message = f"frames of {size[0]:g}x{size[1]:g} pixels, more than {MAX_PIXELS:,}"
            raise DvoError(message, file=path, remedy="reduce the video")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # it does not mirror, and turns by a wrong angle where it should
        try:
            yield capture
        except cv2.error as error:
            reason = str(error).splitlines()[0][:200]
            raise DvoError(f"this video does not decode ({reason})", file=path, remedy="check that it plays") from None


def _open(path: Path, opened: ExitStack) -> cv2.VideoCapture:
    """A video that is closed with the stack, and that may not have been opened."""
    import cv2

    # FFmpeg reports every damaged block on stderr, thousands of lines in one bad video; we count frames instead
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 1000 * _SECONDS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 1000 * _SECONDS]
    try:
        with spelled_in_text(path) as name:
            if is_in_order := is_misindexed(path):  # of a pipe FFmpeg reads no index, but chunk after chunk
                number = os.open(path, os.O_RDONLY)
                opened.callback(os.close, number)
                name = f"pipe:{number}"
            # FFmpeg only: OpenCV's other backends would read foo_01.png as a video of all its siblings
            capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, limits)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if is_in_order and not capture.isOpened():
        remedy = f"write it anew: ffmpeg -i - -c copy OUT.avi < {path.name}"
        raise DvoError("the index of the video is damaged", file=path, remedy=remedy)
    opened.callback(capture.release)
    return capture


def _no_video(path: Path, head: bytes) -> str | None:
    """What a file is by its content, if that is sound, an archive or nothing."""
    if not head:
        return "an empty file"
    if head.startswith((b"PK\x03\x04", b"\x1f\x8b", b"7z\xbc\xaf", b"Rar!")):
        return "an archive"
    if head.startswith((b"ID3", b"fLaC", b"OggS", b"\xff\xfb")) or head[8:12] in (b"WAVE", b"M4A ", b"M4B "):
        return "a recording of sound"
    if head[4:8] == b"ftyp":
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            kinds = set(re.findall(rb"hdlr.{8}(soun|vide)", content, re.DOTALL))
        if kinds == {b"soun"}:
            return "a recording of sound"
    return None


def _head(path: Path) -> bytes:
    """The first bytes, which tell the container."""
    with lookups(path), path.open("rb") as file:
        return file.read(512)


def _does_not_convert(path: Path) -> bool:
    """True if FFmpeg says that it cannot convert the interlaced frames at the beginning, as that of OpenCV 5.0 does.

    It leaves the image before in their place, or what stood in the memory, and OpenCV returns it as decoded. How much
    FFmpeg says is fixed once in a process, so that another one has to listen.
    """
    script = (
        "import cv2, sys; video = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG); "
        f"[video.read() for _ in range({LOOKED_AT})]"
    )
    with spelled_in_text(path) as name:
        command, variables = [sys.executable, "-c", script, name], os.environ | {"OPENCV_FFMPEG_LOGLEVEL": "16"}
        try:
            said = subprocess.run(
                command, env=variables, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                timeout=_SECONDS,
            ).stdout  # fmt: skip
        except (OSError, subprocess.TimeoutExpired):
            return False
    return b"interlaced" in said


def _is_without_rate(head: bytes) -> bool:
    """True for an AVI file whose head states no frames a second."""
    begin, stream = head.find(b"avih"), head.find(b"strh")
    if not head.startswith(b"RIFF") or begin < 0 or not 0 <= stream <= len(head) - 36:
        return False
    return head[begin + 8 : begin + 12] == bytes(4) == head[stream + 32 : stream + 36]


def _codec(code: float) -> str:
    """Name of a codec in brackets, of its four letters; nothing for another number."""
    name = int(code).to_bytes(4, "little") if 0 < code < 2**32 else b""
    return f" (codec {name.decode()})" if name.isalnum() else ""


def _grabs(capture: cv2.VideoCapture) -> Iterator[tuple[int, float, int]]:
    """``(index, container milliseconds, failed grabs just before)`` of every frame that decodes."""
    import cv2

    index, failed, failing_since = 0, 0, 0.0
    while failed <= _GIVE_UP_AFTER:
        if capture.grab():
            yield index, capture.get(cv2.CAP_PROP_POS_MSEC), failed
            failed = 0
        else:
            now = time.monotonic()
            failing_since = failing_since if failed else now
            if now - failing_since > _SECONDS:
                return
            failed += 1
        index += 1


def _aspect(capture: cv2.VideoCapture) -> float:
    """Width over height of a pixel as it is shown; 1 if it is not stated."""
    import cv2

    found = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    ratio = found[0] / found[1] if found[0] > 0 and found[1] > 0 else 1.0
    return ratio if 0.1 < ratio < 10 else 1.0


def _square_size(
    width: float, height: float, aspect: float, turned: int, calibration: Calibration | None
) -> tuple[int, int] | None:
    """Width and height at which pixels are square; None if they are, or if the calibration is that of the others.

    Of a calibration for images of no stated size the ratio of fx and fy tells which ones it is for.
    """
    if abs(aspect - 1) < 0.004 or not (width > 0 and height > 0):  # 1088 lines for 1080
        return None
    if turned in (90, 270):  # the width and height are those of the upright frame
        aspect = 1 / aspect
    size = (round(width * aspect), round(height)) if aspect > 1 else (round(width), round(height / aspect))
    if calibration is None or (calibration.width, calibration.height) == size:
        return size
    if (calibration.width, calibration.height) == (width, height):
        return None
    ratio = calibration.fx / calibration.fy
    return size if abs(ratio - 1) <= abs(ratio - 1 / aspect) else None


class VideoRecording:
    """Video file as a recording.

    Times are the container's; where it has none that increase, the frame's number over the frame rate. A rate or
    a list of times that the user gives overrides both.

    Args:
        path: the file.
        request: options of the user.

    Attributes:
        rate: frames a second that the file states, or the user; None with a list of times.
        orientation: of EXIF, by which frames are turned and mirrored, as the file asks for.
        turned: degrees clockwise of it; rows are then not the rows of the sensor in the order in which it reads them.

    Raises:
        DvoError: it does not open, holds no frame, shows all around without a calibration, or ``times`` has another
            number of rows than it has frames.
    """

    kind = "video"
    timestamps: np.ndarray | None = None
    images: list[Path] | None = None
    calibration: Calibration | None = None
    groundtruth: Trajectory | None = None
    stereo: Callable[[], StereoRig | None] | None = None
    inertial: Callable[[], InertialSamples] | None = None
    positions: Callable[[], Positions | None] | None = None

    def __init__(self, path: Path, request: Request) -> None:
        import cv2

        fps = checked_rate(request.fps)
        self.path, self.name = path, path.stem
        self.warnings: list[str] = []
        with _capture(path) as capture:
            announced, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            angle = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
            self.orientation = orientation(path) or {90: 6, 180: 3, 270: 8}.get(angle, 1)
            self.turned = turn(self.orientation)
            size = [capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
            width, height = reversed(size) if self.orientation > 4 else size
            self._square = _square_size(width, height, _aspect(capture), self.turned, request.calibration)
            code = capture.get(cv2.CAP_PROP_FOURCC)
            self._begins = 0.0  # frames that the times of the file begin behind
            first, interlaced = self._look(capture)
        head = _head(path)
        if not first:
            remedy = "check that it plays, or re-encode it: ffmpeg -i VIDEO -c:v libx264 OUT.mp4"
            raise DvoError(f"no frame of this video decodes{_codec(code)}", file=path, remedy=remedy)
        if interlaced and not head.startswith(b"GIF"):  # whose few colours may be a pattern of lines
            self.warnings.append(INTERLACED)
        if head.startswith(b"\x1a\x45\xdf\xa3") and 0 < self._begins < announced:
            announced -= self._begins  # Matroska states the end, from which the number is guessed
        # containers without a count give huge or negative numbers
        self.frame_count: int | None = int(announced) if 0 < announced < 1e9 else None
        if self._square is not None:
            wide, high = self._square
            self.warnings.append(
                f"the pixels of the video are not square: images of {width:g}x{height:g} are resized to {wide}x{high}"
            )
        self.warnings += [MIRRORED] * mirrors(self.orientation)
        if (count := count_videos(path)) > 1:
            self.warnings.append(
                f"the file holds {count} videos, of which the first is read: another one is "
                f"ffmpeg -i {visible(path.name)} -map 0:v:1 -c copy OUT{visible(path.suffix)}"
            )
        if is_misindexed(path):
            self.warnings.append("the index of the file is damaged: frames are read in the order in which they lie")
        if is_sphere(path):
            message = "the file says that its images show all around (equirectangular, or the like)"
            if request.calibration is None:
                raise DvoError(message, file=path, remedy=FLAT.format("VIDEO", ".mp4"))
            self.warnings.append(f"{message}: they are read as those of the calibration")
        shown = shown_seconds(path)
        if shown is not None and self.frame_count is not None and RATES[0] <= rate <= RATES[1]:
            # the frames before and behind what is shown are counted, and not decoded
            self.frame_count = max(1, min(self.frame_count, round(shown * rate)))
        self._times = self._read_times(request.times) if request.times is not None else None
        steps = np.diff(first)
        is_hasty = len(steps) > 0 and 0 < float(steps.mean()) < 1000 / _FASTEST
        self._use_container = bool(
            request.fps is None and (steps > 0).all() and np.isfinite(first).all() and not is_hasty
        )
        if has_telemetry(path):
            self.warnings += gopro_notes(path)
            self.positions = partial(read_gopro_positions, path)
            if mirrors(self.orientation):
                self.warnings.append("inertial samples of the telemetry are not used: frames are mirrored")
            elif request.times is None and request.fps is None and self._use_container:
                self.inertial = partial(read_gopro, path, self.turned)
            else:
                self.warnings.append("inertial samples of the telemetry are not used: frames have no times of the file")
        self._fps = fps or (rate if np.isfinite(rate) and RATES[0] <= rate <= _FASTEST else NOMINAL_FPS)
        self.rate = self._fps if self._times is None else None
        is_stated = self._use_container and not (head.startswith(b"\xff\xd8") or _is_without_rate(head))  # 25 by FFmpeg
        self._is_counted = head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free") or head.startswith(b"RIFF")
        if self._times is None and not is_stated and request.fps is None:
            known = "the stated" if self._fps == rate else "a guessed"
            what = f"states {rate:,.0f} frames a second" if is_hasty or rate > _FASTEST else "has no times"
            self.warnings.append(f"the video {what}: assuming {known} {self._fps:g} frames a second (or give --fps)")

    def _look(self, capture: cv2.VideoCapture) -> tuple[list[float], bool]:
        """Times of the first three frames in milliseconds, and if those of the beginning are interlaced."""
        import cv2

        times: list[float] = []
        previous, repeats = None, False

        def images() -> Iterator[np.ndarray]:
            nonlocal previous, repeats
            for _, milliseconds, _ in islice(_grabs(capture), LOOKED_AT):
                if not times:
                    self._begins = capture.get(getattr(cv2, "CAP_PROP_PTS", -1))
                times.append(milliseconds)
                decoded, image = capture.retrieve()
                if decoded and image is not None:
                    repeats = repeats or (previous is not None and np.array_equal(previous, image))
                    previous = image
                    yield image

        looked_at = images()
        interlaced = are_interlaced(looked_at)
        for _ in islice(looked_at, max(0, 3 - len(times))):
            pass
        if repeats and _does_not_convert(self.path):
            message = f"the frames are interlaced, and this OpenCV ({cv2.__version__}) does not convert such frames"
            raise DvoError(message, file=self.path, remedy=DEINTERLACE)
        return times[:3], interlaced

    def _read_times(self, file: Path) -> np.ndarray:
        times = read_times(file, None)
        if len(times) != self.frame_count:  # some containers only estimate: count, before calling the user wrong
            with _capture(self.path) as capture:
                last = max(index for index, _, _ in _grabs(capture))
            return read_times(file, last + 1)
        return times

    def frames(self, log: Log, selection: Selection = EVERYTHING) -> Iterator[RawFrame]:
        """See :class:`dvo.data.recording.Recording`; frames that are not wanted are decoded, but not converted."""
        import cv2

        read, last, previous, dropped, offset = 0, 0.0, -np.inf, 0, 0.0
        latest, late = 0.0, 0  # milliseconds of the file; frames in a row that increase, but behind an earlier one

        def grabbed(capture: cv2.VideoCapture) -> Iterator[tuple[int, float]]:
            nonlocal read, last, offset, latest, late
            for index, milliseconds, failed in _grabs(capture):
                log.unreadable.extend(f"frame {number}" for number in range(index - failed, index))
                ahead = milliseconds + offset
                late = 0 if ahead > last else late + 1 if milliseconds > latest or not late else 1
                latest = milliseconds
                if self._use_container and (ahead < last - _JUMP or late == _LATE):
                    ahead, late = last + 1000 / self._fps, 0
                    offset = ahead - milliseconds
                    log.notes.append(f"the clock was set back before frame {index}: times go on from there")
                read, last = read + 1, max(last, ahead)
                yield index, ahead

        with _capture(self.path) as capture:
            for index, milliseconds in selection.interval.select(
                grabbed(capture), lambda item: self._time(*item), selection.stride, self.path
            ):
                timestamp = self._time(index, milliseconds)
                if timestamp is None or not previous < timestamp < np.inf:  # NaN fails too
                    dropped += 1
                    if dropped == 1:
                        log.notes.append(f"frames not later than the one before were dropped, first frame {index}")
                    continue
                decoded, image = capture.retrieve()
                if not decoded or image is None:
                    log.unreadable.append(f"frame {index}")
                    continue
                previous = timestamp
                image = oriented(image, self.orientation)
                if self._square is not None:
                    image = cv2.resize(image, self._square, interpolation=cv2.INTER_LINEAR)
                image = image if selection.reduction is None else selection.reduction(image)
                yield RawFrame(index, timestamp, to_rgb8(image), f"{self.path} frame {index}")
        missing = (self.frame_count or 0) - read - len(log.unreadable)
        if self._use_container and missing > 0:  # of a variable rate the announced number may be rate times duration
            missing = min(missing, round((self.frame_count or 0) - 1 - last / 1000 * self._fps))
        if missing > 0 and selection.interval.end is None and (log.unreadable or not is_whole(self.path)):
            # healthy files may be off by a frame or so: edit lists, counts by a duration that begins before the images
            spare = max(1 if self._is_counted else _HELD_BACK, (self.frame_count or 0) // 200)
            verdict = ": it is cut short or damaged" if missing > spare else ""
            log.notes.append(f"the video announces {self.frame_count} frames, {read} could be read{verdict}")

    def _time(self, index: int, milliseconds: float) -> float | None:
        if self._times is not None:
            return float(self._times[index]) if index < len(self._times) else None
        return milliseconds / 1000 if self._use_container else index / self._fps


def open_video(path: Path, request: Request) -> Recording:
    """Open a video file.

    Args:
        path: the file.
        request: options of the user.

    Raises:
        DvoError: see :class:`VideoRecording`.
    """
    return VideoRecording(path, request)


READER = Reader("video", matches, open_video)
