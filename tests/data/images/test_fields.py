"""Images whose even and odd lines are of two moments."""

import cv2
import numpy as np
import pytest

from dvo.data.images.fields import are_interlaced
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
