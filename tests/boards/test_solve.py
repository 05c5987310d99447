"""Solution from exact corners: values, Jacobians, covariance."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dvo.boards.board import Checkerboard
from dvo.boards.solve import project, solve
from dvo.boards.views import View
from dvo.geometry.undistort import distort

CASES = pytest.mark.parametrize("name", ["RADTAN", "FISHEYE"])


def parameters(camera):
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients])


def exact_views(boards, camera, noise=0.0, seed=0, tilt=0.6):
    scene = boards.Scene(camera, boards.checkerboard(7, 5), samples=1)
    points, rng = Checkerboard(7, 5).points, np.random.default_rng(seed)
    views = []
    for index, pose in enumerate(scene.poses(12, tilt=tilt, near=6.0)):
        corners = project(parameters(camera), camera.model == "fisheye", pose, points)[0]
        views.append(View(index, corners + noise * rng.normal(size=corners.shape), points, 1.0))
    return views


@CASES
def test_projection_is_that_of_the_lens_models_of_dvo(boards, name):
    camera, pose = getattr(boards, name), np.array([0.2, -0.3, 0.1, -1.0, -0.5, 6.0])
    points = Checkerboard(5, 4).points
    import cv2

    seen = points @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
    pixels = distort(seen[:, :2] / seen[:, 2:], camera) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    found, jacobian = project(parameters(camera), name == "FISHEYE", pose, points)
    assert_allclose(found, pixels, atol=1e-9)
    values = np.concatenate([parameters(camera), pose])
    for column in range(len(values)):
        step = np.zeros(len(values))
        step[column] = 1e-6 * max(1.0, abs(values[column]))
        high, low = (project(v[:-6], name == "FISHEYE", v[-6:], points)[0] for v in (values + step, values - step))
        assert_allclose(jacobian[:, :, column], (high - low) / (2 * step[column]), rtol=1e-4, atol=1e-5)


@CASES
def test_exact_corners_give_the_camera(boards, name):
    camera = getattr(boards, name)
    found = solve(exact_views(boards, camera), camera.width, camera.height, fisheye=name == "FISHEYE")
    assert found.rms < 1e-3
    assert_allclose(found.values[:4], parameters(camera)[:4], atol=0.01)
    assert_allclose(found.values[4:6], camera.coefficients[:2], atol=2e-3)


def test_deviations_are_those_of_repeated_trials(boards):
    camera, trials = boards.RADTAN, []
    for seed in range(30):
        found = solve(exact_views(boards, camera, 0.1, seed), camera.width, camera.height)
        trials.append((found.values - parameters(camera)) / found.deviations)
    spread = np.sqrt((np.array(trials) ** 2).mean(0))
    assert (spread > 0.65).all() and (spread < 1.45).all()


def test_a_board_that_faces_the_camera_has_an_infinite_or_huge_deviation(boards):
    found = solve(exact_views(boards, boards.RADTAN, 0.05, tilt=0.0), boards.WIDTH, boards.HEIGHT)
    assert found is None or not found.deviations[0] < 0.2 * found.values[0]


def test_k3_is_free_on_demand(boards):
    views = exact_views(boards, boards.RADTAN)
    assert len(solve(views, boards.WIDTH, boards.HEIGHT, k3=True).values) == 9
    assert len(solve(views, boards.WIDTH, boards.HEIGHT).values) == 8
