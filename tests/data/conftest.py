"""Tiny recordings, written on the spot."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT = 64, 48


def _texture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT + 40, WIDTH + 240, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


class Maker:
    """Writes images and small files below a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.texture = _texture()

    def image(self, index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
        """BGR, a window that moves three pixels a frame; blue is darkened so that channel order shows."""
        image = cv2.resize(self.texture[10 : 10 + HEIGHT, 3 * index : 3 * index + WIDTH], (width, height))
        image[..., 0] //= 4
        return image

    def images(self, folder: str, names: list[str], width: int = WIDTH, height: int = HEIGHT) -> Path:
        path = self.root / folder
        path.mkdir(parents=True, exist_ok=True)
        for index, name in enumerate(names):
            assert cv2.imwrite(str(path / name), self.image(index, width, height))
        return path

    def text(self, name: str, text: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def calib(self, name: str = "calib.txt") -> Path:
        return self.text(name, "50 51 31 23\n")

    def video(self, name: str, codec: str, frames: int = 20, fps: float = 20.0) -> Path:
        path = self.root / name
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, (160, 120))
        if not writer.isOpened():
            pytest.skip(f"this OpenCV does not write {codec}")
        for index in range(frames):
            writer.write(self.image(index, 160, 120))
        writer.release()
        return path


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    return Maker(tmp_path)
