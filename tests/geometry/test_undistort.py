from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.poses import so3_exp
from dvo.geometry.undistort import Undistorter, distort, read_at_once, undistort, undistorted_camera

# real lenses: TUM RGB-D freiburg1, EuRoC cam0, TUM-VI cam0
FR1 = Camera(517.3, 516.5, 318.6, 255.3, 640, 480, "radtan", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
EUROC = Camera(458.654, 457.296, 367.215, 248.375, 752, 480, "radtan", (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
TUM_VI = Camera(190.978, 190.973, 254.931, 256.897, 512, 512, "fisheye", (0.0034, 0.00077, -0.0020, 0.0002))
LENSES = pytest.mark.parametrize("camera", [FR1, EUROC, TUM_VI], ids=["radtan-k3", "radtan", "fisheye"])


def grid(camera: Camera) -> np.ndarray:
    """Normalised coordinates of pixels all over the image of the distorted camera."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25))
    return (np.stack([u, v], -1) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]


@LENSES
def test_undistort_inverts_distort_over_the_whole_image(camera):
    seen = grid(camera).reshape(-1, 2)
    if camera.model == "fisheye":  # its corners look backwards: no pinhole sees them
        assert np.isnan(undistort(seen[0], camera)).all()
        seen = seen[np.linalg.norm(seen, axis=1) < 1.5]
    ideal = undistort(seen, camera)
    assert np.isfinite(ideal).all()
    assert np.abs(distort(ideal, camera) - seen).max() < 1e-9
    assert np.abs(undistort(distort(ideal, camera), camera) - ideal).max() < 1e-8


@LENSES
def test_distort_is_opencvs(camera):
    points = 0.8 * grid(camera)
    if camera.model == "fisheye":
        expected = cv2.fisheye.distortPoints(points.reshape(-1, 1, 2), np.eye(3), np.array(camera.coefficients))
    else:
        rays = np.concatenate([points.reshape(-1, 2), np.ones((points.size // 2, 1))], 1)
        expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(camera.coefficients))
    assert np.abs(distort(points, camera) - expected.reshape(points.shape)).max() < 1e-9


coefficient = st.floats(-0.05, 0.05)


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(["radtan", "fisheye"]), st.lists(coefficient, min_size=4, max_size=4), st.data())
def test_round_trip_for_mild_lenses(model, coefficients, data):
    if model == "radtan":
        coefficients[2] /= 10
        coefficients[3] /= 10
    camera = Camera(300, 300, 320, 240, 640, 480, model, tuple(coefficients))
    xy = data.draw(st.lists(st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8)), min_size=1, max_size=20))
    ideal = np.array(xy)
    assert np.abs(undistort(distort(ideal, camera), camera) - ideal).max() < 1e-7


def test_points_that_no_ray_reaches_are_nan():
    folding = Camera(300, 300, 320, 240, 640, 480, "radtan", (-0.5, 0.0, 0.0, 0.0))
    # r (1 - r^2 / 2) never exceeds 0.5443, at r = sqrt(2/3)
    assert np.isnan(undistort(np.array([0.6, 0.0]), folding)).all()
    assert undistort(np.array([0.5, 0.0]), folding) == pytest.approx([0.6180339887, 0], abs=1e-9)
    assert np.isnan(undistort(np.array([1.7, 0.0]), Camera(190, 190, 255, 255, 512, 512, "fisheye"))).all()


def test_fisheye_without_coefficients_needs_undistortion():
    camera = Camera(190, 190, 255, 255, 512, 512, "fisheye")
    assert camera.needs_undistortion
    assert distort(np.array([1.0, 0.0]), camera) == pytest.approx([np.pi / 4, 0])
    assert Undistorter(camera).camera.model == "none"


@LENSES
def test_new_camera_sees_no_black_border(camera):
    undistorter = Undistorter(camera)
    new = undistorter.camera
    assert (new.width, new.height, new.model, new.coefficients) == (camera.width, camera.height, "none", ())
    assert (new.cx, new.cy) == (camera.cx, camera.cy) and new.fx / new.fy == pytest.approx(camera.fx / camera.fy)
    white = np.full((camera.height, camera.width), 255, np.uint8)
    assert undistorter(white).min() >= 120  # half a pixel beyond the edge is half black


def test_new_camera_does_not_zoom_in_more_than_needed():
    new = undistorted_camera(EUROC)
    smaller = Undistorter(EUROC)
    smaller.camera = Camera(new.fx * 0.97, new.fy * 0.97, new.cx, new.cy, new.width, new.height)
    assert smaller(np.full((480, 752), 255, np.uint8)).min() == 0


@pytest.mark.long
@LENSES
def test_images_land_where_the_new_camera_says(camera):
    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:  # of the world, in ideal normalised coordinates
        return 128 + 60 * np.sin(9 * x + 1) * np.cos(7 * y) + 40 * x

    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    seen = (np.stack([u, v], -1) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    ideal = undistort(seen, camera)
    photo = np.nan_to_num(pattern(ideal[..., 0], ideal[..., 1])).clip(0, 255).astype(np.uint8)
    undistorter = Undistorter(camera)
    new = undistorter.camera
    expected = pattern((u - new.cx) / new.fx, (v - new.cy) / new.fy).clip(0, 255)
    error = np.abs(undistorter(photo).astype(float) - expected)[2:-2, 2:-2]
    assert np.median(error) < 1.0 and error.max() < 4.0


def test_an_image_of_another_size_is_refused():
    with pytest.raises(ValueError, match="480x640"):
        Undistorter(FR1)(np.zeros((100, 100), np.uint8))


def test_no_distortion_leaves_the_image_alone():
    camera = Camera(500, 500, 320, 240, 640, 480, "radtan", (0.0, 0.0, 0.0, 0.0))
    image = np.zeros((480, 640), np.uint8)
    undistorter = Undistorter(camera)
    assert undistorter(image) is image
    assert undistorter.camera.intrinsics == pytest.approx(camera.intrinsics)


def test_coefficients_that_fold_the_image_are_an_error():
    with pytest.raises(DvoError, match="fold"):
        undistorted_camera(Camera(200, 200, 320, 240, 640, 480, "radtan", (-5.0, 0.0, 0.0, 0.0)))


@pytest.mark.long
@LENSES
def test_depth_is_that_of_the_nearest_ray_and_never_in_between(camera):
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    seen = (np.stack([u, v], -1) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    ideal = undistort(seen, camera)
    # an inclined plane Z = 2 + 0.5 x, with a wall at 10 on the right, as the lens sees them
    depth = np.where(ideal[..., 0] > 0.3, 10.0, 2 + 0.5 * ideal[..., 0]).astype(np.float32)
    depth[np.isnan(ideal[..., 0])] = np.nan
    undistorter = Undistorter(camera)
    new = undistorter.camera
    found = undistorter.depth(depth)
    x = (np.arange(new.width) - new.cx) / new.fx
    plane, wall = x < 0.28, x > 0.32
    assert found.dtype == np.float32 and found.shape == depth.shape
    assert np.isin(found[np.isfinite(found)], depth[np.isfinite(depth)]).all()  # no value that was not measured
    seen_share = np.isfinite(found).mean()
    assert seen_share > 0.999 if camera.model == "radtan" else seen_share > 0.9
    # half a pixel of the lens in both directions, times the plane's slope
    pixel = sum(np.nanmax(np.abs(part)) for part in np.gradient(ideal[..., 0]))
    tolerance = 0.5 * 0.501 * pixel if camera.model == "radtan" else 0.02  # a fisheye's edge is stretched
    assert np.nanmax(np.abs(found - (2 + 0.5 * x))[:, plane]) < tolerance
    assert (np.nan_to_num(found[:, wall], nan=10) == 10).all()


def test_unknown_depth_stays_unknown_and_a_pinhole_keeps_its_depth():
    depth = np.full((EUROC.height, EUROC.width), np.nan, np.float32)
    depth[200:280, 300:450] = 3
    found = Undistorter(EUROC).depth(depth)
    assert set(np.unique(found[np.isfinite(found)])) == {3} and 0.02 < np.isfinite(found).mean() < 0.08
    pinhole = Camera(50, 50, 31, 23, 64, 48)
    own = np.ones((48, 64), np.float32)
    assert Undistorter(pinhole).depth(own) is own
    with pytest.raises(ValueError, match="48x64"):
        Undistorter(pinhole).depth(np.ones((24, 32), np.float32))


@LENSES
def test_the_readout_suits_the_rows_of_the_result(camera):
    assert undistorted_camera(camera).readout == 0
    new = undistorted_camera(replace(camera, readout=0.02))
    assert replace(new, readout=0.0) == undistorted_camera(camera)
    u, v = np.meshgrid(np.linspace(0, new.width - 1, 33), np.linspace(0, new.height - 1, 33))
    ideal = np.stack([(u - new.cx) / new.fx, (v - new.cy) / new.fy], -1)
    real = distort(ideal, camera)[..., 1] * camera.fy + camera.cy
    times = (real - (camera.height - 1) / 2) * 0.02 / camera.height

    def spread(readout):
        return float(np.std(times - (v - (new.height - 1) / 2) * readout / new.height))

    assert spread(new.readout) < min(spread(0.9 * new.readout), spread(1.1 * new.readout), 0.02 / 25)
    assert spread(new.readout) <= spread(0.02) + 1e-9
    assert abs(times.mean()) < 0.02 / 25


def test_a_pinhole_keeps_its_readout():
    assert undistorted_camera(Camera(50, 50, 31, 23, 64, 48, readout=0.02)).readout == 0.02


def test_rows_that_a_turning_camera_reads_one_after_the_other_are_those_of_one_time():
    camera, rate = Camera(200.0, 210.0, 150.0, 110.0, 320, 240, readout=0.02), np.array([0.8, -1.5, 2.0])
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)

    def image(turns: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis((turns @ rays[..., None])[..., 0], -1, 0)
        return np.stack([128 + 100 * np.sin(20 * x / z + k) * np.cos(17 * y / z) for k in range(3)], -1).astype(
            np.uint8
        )

    times = (v - 119.5) * camera.readout / 240
    rolled, wanted = image(so3_exp(times[..., None] * rate)), image(np.eye(3)).astype(float)
    offsets = np.linspace(-0.01, 0.01, 5)
    found = read_at_once(rolled, camera, offsets, offsets[:, None] * rate)
    inside = np.s_[8:-8, 8:-8]
    before, after = (np.abs(x.astype(float) - wanted)[inside].mean() for x in (rolled, found))
    assert before > 5 and after < 1
