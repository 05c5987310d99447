"""Nerfstudio's transforms.json: a point is seen at the same pixel by its convention, and the world has z up."""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings

from dvo.export.nerfstudio import APPLIED_TRANSFORM, write_nerfstudio
from dvo.export.reconstruction import reconstruct
from dvo.geometry.camera import Camera
from tests.support.reconstructions import SIDE, one_view, views, walk


def read(folder):
    """Content of transforms.json, and the points ``(P, 3)`` and colours of the point cloud."""
    values = json.loads((folder / "transforms.json").read_text())
    header, body = (folder / values["ply_file_path"]).read_bytes().split(b"end_header\n")
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert f"element vertex {len(rows)}\n".encode() in header
    return values, rows["xyz"].astype(float), rows["rgb"]


def project(point, frame, intrinsics):
    """Pixel at which a camera with x right, y up, z backward sees a point of the point cloud."""
    T = np.array(frame["transform_matrix"])
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) > 0
    right, up, back = T[:3, :3].T @ (point - T[:3, 3])
    assert back < 0
    x = intrinsics["fl_x"] * right / -back + intrinsics["cx"]
    return np.array([x, -intrinsics["fl_y"] * up / -back + intrinsics["cy"]])


def test_a_walk(tmp_path):
    found = reconstruct(walk(10, dropped=(4,)), 0)
    write_nerfstudio(found, tmp_path)
    values, points, colors = read(tmp_path)
    assert values["camera_model"] == "OPENCV" and (values["w"], values["h"]) == (SIDE, SIDE)
    assert [values[name] for name in ("k1", "k2", "p1", "p2")] == [0, 0, 0, 0]
    assert [frame["timestamp"] for frame in values["frames"]] == found.timestamps.tolist()
    assert len(points) == len(found.points)
    np.testing.assert_array_equal(colors, found.colors)
    for frame, name in zip(values["frames"], found.names, strict=True):
        assert frame["file_path"] == f"images/{name}"
        assert cv2.imread(str(tmp_path / frame["file_path"])).shape == (SIDE, SIDE, 3)
    for image, point, position in zip(found.image_of, found.point_of, found.positions, strict=True):
        seen = project(points[point], values["frames"][image], values)
        np.testing.assert_allclose(seen, position + 0.5, atol=0.02)


def test_the_first_camera_stands_upright_and_the_transform_is_told(tmp_path):
    found, point = one_view(np.eye(4), Camera(50.0, 50.0, 32.0, 24.0, 64, 48), (10.0, 20.0), 2.0)
    write_nerfstudio(found, tmp_path)
    values, points, _ = read(tmp_path)
    pose = np.array(values["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(pose[:3, 1], [0, 0, 1], atol=1e-12)  # its y axis, up in the image
    np.testing.assert_allclose(pose[:3, 2], [0, -1, 0], atol=1e-12)  # it looks along y
    np.testing.assert_array_equal(values["applied_transform"], APPLIED_TRANSFORM)
    np.testing.assert_allclose(APPLIED_TRANSFORM @ [*point, 1], points[0], atol=1e-6)
    assert np.linalg.det(APPLIED_TRANSFORM[:, :3]) == pytest.approx(1)


@given(views())
@settings(max_examples=30)
def test_a_point_is_seen_half_a_pixel_further(view):
    """Half a pixel, because rays of pixel (0, 0) go through (0.5, 0.5)."""
    found, _ = one_view(*view)
    with tempfile.TemporaryDirectory() as folder:
        write_nerfstudio(found, Path(folder))
        values, points, _ = read(Path(folder))
    pixel, depth = view[2:]
    seen = project(points[0], values["frames"][0], values)
    np.testing.assert_allclose(seen, pixel + 0.5, atol=1e-3 / min(depth, 1))  # the point cloud is float32


def test_every_frame_names_its_mask(tmp_path):
    """Nerfstudio wants one for all frames, or for none."""
    found = reconstruct(walk(4), 0)
    masks = tuple(cv2.imencode(".png", np.full((SIDE, SIDE), 255 - k, np.uint8))[1].tobytes() for k in range(4))
    write_nerfstudio(replace(found, masks=masks), tmp_path)
    values, _, _ = read(tmp_path)
    paths = [frame["mask_path"] for frame in values["frames"]]
    levels = [cv2.imread(str(tmp_path / path), cv2.IMREAD_UNCHANGED)[0, 0] for path in paths]
    assert levels == [255, 254, 253, 252]
    assert paths == [f"masks/{Path(frame['file_path']).name}.png" for frame in values["frames"]], "COLMAP's names"


def test_two_cameras_stand_at_their_frames(tmp_path):
    found = reconstruct(walk(6), 0)
    (first,) = found.cameras
    camera_of = np.array([0, 0, 1, 1, 0, 1])
    write_nerfstudio(replace(found, cameras=(first, replace(first, fx=99.0)), camera_of=camera_of), tmp_path)
    values, _, _ = read(tmp_path)
    assert "fl_x" not in values and "w" not in values
    assert [frame["fl_x"] for frame in values["frames"]] == [(first.fx, 99.0)[i] for i in camera_of]
