import math

import cv2
import numpy as np
import pytest

from dvo.geometry.camera import Camera
from dvo.geometry.field_of_view import measure_cut, notice_of_cut, viewing_angle
from dvo.geometry.undistort import Undistorter, undistorted_camera


def fisheye(degrees, coefficients=(0.0,) * 4):
    focal = 160 / math.radians(degrees / 2)
    return Camera(focal, focal, 159.5, 119.5, 320, 240, "fisheye", coefficients)


@pytest.mark.parametrize("degrees", [60, 120, 180, 220])
def test_angle_of_an_equidistant_lens(degrees):
    """Its angle is proportional to the pixels, beyond 180 degrees too."""
    assert viewing_angle(fisheye(degrees)) == pytest.approx((degrees, 0.75 * degrees), abs=0.1)


def test_angle_of_a_pinhole_and_of_an_off_centre_lens():
    camera = Camera(160.0, 120.0, 159.5, 119.5, 320, 240)
    assert viewing_angle(camera) == pytest.approx((90, 90))
    shifted = Camera(160.0, 120.0, 79.5, 119.5, 320, 240)
    assert viewing_angle(shifted)[0] == pytest.approx(math.degrees(math.atan(0.5) + math.atan(1.5)))


def test_angle_of_a_lens_whose_image_ends_inside():
    folding = fisheye(200, (-0.3, 0.0, 0.0, 0.0))
    turn = math.degrees(math.sqrt(1 / 0.9))  # where 1 - 3 * 0.3 theta^2 = 0
    assert viewing_angle(folding)[0] == pytest.approx(2 * turn, abs=0.2)


@pytest.mark.parametrize("degrees", [90, 120, 170])
def test_share_of_the_pixels(degrees):
    """The share agrees with the pixels that the undistorted image was made of."""
    lens = fisheye(degrees, (0.01, -0.004, 0.002, 0.0))
    undistort = Undistorter(lens)
    cut = measure_cut(lens, undistort.camera)
    number = np.arange(320 * 240, dtype=np.float32).reshape(240, 320)
    x, y = undistort.depth(number % 320), undistort.depth(number // 320)
    inside = np.zeros((240, 320), bool)
    seen = np.isfinite(x)
    inside[y[seen].astype(int), x[seen].astype(int)] = True
    # Where the undistorted image magnifies, every recorded pixel in it is hit; elsewhere gaps are closed.
    inside = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    assert cut.share == pytest.approx(1 - inside.mean(), abs=0.02)
    assert cut.after[0] < cut.before[0] and cut.zoom == pytest.approx(undistort.camera.fx / lens.fx)


def test_notices():
    lens = fisheye(150)
    (said,) = notice_of_cut(lens, undistorted_camera(lens))
    assert "120 x 105 degrees of 150 x 112 degrees" in said and "35 % of the pixels are cut" in said
    mild = Camera(300.0, 300.0, 159.5, 119.5, 320, 240, "radtan", (-0.05, 0.0, 0.0, 0.0))
    assert notice_of_cut(mild, undistorted_camera(mild)) == []
    wide = Camera(200.0, 200.0, 159.5, 119.5, 320, 240, "radtan", (-0.28, 0.07, 0.0, 0.0))
    assert "a wide lens" in notice_of_cut(wide, undistorted_camera(wide))[0]
