"""A small scene with exact motion: a textured wall, a textured board in front of it; and a rendered room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera

CAMERA = Camera(250.0, 250.0, 159.5, 119.5, 320, 240)
TEXELS = 120  # a metre of wall


def _texture(seed: int, width: int, height: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 6, width // 6, 3), dtype=np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def _homography(pose_wc: np.ndarray, depth: float, left: float, top: float) -> np.ndarray:
    """Texels of the plane z = depth, whose corner lies at (left, top), to pixels."""
    R, t = Rotation.from_quat(pose_wc[3:]).as_matrix().T, pose_wc[:3]
    plane = np.array([[1 / TEXELS, 0, left - t[0]], [0, 1 / TEXELS, top - t[1]], [0, 0, depth - t[2]]])
    return CAMERA.matrix @ R @ plane


class Scene:
    """Renders what a camera at a pose sees."""

    def __init__(self) -> None:
        self.wall, self.board = _texture(1, 1800, 1500), _texture(2, 150, 400)

    def __call__(self, pose_wc: np.ndarray) -> np.ndarray:
        size = (CAMERA.width, CAMERA.height)
        image = cv2.warpPerspective(self.wall, _homography(pose_wc, 5.0, -7.5, -6.0), size)
        near = _homography(pose_wc, 2.5, -0.4, -1.6)
        cover = cv2.warpPerspective(np.ones(self.board.shape[:2], np.uint8), near, size)
        front = cv2.warpPerspective(self.board, near, size)
        return np.where(cover[:, :, None] > 0, front, image)


def walk(count: int = 40, translate: float = 1.0) -> Trajectory:
    """Sideways and forward with a slow turn, 20 Hz."""
    s = np.linspace(0, 1, count)
    positions = translate * np.column_stack([1.6 * s, 0.15 * np.sin(5 * s), 0.8 * s**2])
    rotations = Rotation.from_euler("yx", np.column_stack([-14 * s, 3 * np.sin(4 * s)]), degrees=True)
    return Trajectory(np.arange(count) / 20, np.column_stack([positions, rotations.as_quat()]))


@pytest.fixture(scope="session")
def film() -> Callable[[Trajectory], list[Frame]]:
    """``film(trajectory)``: the frames that a camera on that path sees."""
    scene = Scene()
    images: dict[bytes, np.ndarray] = {}

    def seen(pose: np.ndarray) -> np.ndarray:
        key = pose.tobytes()
        if key not in images:
            images[key] = scene(pose)
        return images[key]

    def shoot(path: Trajectory) -> list[Frame]:
        poses = zip(path.timestamps, path.poses_wc, strict=True)
        return [Frame(i, float(t), seen(pose), CAMERA) for i, (t, pose) in enumerate(poses)]

    return shoot


@pytest.fixture(scope="session")
def dark() -> Callable[..., list[Frame]]:
    """``dark(frames, start, stop, value=0)``: the frames from start to before stop without anything to see."""

    def cover(frames: list[Frame], start: int, stop: int, value: int = 0) -> list[Frame]:
        return [replace(f, image=np.full_like(f.image, value)) if start <= f.index < stop else f for f in frames]

    return cover


@pytest.fixture(scope="session")
def rendered() -> tuple[list[Frame], Trajectory]:
    """A walk through a rendered room: 30 frames of 160x120 pixels with a sensor's noise, and the truth."""
    from dvo.synth.sequence import make_sequence

    sequence = make_sequence(5000, frames=30, fps=8, family="room", height=120, width=160)
    return list(sequence), sequence.groundtruth


@pytest.fixture(scope="session")
def path() -> Callable[..., Trajectory]:
    """``path(count, translate)``, see :func:`walk`."""
    return walk
