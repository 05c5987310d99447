"""Lens models against OpenCV, pycolmap and GTSAM. COLMAP counts pixels from the corner of the first one."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dvo.data.calibration.read import read_calibration
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import Undistorter, distort, undistort

pytestmark = pytest.mark.peers
PINHOLE = Camera(310.0, 305.0, 318.2, 243.7, 640, 480)
LENSES = {
    "none": PINHOLE,
    "radtan4": replace(PINHOLE, model="radtan", coefficients=(-0.28, 0.07, 1e-3, -2e-3)),
    "radtan5": replace(PINHOLE, model="radtan", coefficients=(0.26, -0.5, -5e-3, 3e-3, 0.4)),
    "fisheye": replace(PINHOLE, model="fisheye", coefficients=(-0.02, 0.01, -5e-3, 1e-3)),
}


def rays(count: int = 60) -> np.ndarray:
    """``(count, 2)`` ideal normalised coordinates within the range of all lenses here, the axis among them."""
    return np.vstack([np.zeros((1, 2)), np.random.default_rng(0).uniform(-0.6, 0.6, (count - 1, 2))])


def pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels ``(N, 2)`` of ideal normalised coordinates."""
    return distort(points, camera) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def test_opencv():
    """Both directions of the models that dvo and OpenCV have."""
    points = rays()
    solid = np.column_stack([points, np.ones(len(points))])[:, None]
    zero = np.zeros(3)
    for name, camera in LENSES.items():
        coefficients = np.array(camera.coefficients)
        if name == "fisheye":
            theirs, _ = cv2.fisheye.projectPoints(solid, zero, zero, camera.matrix, coefficients)
            back = cv2.fisheye.undistortPoints(theirs, camera.matrix, coefficients)
        else:
            theirs, _ = cv2.projectPoints(solid, zero, zero, camera.matrix, coefficients)
            back = cv2.undistortPoints(theirs, camera.matrix, coefficients)  # a few fixed-point iterations
        np.testing.assert_allclose(pixels(camera, points), theirs[:, 0], atol=1e-9, err_msg=name)
        distorted = (theirs[:, 0] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        np.testing.assert_allclose(undistort(distorted, camera), points, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(back[:, 0], points, atol=3e-3, err_msg=name)


@pytest.mark.parametrize("name", ["radtan4", "radtan5", "fisheye"])
def test_opencv_undistorts_images_alike(name: str) -> None:
    """The image of the camera that :class:`Undistorter` chooses, but for the rounding of both."""
    camera = LENSES[name]
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8), (9, 9), 3)
    undistorter = Undistorter(camera)
    new, coefficients = undistorter.camera.matrix, np.array(camera.coefficients)
    module = cv2.fisheye if name == "fisheye" else cv2
    maps = module.initUndistortRectifyMap(camera.matrix, coefficients, np.eye(3), new, (640, 480), cv2.CV_32FC1)
    theirs = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    assert np.abs(undistorter(image).astype(int) - theirs).max() <= 2


@pytest.mark.parametrize("name", ["none", "radtan4", "radtan5", "fisheye"])
def test_colmap(name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pip install pycolmap")
    camera = LENSES[name]
    model = {"none": "PINHOLE", "radtan4": "OPENCV", "radtan5": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE"}[name]
    further = [*camera.coefficients, 0.0, 0.0, 0.0] if name == "radtan5" else camera.coefficients
    parameters = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *further]
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=parameters)
    points = rays()
    solid = np.column_stack([points, np.ones(len(points))])
    found = np.array(theirs.img_from_cam(solid))
    np.testing.assert_allclose(pixels(camera, points) + 0.5, found, atol=1e-9)
    back = np.array(theirs.cam_from_img(found))[:, :2]
    np.testing.assert_allclose(
        undistort((found - 0.5 - camera.intrinsics[2:]) / camera.intrinsics[:2], camera), back, atol=1e-6
    )


@pytest.mark.parametrize("name", ["none", "radtan4", "fisheye"])
def test_gtsam(name: str) -> None:
    gtsam = pytest.importorskip("gtsam", reason="pip install gtsam")
    camera = LENSES[name]
    kind = {"none": gtsam.Cal3_S2, "radtan4": gtsam.Cal3DS2, "fisheye": gtsam.Cal3Fisheye}[name]
    theirs = kind(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera.coefficients)
    points = rays()
    np.testing.assert_allclose(pixels(camera, points), [theirs.uncalibrate(point) for point in points], atol=1e-9)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(
    ("model", "values", "lens"),
    [
        ("SIMPLE_PINHOLE", (310, 320.5, 240.5), replace(PINHOLE, fx=310.0, fy=310.0, cx=320.0, cy=240.0)),
        ("PINHOLE", (310, 305, 318.7, 244.2), PINHOLE),
        ("SIMPLE_RADIAL", (310, 320.5, 240.5, -0.1), None),
        ("RADIAL", (310, 320.5, 240.5, -0.1, 0.01), None),
        ("OPENCV", (310, 305, 318.7, 244.2, -0.28, 0.07, 1e-3, -2e-3), LENSES["radtan4"]),
        ("FULL_OPENCV", (310, 305, 318.7, 244.2, 0.26, -0.5, -5e-3, 3e-3, 0.4, 0, 0, 0), LENSES["radtan5"]),
        ("OPENCV_FISHEYE", (310, 305, 318.7, 244.2, -0.02, 0.01, -5e-3, 1e-3), LENSES["fisheye"]),
        ("FULL_OPENCV", (310, 305, 318.7, 244.2, 0.2, -0.1, 0, 0, 0.1, 0.3, 0, 0), None),
        ("FOV", (310, 305, 318.7, 244.2, 0.9), None),
        ("THIN_PRISM_FISHEYE", (310, 305, 318.7, 244.2, 0.02, -0.01, 1e-3, 2e-3, 4e-3, 1e-3, 1e-3, -1e-3), None),
    ],
)  # fmt: skip
def test_calibrations_that_colmap_writes(tmp_path, model, values, lens, binary) -> None:
    """Read as COLMAP means them, the rational model among them."""
    pycolmap = pytest.importorskip("pycolmap", reason="pip install pycolmap")
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=[float(value) for value in values], camera_id=1)
    written = pycolmap.Reconstruction()
    (written.add_camera_with_trivial_rig if hasattr(written, "add_camera_with_trivial_rig") else written.add_camera)(
        theirs
    )
    (written.write_binary if binary else written.write_text)(tmp_path)
    file = tmp_path / ("cameras.bin" if binary else "cameras.txt")
    camera = read_calibration(file).camera(640, 480)
    points = rays()
    found = np.array(theirs.img_from_cam(np.column_stack([points, np.ones(len(points))])))
    np.testing.assert_allclose(pixels(camera, points) + 0.5, found, atol=1e-9)
    assert lens is None or camera == lens
