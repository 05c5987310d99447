"""Intrinsics that go along with crops and resizes; intrinsics that cannot be."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera

CAMERA = Camera(500.0, 510.0, 319.5, 239.5, 640, 480, "radtan", (0.1, -0.05, 0.001, 0.002))


@given(st.integers(16, 2000), st.integers(16, 2000))
def test_a_resize_keeps_the_field_of_view(width: int, height: int) -> None:
    small = CAMERA.resized(width, height)
    assert (small.width, small.height) == (width, height)
    # the outer edges of the image, half a pixel outside the outer centres, see the same rays
    for edge, size in ((-0.5, -0.5), (CAMERA.width - 0.5, width - 0.5)):
        assert math.isclose((edge - CAMERA.cx) / CAMERA.fx, (size - small.cx) / small.fx, abs_tol=1e-9)
    for edge, size in ((-0.5, -0.5), (CAMERA.height - 0.5, height - 0.5)):
        assert math.isclose((edge - CAMERA.cy) / CAMERA.fy, (size - small.cy) / small.fy, abs_tol=1e-9)
    assert small.coefficients == CAMERA.coefficients
    back = small.resized(CAMERA.width, CAMERA.height)
    np.testing.assert_allclose(back.intrinsics, CAMERA.intrinsics)


def test_a_resize_agrees_with_what_opencv_does_to_the_pixels() -> None:
    """The centre of mass of a blob moves as the principal point does."""
    y, x = np.mgrid[:480, :640]
    blob = np.exp(-((x - 200.0) ** 2 + (y - 100.0) ** 2) / 800)
    small = cv2.resize(blob, (160, 120), interpolation=cv2.INTER_AREA)
    v, u = np.mgrid[:120, :160]
    camera = Camera(500, 500, 200, 100, 640, 480).resized(160, 120)
    assert abs((small * u).sum() / small.sum() - camera.cx) < 1e-3
    assert abs((small * v).sum() / small.sum() - camera.cy) < 1e-3


@given(st.integers(0, 300), st.integers(0, 200))
def test_a_crop_moves_the_principal_point(left: int, top: int) -> None:
    crop = CAMERA.cropped(left, top, 330, 250)
    ray = (np.array([310.0, 230.0]) - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    same = (np.array([310.0 - left, 230.0 - top]) - [crop.cx, crop.cy]) / [crop.fx, crop.fy]
    np.testing.assert_allclose(ray, same)
    assert (crop.width, crop.height) == (330, 250)


def test_crop_then_resize_is_one_linear_map() -> None:
    both = CAMERA.cropped(40, 20, 560, 440).resized(140, 110)
    pixel = np.array([100.0, 80.0])
    expected = (pixel - [40, 20] + 0.5) * 0.25 - 0.5
    ray = (pixel - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    np.testing.assert_allclose(ray * [both.fx, both.fy] + [both.cx, both.cy], expected)


@pytest.mark.parametrize(
    "values",
    [
        (0, 500, 320, 240),
        (500, -1, 320, 240),
        (500, 500, 700, 240),
        (500, 500, 320, -1),
        (math.nan, 500, 320, 240),
        (500, math.inf, 320, 240),
    ],
)
def test_intrinsics_that_do_not_fit(values: tuple[float, ...]) -> None:
    with pytest.raises(DvoError):
        Camera(*values, 640, 480)


ROLLING = replace(CAMERA, readout=0.024)


def test_a_readout_goes_along_with_resizes_and_crops() -> None:
    assert CAMERA.readout == 0 and CAMERA.cropped(0, 10, 400, 400).readout == 0
    assert ROLLING.resized(320, 120).readout == ROLLING.readout
    crop = ROLLING.cropped(100, 30, 400, 240)
    assert crop.readout == pytest.approx(0.012)
    # every row of the window is read when it was read in the whole image, after the shift that the docstring gives
    shift = (30 + (240 - 480) / 2) * 0.024 / 480
    for row in (0, 100, 239):
        whole = (row + 30 - 479 / 2) * ROLLING.readout / 480
        assert shift + (row - 239 / 2) * crop.readout / 240 == pytest.approx(whole)


@pytest.mark.parametrize("readout", [-0.01, 1.01, 20.0, math.nan, math.inf])
def test_a_readout_that_cannot_be(readout: float) -> None:
    with pytest.raises(DvoError, match="0 to 1 s") as caught:
        replace(CAMERA, readout=readout)
    assert caught.value.field == "readout" and caught.value.remedy


def test_numbers_of_other_libraries_become_plain_ones() -> None:
    K, dist = torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]), np.array([[0.1, -0.2, 0.003, 0.004, 0.05]])
    numbers: list[Any] = [K[0, 0], np.float32(510), np.array(320.0), K[1, 2].numpy(), np.int64(640), 480.0]
    camera = Camera(*numbers, "radtan", dist)  # type: ignore[arg-type]
    plain = Camera(500.0, 510.0, 320.0, 240.0, 640, 480, "radtan", (0.1, -0.2, 0.003, 0.004, 0.05))
    assert camera == plain and hash(camera) == hash(plain) and repr(camera) == repr(plain)
    assert replace(plain, coefficients=list(plain.coefficients)) == plain  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        ({"fx": "500"}, "fx", "expected a number, got an object of type str"),
        ({"cy": None}, "cy", "expected a number, got None"),
        ({"fx": np.eye(3)}, "fx", "expected a number"),
        ({"width": 640.5}, "width", "expected a whole number, got 640.5"),
        ({"height": float("nan")}, "height", "expected a whole number"),
        ({"model": "plumb_bob"}, "model", "unknown lens model 'plumb_bob'"),
        ({"model": ["radtan"]}, "model", "unknown lens model"),
        ({"model": "radtan", "coefficients": "0.1 0 0 0"}, "coefficients", "expected numbers"),
        ({"model": "radtan", "coefficients": {"k1": 0.1}}, "coefficients", "expected numbers"),
        ({"model": "radtan", "coefficients": None}, "coefficients", "not a finite number"),
    ],
)
def test_values_that_are_none_of_a_camera(change: dict[str, object], field: str, message: str) -> None:
    with pytest.raises(DvoError, match=message) as caught:
        replace(Camera(500, 510, 320, 240, 640, 480), **change)  # type: ignore[arg-type]
    assert caught.value.field in (field, "intrinsics") and caught.value.remedy
