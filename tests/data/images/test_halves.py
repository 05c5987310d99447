"""Two views in one image, and bars that are no view."""

import cv2
import numpy as np

from dvo.data.images.halves import two_views


def barred(image):
    return cv2.copyMakeBorder(image, 60, 60, 0, 0, cv2.BORDER_CONSTANT)


def texture(width):
    noise = np.random.default_rng(3).integers(100, 140, (30, width // 8), dtype=np.uint8)
    return cv2.cvtColor(noise.repeat(8, 0).repeat(8, 1), cv2.COLOR_GRAY2RGB)


def test_the_bars_of_a_letterbox_are_no_second_view():
    assert two_views(barred(texture(640))) is None


def test_two_views_between_bars():
    wide = texture(328)
    assert two_views(barred(np.hstack([wide[:, :320], wide[:, 6:326]]))) == "side by side"


def test_a_black_image():
    assert two_views(np.zeros((240, 320, 3), np.uint8)) is None
