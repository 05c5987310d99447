import numpy as np
import pytest

from dvo.data.images.fit import fit, fit_depth
from dvo.geometry.camera import Camera


def test_fit_crops_to_the_aspect_and_carries_the_intrinsics():
    u, _ = np.meshgrid(np.arange(124.0), np.arange(40.0))
    image = np.repeat(u[..., None].astype(np.uint8), 3, 2)  # the grey value is the column
    camera = Camera(70, 70, 60, 20, 124, 40)
    small, fitted = fit(image, camera, 20, 15)
    assert small.shape == (15, 20, 3) and (fitted.width, fitted.height) == (20, 15)
    # the same ray has the same column, before and after
    column = np.interp(9.5, np.arange(20), small[7, :, 0].astype(float))
    assert (9.5 - fitted.cx) / fitted.fx == pytest.approx((column - camera.cx) / camera.fx, abs=0.5 / 70)


def test_fitted_depth_is_that_of_the_same_ray():
    camera = Camera(70, 70, 60, 20, 124, 40)
    u, v = np.meshgrid(np.arange(124.0), np.arange(40.0))
    columns, rows = u.astype(np.float32), v.astype(np.float32)  # the depth is the column, or the row
    _, fitted = fit(np.zeros((40, 124, 3), np.uint8), camera, 20, 15)
    for wanted, depth, f, c, fitted_f, fitted_c in (
        (np.arange(20), fit_depth(columns, camera, fitted)[7], 70, 60, fitted.fx, fitted.cx),
        (np.arange(15), fit_depth(rows, camera, fitted)[:, 9], 70, 20, fitted.fy, fitted.cy),
    ):
        assert np.abs((depth - c) / f - (wanted - fitted_c) / fitted_f).max() <= 0.5 / 70 + 1e-6


def test_no_depth_is_unknown_everywhere():
    fitted = Camera(35, 35, 30, 10, 62, 20)
    depth = fit_depth(None, Camera(70, 70, 60, 20, 124, 40), fitted)
    assert depth.shape == (20, 62) and depth.dtype == np.float32 and np.isnan(depth).all()


def test_a_fitted_camera_reads_out_the_rows_that_are_left():
    camera = Camera(70, 70, 20, 62, 40, 124, readout=0.031)
    _, fitted = fit(np.zeros((124, 40, 3), np.uint8), camera, 20, 20)
    assert fitted.readout == pytest.approx(0.01)
