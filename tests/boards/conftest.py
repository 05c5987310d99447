"""Images of boards through a known lens."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import undistort

WIDTH, HEIGHT = 320, 240
PIXELS = 24  # of a square in the picture of a board
RADTAN = Camera(260.0, 264.0, 163.0, 117.0, WIDTH, HEIGHT, "radtan", (-0.22, 0.06, 0.001, -0.0015))
FISHEYE = Camera(150.0, 152.0, 162.0, 118.0, WIDTH, HEIGHT, "fisheye", (0.02, -0.01, 0.002, -0.001))


def checkerboard(columns: int, rows: int) -> np.ndarray:
    """Picture of a board with so many inner corners, with a margin of one square."""
    squares = (np.indices((rows + 1, columns + 1)).sum(0) % 2 * 215 + 20).astype(np.uint8)
    return np.pad(np.kron(squares, np.ones((PIXELS, PIXELS), np.uint8)), PIXELS, constant_values=235)


def charuco(columns: int, rows: int, dictionary: int = cv2.aruco.DICT_4X4_50, legacy: bool = False) -> np.ndarray:
    """Picture of a ChArUco board with so many squares, with a margin of one square."""
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.75, cv2.aruco.getPredefinedDictionary(dictionary))
    board.setLegacyPattern(legacy)
    picture = board.generateImage((columns * PIXELS, rows * PIXELS), marginSize=0)
    return np.pad(picture // 2 + 100, PIXELS, constant_values=227)


@lru_cache(maxsize=8)
def rays_of(camera: Camera, samples: int) -> np.ndarray:
    """Normalised coordinates of so many by so many samples in each pixel."""
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    u = (np.arange(camera.width)[:, None] + offsets).ravel()
    v = (np.arange(camera.height)[:, None] + offsets).ravel()
    grid = np.stack(np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy), axis=-1)
    return undistort(grid, camera, iterations=8)


@dataclass
class Scene:
    """Camera in front of a picture; the origin is the first inner corner (or the first corner of a ChArUco board)."""

    camera: Camera
    picture: np.ndarray
    origin: float = 2.0  # squares from the edge of the picture
    samples: int = 2
    rays: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.rays = rays_of(self.camera, self.samples)

    def pose(self, place: np.ndarray, distance: float, tilt: np.ndarray) -> np.ndarray:
        """Rotation vector and translation that show the middle of the board on a normalised place of the image."""
        rotation = cv2.Rodrigues(np.array([tilt[0], tilt[1], tilt[2]]))[0]
        middle = np.array([self.picture.shape[1], self.picture.shape[0]]) / PIXELS / 2 - self.origin
        shift = np.array([place[0], place[1], 1.0]) * distance - rotation @ [middle[0], middle[1], 0]
        return np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), shift])

    def image(self, pose: np.ndarray, blur: float = 0.6, noise: float = 2.0, seed: int = 0) -> np.ndarray:
        """``(H, W)`` uint8: the board on a grey background."""
        rotation = cv2.Rodrigues(pose[:3])[0]
        to_board = np.linalg.inv(np.column_stack([rotation[:, :2], pose[3:]]))  # plane Z = 0
        rays = np.concatenate([self.rays, np.ones_like(self.rays[..., :1])], axis=-1)
        board = rays @ to_board.T
        at = ((board[..., :2] / board[..., 2:] + self.origin) * PIXELS - 0.5).astype(np.float32)
        at = np.where(np.isfinite(at) & (board[..., 2:] > 0), at, -1e4).astype(np.float32)
        fine = cv2.remap(self.picture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128)
        c, s = self.camera, self.samples
        image = fine.reshape(c.height, s, c.width, s).astype(np.float64).mean(axis=(1, 3))
        image = cv2.GaussianBlur(image, (0, 0), blur)
        image += np.random.default_rng(seed).normal(0, noise, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def frames(self, poses: list[np.ndarray], **options: float) -> list[Frame]:
        """Frames with images in grey as RGB, at 10 a second."""
        made = []
        for index, pose in enumerate(poses):
            image = cv2.cvtColor(self.image(pose, seed=index, **options), cv2.COLOR_GRAY2RGB)
            made.append(Frame(index, index / 10, image, self.camera))
        return made

    def poses(
        self, count: int, seed: int = 0, tilt: float = 0.6, near: float = 9.0, far: float = 15.0
    ) -> list[np.ndarray]:
        """Poses all over the image, with tilts up to so many radians."""
        rng, made = np.random.default_rng(seed), []
        reach = 0.5 * np.array([self.camera.width / self.camera.fx, self.camera.height / self.camera.fy])
        for _ in range(count):
            distance = rng.uniform(near, far)
            turn = np.append(rng.uniform(-tilt, tilt, 2), rng.uniform(-0.3, 0.3))
            made.append(
                self.pose(
                    rng.uniform(-1, 1, 2) * reach * (0.2 + 0.5 * (distance - near) / (far - near)), distance, turn
                )
            )
        return made


class Boards:
    """Renderings and boards for tests."""

    Scene, RADTAN, FISHEYE, WIDTH, HEIGHT = Scene, RADTAN, FISHEYE, WIDTH, HEIGHT
    checkerboard, charuco = staticmethod(checkerboard), staticmethod(charuco)


@pytest.fixture
def boards():
    return Boards
