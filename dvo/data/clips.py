"""Short windows of a source as arrays: for validation on real footage, and for training on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dvo.data.frame import Frame
from dvo.data.source import Source
from dvo.data.trajectory import Trajectory, interpolate
from dvo.errors import DvoError
from dvo.geometry.camera import Camera


@dataclass(frozen=True)
class Clip:
    """Consecutive frames with ground truth.

    Attributes:
        name: of the source and the first frame.
        images: ``(N, H, W, 3)`` uint8 RGB.
        timestamps: ``(N,)`` float64 seconds.
        intrinsics: ``(N, 4)`` float64 ``fx fy cx cy`` of these images.
        poses_wc: ``(N, 7)`` float64 camera to world, in the dataset's world and scale.
    """

    name: str
    images: np.ndarray
    timestamps: np.ndarray
    intrinsics: np.ndarray
    poses_wc: np.ndarray


def fit(image: np.ndarray, camera: Camera, width: int, height: int) -> tuple[np.ndarray, Camera]:
    """The largest centred window of the wanted aspect, area-resampled to ``width`` x ``height``, and its camera.

    Args:
        image: ``(H, W, C)``.
        camera: the camera of ``image``.
        width, height: pixels.
    """
    import cv2

    scale = min(camera.width / width, camera.height / height)
    wide, high = min(round(width * scale), camera.width), min(round(height * scale), camera.height)
    left, top = (camera.width - wide) // 2, (camera.height - high) // 2
    window = image[top : top + high, left : left + wide]
    resized = cv2.resize(window, (width, height), interpolation=cv2.INTER_AREA)
    return resized, camera.cropped(left, top, wide, high).resized(width, height)


def read_clips(source: Source, *, length: int, width: int, height: int, hop: int | None = None) -> Iterator[Clip]:
    """Windows of ``length`` frames, one every ``hop`` frames (default: ``length``, so that they do not overlap).

    Frames without ground truth end a window: a clip never spans a gap. The source's stride sets the frame gap.

    Args:
        source: with ground truth.
        length: frames in a clip.
        width, height: of the images, see :func:`fit`.
        hop: frames from the start of one clip to the start of the next.

    Raises:
        DvoError: the source has no ground truth.
    """
    if source.groundtruth is None:
        raise DvoError("no ground truth", file=source.path, field="groundtruth", remedy="name one with groundtruth=")
    hop = length if hop is None else hop
    window: deque[tuple[Frame, np.ndarray]] = deque(maxlen=length)
    wait = 0
    for frame in source:
        pose = _pose_at(source.groundtruth, frame.timestamp)
        if pose is None:
            window.clear()
            continue
        window.append((frame, pose))
        wait = max(wait - 1, 0)
        if len(window) == length and wait == 0:
            wait = hop
            yield _clip(source.name, list(window), width, height)


def _pose_at(trajectory: Trajectory, timestamp: float) -> np.ndarray | None:
    found = interpolate(trajectory, np.array([timestamp]))
    return found.poses_wc[0] if len(found) else None


def _clip(name: str, window: list[tuple[Frame, np.ndarray]], width: int, height: int) -> Clip:
    fitted = [fit(frame.image, frame.camera, width, height) for frame, _ in window]
    return Clip(
        name=f"{name}@{window[0][0].index}",
        images=np.stack([image for image, _ in fitted]),
        timestamps=np.array([frame.timestamp for frame, _ in window]),
        intrinsics=np.stack([camera.intrinsics for _, camera in fitted]),
        poses_wc=np.stack([pose for _, pose in window]),
    )
