"""Images whose even and odd lines are of two moments."""

import cv2
import numpy as np
import pytest

from dvo.data.images.fields import are_interlaced, is_mosaic
from tests.support.interlaced import moving, woven


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


def test_mosaics_of_a_sensor():
    """Each pixel of one colour; noise, combs of lines alone and images with colours are none."""
    random = np.random.default_rng(5)
    small = cv2.resize(random.integers(0, 256, (12, 16, 3), dtype=np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
    mosaic = small[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = small[::2, ::2, 0], small[1::2, 1::2, 2]
    assert is_mosaic(mosaic) and is_mosaic(np.repeat(mosaic[..., None], 3, 2))
    combs = small[..., 1] // 2 + 40 * (np.arange(240)[:, None] % 2).astype(np.uint8)
    noise = random.integers(0, 256, (240, 320), dtype=np.uint8)
    assert not any(map(is_mosaic, (small, small[..., 1], noise, combs, np.zeros((240, 320), np.uint8), mosaic[:4])))
