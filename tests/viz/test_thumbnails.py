"""Small images of a run: spread over all of it, few and small however long it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.viz.thumbnails import MAX_BYTES, MAX_IMAGES, Thumbnails


def record(count: int, image: np.ndarray) -> list[tuple[float, bytes]]:
    height, width = image.shape[:2]
    thumbnails, camera = Thumbnails(), Camera(50, 50, 31, 23, width, height)
    for k in range(count):
        thumbnails.update(Frame(k, 0.1 * k, image, camera), None)
    return thumbnails.images


@pytest.mark.parametrize("count", [0, 1, 64, 65, 1000])
def test_they_cover_the_run_evenly(count):
    found = record(count, np.zeros((24, 32, 3), np.uint8))
    numbers = np.round(10 * np.array([time for time, _ in found])).astype(int)
    assert min(count, MAX_IMAGES // 2) <= len(found) <= MAX_IMAGES
    steps = np.unique(np.diff(numbers))
    assert len(steps) <= 1 and (count == 0 or (numbers[0] == 0 and count - numbers[-1] <= max([1, *steps])))


def test_they_are_small_and_show_the_image():
    image = np.random.default_rng(0).integers(0, 255, (360, 640, 3), dtype=np.uint8)
    image[:, :320], image[:, 320:] = image[:, :320] // 8 + [200, 0, 0], image[:, 320:] // 8
    found = record(200, image.astype(np.uint8))
    assert sum(len(jpeg) for _, jpeg in found) <= MAX_BYTES
    small = cv2.imdecode(np.frombuffer(found[0][1], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert small.shape == (112, 200, 3)
    assert small[:, :90, 0].mean() > 190 > 60 > small[:, 110:, 0].mean(), "red on the left"
