"""The front door of the data: any video, image folder or dataset sequence as an iterable of frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from dvo.data import euroc, folder, kitti, sequence, tartanair, tum, video
from dvo.data.calibration import Calibration, read_calibration
from dvo.data.frame import Frame
from dvo.data.images import read_image
from dvo.data.recording import ImageRecording, Log, RawFrame, Reader, Recording, Request
from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum
from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import Undistorter, needs_undistortion

# Asked in this order: the narrow layouts first, the plain folder last.
READERS: tuple[Reader, ...] = (
    video.READER,
    euroc.READER,
    kitti.READER,
    tartanair.READER,
    tum.READER,
    sequence.READER,
    folder.READER,
)


class Source:
    """Frames of one recording; may be iterated as often as one likes. Make it with :func:`open_source`.

    Attributes:
        name: of the sequence.
        kind: which reader: ``video, euroc, kitti, tartanair, tum, sequence, folder``.
        path: what was opened.
        camera: the camera of every frame (without distortion if frames are undistorted).
        recorded_camera: the camera as calibrated, distortion included.
        stride: every how many-th frame is read.
        frame_count: frames to expect, the stride taken into account; None if a video does not say. A video's header may
            promise more than can be read.
        groundtruth: camera-to-world poses of the camera that is read, or None. World frame and scale are the dataset's.
    """

    def __init__(
        self,
        recording: Recording,
        recorded_camera: Camera,
        groundtruth: Trajectory | None,
        stride: int,
        undistort: bool,
        doubts: list[str],
    ) -> None:
        self._recording = recording
        self._log = Log()
        self.name, self.kind, self.path = recording.name, recording.kind, recording.path
        self.recorded_camera, self.groundtruth, self.stride = recorded_camera, groundtruth, stride
        self._undistorter = Undistorter(recorded_camera) if undistort and needs_undistortion(recorded_camera) else None
        self.camera = self._undistorter.camera if self._undistorter else recorded_camera
        count = recording.frame_count
        self.frame_count: int | None = None if count is None else -(-count // stride)
        self._doubts = doubts

    def __len__(self) -> int:
        """``frame_count``.

        Raises:
            TypeError: the number is not known.
        """
        if self.frame_count is None:
            raise TypeError("the number of frames is not known before they are read")
        return self.frame_count

    @property
    def warnings(self) -> list[str]:
        """What the user should know, in sentences: guesses at opening, and troubles of the last pass so far."""
        return [*self._recording.warnings, *self._doubts, *self._log.messages()]

    @property
    def skipped(self) -> int:
        """How many images could not be decoded on the last pass so far."""
        return len(self._log.unreadable)

    @property
    def timestamps(self) -> np.ndarray | None:
        """Seconds, one for every image of the recording whatever the stride; None for a video."""
        recording = self._recording
        return recording.timestamps if isinstance(recording, ImageRecording) else None

    def frames_at(self, indices: Sequence[int]) -> list[tuple[Frame, Path]]:
        """Single frames of a recording that is made of image files, with their files, in any order.

        Raises:
            DvoError: a video, or an image that cannot be read.
        """
        recording = self._recording
        if not isinstance(recording, ImageRecording):
            raise DvoError("a video is read in order only", file=self.path, remedy="extract its frames into a folder")
        frames = []
        for index in indices:
            image = read_image(recording.images[index])
            if image is None:
                raise DvoError("cannot be decoded", file=recording.images[index], remedy="remove or replace the image")
            image = self._undistorter(image) if self._undistorter else image
            frame = Frame(index, float(recording.timestamps[index]), image, self.camera)
            frames.append((frame, recording.images[index]))
        return frames

    def __iter__(self) -> Iterator[Frame]:
        """Frames with strictly increasing timestamps.

        Raises:
            DvoError: an image of another size than the first, naming it.
        """
        self._log = log = Log()
        for raw in self._recording.frames(log, self.stride):
            height, width = raw.image.shape[:2]
            if (width, height) != (self.recorded_camera.width, self.recorded_camera.height):
                raise DvoError(
                    f"this image is {width}x{height}, those before are "
                    f"{self.recorded_camera.width}x{self.recorded_camera.height}",
                    file=raw.origin,
                    remedy="give images of one size",
                )
            image = self._undistorter(raw.image) if self._undistorter else raw.image
            yield Frame(raw.index, raw.timestamp, image, self.camera)


def open_source(
    source: Path | str,
    *,
    calib: Path | str | Calibration | None = None,
    times: Path | str | None = None,
    fps: float | None = None,
    stride: int = 1,
    groundtruth: Path | str | None = None,
    undistort: bool = True,
) -> Source:
    """Open a video, a folder of images, or a dataset's sequence folder (TUM RGB-D, EuRoC, KITTI, TartanAir v1 and v2,
    or an image folder with ``calib.txt`` and ``groundtruth_tum.txt`` beside it).

    Relative paths of the options are looked up from the working directory, then from the source's folder, so that
    ``--calib ../calib.txt`` beside an image folder is found from anywhere.

    Args:
        source: path to a file or folder.
        calib: calibration that wins over the dataset's own; see :func:`dvo.data.calibration.read_calibration`.
        times: file with the time of every image in its first column.
        fps: frames a second, where nothing else gives times; for a video it overrides the container.
        stride: read every ``stride``-th frame.
        groundtruth: TUM trajectory (camera to world), or KITTI poses with one row per image of a folder; wins over the
            dataset's own.
        undistort: resample to a pinhole camera; otherwise frames carry the distorted camera.

    Raises:
        DvoError: nothing there, unknown layout, no frame that decodes, no calibration, intrinsics that do not fit the
            images, malformed files.
    """
    path = Path(source)
    if not path.exists():
        raise DvoError("no such file or folder", file=path, remedy="give a video, a folder of images or a sequence")
    if stride < 1:
        raise DvoError(f"stride {stride}", field="stride", remedy="give a whole number of at least 1")
    if times is not None and fps is not None:
        raise DvoError("both times and fps are given", field="times", remedy="give --times or --fps, not both")
    request = Request(_locate(times, path, "times") if times is not None else None, fps)
    reader = next(reader for reader in READERS if reader.matches(path))
    recording = reader.open(path, request)
    first = _first_frame(recording)
    if isinstance(calib, Calibration):
        calibration: Calibration | None = calib
    else:
        calibration = recording.calibration if calib is None else read_calibration(_locate(calib, path, "calib"))
    if calibration is None:
        raise _no_calibration(path)
    height, width = first.image.shape[:2]
    camera = calibration.camera(width, height)
    truth = recording.groundtruth
    if groundtruth is not None:
        truth = _read_groundtruth(_locate(groundtruth, path, "groundtruth"), recording)
    try:
        return Source(recording, camera, truth, stride, undistort, calibration.doubts(width, height))
    except DvoError as error:  # the lens model does not know its file
        raise DvoError(error.message, file=calibration.file, field=error.field, remedy=error.remedy) from None


def _locate(given: Path | str, source: Path, field: str) -> Path:
    path = Path(given)
    base = source if source.is_dir() else source.parent
    for option in (path, base / path):
        if option.is_file():
            return option
    raise DvoError("no such file", file=path, field=field, remedy=f"give an existing file to --{field}")


def _first_frame(recording: Recording) -> RawFrame:
    log = Log()
    found = next(islice(recording.frames(log), 1), None)
    if found is None:
        raise DvoError(
            f"none of the {len(log.unreadable)} images decodes",
            file=recording.path,
            remedy="check that the files are images that other programs can show",
        )
    return found


def _no_calibration(path: Path) -> DvoError:
    nearby = [option for option in (path / "calib.txt", path.parent / "calib.txt") if option.is_file()]
    hint = f" (is it {nearby[0]}?)" if nearby else ""
    return DvoError(
        "no calibration",
        file=path,
        field="calib",
        remedy=f"give --calib FILE{hint}: a text file with 'fx fy cx cy [k1 k2 p1 p2 [k3]]' in pixels, or a YAML",
    )


def _read_groundtruth(file: Path, recording: Recording) -> Trajectory:
    """A TUM file as it stands; KITTI rows get the times of the images."""
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        fields = line.split("#")[0].split()
        if fields and len(fields) != 12:
            break
        if fields:
            poses, times = read_kitti_poses(file), getattr(recording, "timestamps", np.zeros(0))
            if len(times) != len(poses):
                raise DvoError(
                    f"{len(poses)} rows without times for {len(times)} images",
                    file=file,
                    field="groundtruth",
                    remedy="give a TUM trajectory with times",
                )
            return Trajectory(np.asarray(times), poses)
    return read_tum(file)
