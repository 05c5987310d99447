"""Lens models against OpenCV, and against the closed formulas of their papers."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.field_of_view import notice_of_cut, viewing_angle
from dvo.geometry.lenses import LENSES
from dvo.geometry.undistort import (
    Undistorter,
    distort,
    in_range,
    project,
    undistort,
    undistorted_camera,
    unproject,
)

BASE = Camera(160.0, 158.0, 319.5, 239.5, 640, 480)
EIGHT = (-0.3, 0.08, 1e-3, -2e-3, 0.01, 0.05, -0.02, 0.004)
CAMERAS = {
    "radtan8": replace(BASE, fx=300.0, fy=305.0, model="radtan", coefficients=EIGHT),
    "radtan12": replace(BASE, fx=300.0, fy=305.0, model="radtan", coefficients=(*EIGHT, 2e-3, -1e-3, 1e-3, 5e-4)),
    "fisheye": replace(BASE, model="fisheye", coefficients=(0.0963, 0.0498, 0.0051, -0.0047)),
    "ucm": replace(BASE, fx=190.0, fy=190.0, model="ucm", coefficients=(0.63,)),
    "mei": replace(BASE, fx=550.0, fy=548.0, model="mei", coefficients=(1.8, -0.1, 0.05, 1e-3, -5e-4)),
    "eucm": replace(BASE, fx=191.0, fy=190.0, model="eucm", coefficients=(0.6, 1.1)),
    "double_sphere": replace(BASE, fx=157.0, fy=157.0, model="double_sphere", coefficients=(-0.17, 0.59)),
    "fov": replace(BASE, fx=200.0, fy=200.0, model="fov", coefficients=(0.93,)),
    "thin_prism_fisheye": replace(
        BASE, model="thin_prism_fisheye", coefficients=(0.02, -0.01, 1e-3, -2e-3, 4e-3, -5e-4, 1e-3, -1e-3)
    ),
    "fisheye624": replace(
        BASE, model="fisheye624",
        coefficients=(0.02, -0.01, 4e-3, -5e-4, 1e-4, -1e-5, 1e-3, -2e-3, 1e-3, 2e-4, -1e-3, 1e-4),
    ),
}  # fmt: skip
ALL = pytest.mark.parametrize("name", CAMERAS)


def rays(widest: float, count: int = 200) -> np.ndarray:
    """``(count, 3)`` unit rays up to an angle from the axis, the axis among them."""
    rng = np.random.default_rng(0)
    theta, phi = widest * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * math.pi, count)
    theta[0] = 0
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def formula(camera: Camera, X: float, Y: float, Z: float) -> tuple[float, float]:
    """Normalised coordinates as the papers write them."""
    c = camera.coefficients
    d = math.sqrt(X * X + Y * Y + Z * Z)
    if camera.model == "ucm":
        below = c[0] * d + (1 - c[0]) * Z
    elif camera.model == "eucm":
        below = c[0] * math.sqrt(c[1] * (X * X + Y * Y) + Z * Z) + (1 - c[0]) * Z
    elif camera.model == "double_sphere":
        xi, alpha = c
        below = alpha * math.sqrt(X * X + Y * Y + (xi * d + Z) ** 2) + (1 - alpha) * (xi * d + Z)
    elif camera.model == "fov":
        R = math.hypot(X, Y)
        below = R / (math.atan2(2 * R * math.tan(c[0] / 2), Z) / c[0]) if R else Z * c[0] / (2 * math.tan(c[0] / 2))
    else:
        theta = math.atan2(math.hypot(X, Y), Z)
        if camera.model == "mei":
            xi, k1, k2, p1, p2 = c
            x, y = X / (Z + xi * d), Y / (Z + xi * d)
            r2 = x * x + y * y
            radial, prism = 1 + k1 * r2 + k2 * r2**2, (0, 0)
        else:
            scale = theta / math.hypot(X, Y) if theta else 1 / Z
            x, y = scale * X, scale * Y
            if camera.model == "fisheye624":
                k, (p2, p1, s1, s2, s3, s4) = c[:6], c[6:]
                bent = 1 + sum(k[n] * theta ** (2 * n + 2) for n in range(6))
                x, y, radial = x * bent, y * bent, 1
                r2 = x * x + y * y
                prism = s1 * r2 + s2 * r2**2, s3 * r2 + s4 * r2**2
            else:
                k1, k2, p1, p2, k3, k4, s1, s2 = c
                r2 = x * x + y * y
                radial, prism = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4, (s1 * r2, s2 * r2)
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + prism[0],
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + prism[1],
        )
    return X / below, Y / below


@ALL
def test_the_formulas(name):
    camera = CAMERAS[name]
    if camera.model in ("radtan", "fisheye"):
        ahead = rays(0.9 if camera.model == "radtan" else 1.5)
        zero, k = np.zeros(3), np.array(camera.coefficients)
        module = cv2.fisheye if camera.model == "fisheye" else cv2
        expected = module.projectPoints(ahead[:, None], zero, zero, camera.matrix, k)[0].reshape(-1, 2)
    else:
        ahead = rays(1.5)
        expected = np.array([formula(camera, *ray) for ray in ahead]) * camera.intrinsics[:2] + camera.intrinsics[2:]
    np.testing.assert_allclose(project(ahead, camera), expected, atol=1e-9)
    np.testing.assert_allclose(project(3.5 * ahead, camera), expected, atol=1e-9)
    normalised = (expected - camera.intrinsics[2:]) / camera.intrinsics[:2]
    np.testing.assert_allclose(distort(ahead[:, :2] / ahead[:, 2:], camera), normalised, atol=1e-9)
    np.testing.assert_allclose(unproject(expected, camera), ahead, atol=1e-9)


@pytest.mark.parametrize("name", ["ucm", "mei", "eucm", "double_sphere", "fisheye"])
def test_rays_behind_a_wide_lens(name):
    camera = CAMERAS[name]
    wide = rays(math.radians(105))
    wide = wide[np.isfinite(project(wide, camera)).all(-1)]
    assert (wide[:, 2] < 0).sum() > 20
    np.testing.assert_allclose(unproject(project(wide, camera), camera), wide, atol=1e-8)
    if name not in ("fisheye",):
        expected = np.array([formula(camera, *ray) for ray in wide]) * camera.intrinsics[:2] + camera.intrinsics[2:]
        np.testing.assert_allclose(project(wide, camera), expected, atol=1e-9)


def test_the_closed_inverse_of_the_double_sphere():
    """Equations 46 to 50 of the paper, also used by basalt."""
    camera = CAMERAS["double_sphere"]
    xi, alpha = camera.coefficients
    pixels = np.random.default_rng(1).uniform([0, 0], [639, 479], (100, 2))
    mx, my = ((pixels - camera.intrinsics[2:]) / camera.intrinsics[:2]).T
    r2 = mx**2 + my**2
    mz = (1 - alpha**2 * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
    scale = (mz * xi + np.sqrt(mz**2 + (1 - xi**2) * r2)) / (mz**2 + r2)
    expected = np.column_stack([scale * mx, scale * my, scale * mz - xi])
    np.testing.assert_allclose(unproject(pixels, camera), expected, atol=1e-9)


def test_mei_without_distortion_is_ucm_with_another_focal_length():
    xi = 1.3
    ucm = replace(BASE, model="ucm", coefficients=(xi / (1 + xi),))
    mei = replace(BASE, fx=BASE.fx * (1 + xi), fy=BASE.fy * (1 + xi), model="mei", coefficients=(xi,))
    np.testing.assert_allclose(project(rays(1.7), mei), project(rays(1.7), ucm), atol=1e-9)
    np.testing.assert_allclose(mei.focal_lengths, (BASE.fx, BASE.fy))
    assert undistorted_camera(mei).fx == pytest.approx(undistorted_camera(ucm).fx, abs=0.05)


parameter = st.floats(-1, 1)


@settings(deadline=None, max_examples=80)
@given(st.sampled_from(sorted(set(LENSES) - {"none"})), st.lists(parameter, min_size=12, max_size=12), st.data())
def test_round_trips(model, free, data):
    """Of every pixel that a ray reaches, whatever the coefficients; of rays within the range, from where they came."""
    lens = LENSES[model]
    scales = {"alpha": (0.5, 0.5), "xi": (0.5, 0.9), "beta": (1.0, 0.6), "w": (1.0, 0.8)}
    count = data.draw(st.sampled_from([n for n in lens.counts if n]))
    values = []
    for name, x in zip(lens.names[:count], free, strict=False):
        middle, spread = scales.get(name, (0.0, 0.01 if name[0] in "ps" else 0.1))
        values.append(middle + spread * x)
    camera = Camera(300, 300, 319.5, 239.5, 640, 480, model, tuple(values))
    theta = np.array(data.draw(st.lists(st.floats(0, 1.2), min_size=1, max_size=12)))
    sight = np.column_stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)])
    inside = in_range(sight[:, :2] / sight[:, 2:], camera)
    back = unproject(project(sight, camera), camera)
    decentred = any(value for name, value in zip(lens.names, values, strict=False) if name[0] in "ps")
    if not decentred:  # else a place near the fold may have two rays, and the range is that of the radial part
        sure = inside & in_range(1.001 * sight[:, :2] / sight[:, 2:] + 1e-9, camera)
        np.testing.assert_allclose(back[sure], sight[sure], atol=1e-6)
    pixels = np.array(data.draw(st.lists(st.tuples(st.floats(0, 639), st.floats(0, 479)), min_size=1, max_size=12)))
    reached = unproject(pixels, camera)
    known = np.isfinite(reached).all(-1)
    np.testing.assert_allclose(project(reached[known], camera), pixels[known], atol=1e-5)


@pytest.mark.parametrize(
    ("model", "coefficients", "radius", "expected"),
    [
        ("fisheye", (0.0963, 0.0498, 0.0051, -0.0047), 1.91047, 6.165),
        ("radtan", (0.4, -0.05, 0.0, 0.0), None, 1.9),  # the distorted radius is farther out than the fold
        ("radtan", (0.5, 0.0, 0.0, 0.0, -0.02), None, 1.8),
        ("fisheye", (0.5, 0.0, 0.0, -0.012), None, 4.0),
    ],
)
def test_a_point_far_out_is_found(model, coefficients, radius, expected):
    camera = replace(BASE, model=model, coefficients=coefficients)
    seen = np.array([[radius, 0.0]]) if radius else distort(np.array([[expected, 0.0]]), camera)
    found = undistort(seen, camera)
    assert found[0] == pytest.approx([expected, 0], abs=1e-3)
    np.testing.assert_allclose(distort(found, camera), seen, atol=1e-9)


@pytest.mark.long
@ALL
def test_images_are_undistorted(name):
    """A smooth pattern of the world through the lens, resampled, is that pattern through the pinhole."""
    camera = CAMERAS[name].resized(320, 240)

    def pattern(x, y):
        return 128 + 50 * np.sin(3 * x + 1) * np.cos(2 * y) + 20 * np.sin(x)

    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    ideal = undistort((np.stack([u, v], -1) - camera.intrinsics[2:]) / camera.intrinsics[:2], camera)
    photo = np.nan_to_num(pattern(ideal[..., 0], ideal[..., 1])).clip(0, 255).astype(np.uint8)
    undistorter = Undistorter(camera)
    new = undistorter.camera
    x, y = (u - new.cx) / new.fx, (v - new.cy) / new.fy
    inside = in_range(np.stack([x, y], -1), camera)
    error = np.abs(undistorter(photo).astype(float) - pattern(x, y).clip(0, 255))[inside]
    assert inside.mean() > 0.9 and np.median(error) < 1.0 and np.quantile(error, 0.99) < 4.0
    depth = undistorter.depth(np.full((240, 320), 3.0, np.float32))
    assert np.nanmax(depth) == np.nanmin(depth) == 3


def test_fields_of_view():
    assert viewing_angle(CAMERAS["double_sphere"])[0] > 190
    (said,) = notice_of_cut(CAMERAS["double_sphere"], undistorted_camera(CAMERAS["double_sphere"]))
    assert "a fisheye" in said


@pytest.mark.parametrize(
    ("model", "coefficients", "match"),
    [
        ("radtan", (0.1, 0.2), "2 coefficients for the model radtan"),
        ("fisheye", (0.1,) * 5, "5 coefficients"),
        ("ucm", (), "0 coefficients"),
        ("ucm", (1.2,), "alpha=1.2 is no coefficient"),
        ("eucm", (0.5, -1.0), "beta=-1"),
        ("double_sphere", (-1.2, 0.5), "xi=-1.2"),
        ("fov", (3.5,), "w=3.5"),
        ("fov", (0.0,), "w=0"),
        ("none", (0.1,), "1 coefficients"),
    ],
)
def test_coefficients_that_a_model_does_not_have(model, coefficients, match):
    with pytest.raises(DvoError, match=match) as caught:
        replace(BASE, model=model, coefficients=coefficients)
    assert caught.value.remedy
