"""Images of a recording with the poses of its trajectory, at the size at which they were recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import overload

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.output import scratch_folder
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.export.reconstruction import TIME_ROUNDING, Reconstruction
from dvo.geometry.camera import Camera
from dvo.geometry.poses import pose_matrices

MOST_IMAGES = 300
_QUALITY = 95
_LOOKED_AT = 960  # pixels of the longer side of an image whose sharpness is measured: noise of a pixel does not count


@dataclass(frozen=True)
class ImageChoice:
    """Choice of the images of a recording: the sharpest of each stretch of its poses.

    Attributes:
        every: poses in a stretch; None for as many stretches as ``count``.
        count: stretches of equal length.
    """

    every: int | None = None
    count: int = MOST_IMAGES

    def stretch(self, row: int, poses: int) -> int:
        """Number of the stretch of a pose.

        Args:
            row: of the pose.
            poses: in all.
        """
        return row // self.every if self.every is not None else row * min(self.count, poses) // poses


def sharpness(image: np.ndarray) -> float:
    """Variance of the Laplacian of an image (Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy",
    ICPR 2000), to be compared with those of images of the same scene.

    Args:
        image: ``(H, W, 3)`` uint8 RGB; large ones are reduced first.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    factor = _LOOKED_AT / max(grey.shape)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


@contextlib.contextmanager
def recorded_images(
    frames: Iterable[Frame],
    trajectory: Trajectory,
    choice: ImageChoice = ImageChoice(),  # noqa: B008 (frozen)
    on_frame: Callable[[Frame], None] | None = None,
) -> Iterator[Reconstruction]:
    """Read images of a recording, without points; they are kept in files until the end of the block.

    Args:
        frames: of the recording in order of time, without lens distortion. One is held at a time.
        trajectory: camera-to-world poses of one world; frames belong to them by their times.
        choice: of the images.
        on_frame: called after each frame.

    Yields:
        Images of the size of the frames, with poses, cameras and, of frames with masks, masks.

    Raises:
        DvoError: no frame has a pose.
    """
    with scratch_folder("dvo-images") as folder:
        jpegs, masks = _Files(folder, ".jpg"), _Files(folder, ".png")
        cameras: list[Camera] = []
        rows, identifiers, owners = [], [], []
        has_mask = False
        for row, frame in _sharpest(frames, trajectory.timestamps, choice, on_frame):
            if frame.camera not in cameras:
                cameras.append(frame.camera)
            rows.append(row)
            identifiers.append(frame.index)
            owners.append(cameras.index(frame.camera))
            bgr = np.ascontiguousarray(frame.image[..., ::-1])
            jpegs.append(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())
            used = np.ones(frame.image.shape[:2], bool) if frame.mask is None else frame.mask
            has_mask |= frame.mask is not None
            masks.append(cv2.imencode(".png", np.uint8(255) * used)[1].tobytes())
        if not rows:
            remedy = "give the folder of its last run"
            raise DvoError("no image of the source has the time of a pose", field="source", remedy=remedy)
        none = np.zeros(0, np.int64)
        yield Reconstruction(
            cameras=tuple(cameras),
            camera_of=np.array(owners),
            identifiers=np.array(identifiers),
            timestamps=trajectory.timestamps[rows],
            T_cw=np.linalg.inv(pose_matrices(trajectory.poses_wc[rows])),
            jpegs=jpegs,
            points=np.zeros((0, 3)),
            colors=np.zeros((0, 3), np.uint8),
            errors=np.zeros(0),
            image_of=none,
            point_of=none,
            positions=np.zeros((0, 2)),
            residuals=np.zeros(0),
            masks=masks if has_mask else (),
        )


def _sharpest(
    frames: Iterable[Frame],
    times: np.ndarray,
    choice: ImageChoice,
    on_frame: Callable[[Frame], None] | None,
) -> Iterator[tuple[int, Frame]]:
    """Row of the pose and frame of the sharpest image of each stretch."""

    def posed() -> Iterator[tuple[int, Frame]]:
        for frame in frames:
            if on_frame is not None:
                on_frame(frame)
            row = int(np.argmin(np.abs(times - frame.timestamp))) if len(times) else 0
            if len(times) and abs(times[row] - frame.timestamp) <= TIME_ROUNDING:
                yield row, frame
            if len(times) == 0 or frame.timestamp > times[-1]:
                return

    for _, stretch in groupby(posed(), lambda one: choice.stretch(one[0], len(times))):
        yield max(stretch, key=lambda one: sharpness(one[1].image))


class _Files(Sequence[bytes]):
    """Contents that are kept in files."""

    def __init__(self, folder: Path, suffix: str) -> None:
        self._folder, self._suffix, self._count = folder, suffix, 0

    def append(self, content: bytes) -> None:
        self._file(self._count).write_bytes(content)
        self._count += 1

    def _file(self, number: int) -> Path:
        return self._folder / f"{number}{self._suffix}"

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, number: int) -> bytes: ...
    @overload
    def __getitem__(self, number: slice) -> list[bytes]: ...
    def __getitem__(self, number: int | slice) -> bytes | list[bytes]:
        if isinstance(number, slice):
            return [self[k] for k in range(self._count)[number]]
        return self._file(range(self._count)[number]).read_bytes()
