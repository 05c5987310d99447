"""Images whose even and odd lines are of two moments."""

import cv2
import numpy as np
import pytest

from dvo.data.images.fields import are_interlaced


def moving(count, step, noise=0.0):
    """Pictures of a texture that passes by ``step`` pixels a picture, and down by a third of it."""
    random = np.random.default_rng(2)
    texture = cv2.GaussianBlur(random.uniform(0, 255, (400, 900, 3)).astype(np.float32), (0, 0), 2.5)
    texture = (texture - texture.mean()) * 4 + 128
    for index in range(count):
        shift = np.float32([[1, 0, -step * index], [0, 1, -step * index / 3]])
        picture = cv2.warpAffine(texture, shift, (320, 240)) + random.normal(0, noise, (240, 320, 3))
        yield np.clip(picture, 0, 255).astype(np.uint8)


def woven(pictures, top_first):
    """Interlaced images at half the rate."""
    pictures = list(pictures)
    for first, second in zip(pictures[::2], pictures[1::2], strict=True):
        image = first.copy()
        image[int(top_first) :: 2] = second[int(top_first) :: 2]
        yield image


@pytest.mark.parametrize("top_first", [True, False])
@pytest.mark.parametrize(("step", "noise"), [(0.5, 0), (2, 0), (8, 0), (2, 6)])
def test_two_moments_in_one_image(top_first, step, noise):
    assert are_interlaced(woven(moving(24, step, noise), top_first))
    jpegs = (cv2.imencode(".jpg", image)[1] for image in woven(moving(24, step, noise), top_first))
    assert are_interlaced(cv2.imdecode(jpeg, cv2.IMREAD_COLOR) for jpeg in jpegs)


@pytest.mark.parametrize(("step", "noise"), [(0.5, 0), (2, 0), (8, 0), (40, 0), (2, 6), (0, 6)])
def test_one_moment_in_motion_and_noise(step, noise):
    assert not are_interlaced(moving(12, step, noise))


def test_pictures_that_repeat_and_a_camera_that_starts():
    pictures = list(moving(8, 3))
    assert not are_interlaced(picture for picture in pictures for _ in range(2))
    assert not are_interlaced([pictures[0]] * 6 + pictures)


@pytest.mark.parametrize("size", [(48, 64), (240, 320)])
def test_noise_alone(size):
    random = np.random.default_rng(4)
    assert not are_interlaced(random.integers(0, 256, (*size, 3), dtype=np.uint8) for _ in range(16))


def test_fine_lines_are_no_fields():
    lines = np.tile(np.uint8([[60], [200]]), (120, 320))[..., None].repeat(3, 2)
    assert not are_interlaced([lines] * 12)


@pytest.mark.parametrize("pictures", [[], [np.zeros((2, 2, 3), np.uint8)] * 5, list(moving(2, 3))])
def test_too_little_to_say(pictures):
    assert not are_interlaced(pictures)
