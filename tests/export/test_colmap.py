"""COLMAP's files: layout, cross references, and the convention of poses and pixels."""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.data.files.stamps import read_times
from dvo.data.frame import Frame
from dvo.export.colmap import write_colmap, write_colmap_text
from dvo.export.reconstruction import reconstruct
from dvo.geometry.camera import Camera
from dvo.synth.sequence import make_sequence
from tests.support.colmap_models import read_binary, read_text
from tests.support.reconstructions import SIDE, one_view, views, walk


@pytest.fixture(scope="module")
def found():
    return reconstruct(walk(12, dropped=(5,)), 0)


@pytest.fixture(params=["binary", "text"])
def written(request, found, tmp_path):
    """Folder, and the model read back from it."""
    if request.param == "binary":
        write_colmap(found, tmp_path)
        return tmp_path, read_binary(tmp_path / "sparse" / "0")
    write_colmap_text(found, tmp_path)
    return tmp_path, read_text(tmp_path / "sparse" / "0")


def test_both_forms_hold_everything(found, written):
    _, model = written
    (camera,) = model.cameras.values()
    assert camera[:3] == ("PINHOLE", SIDE, SIDE)
    np.testing.assert_array_equal(camera[3], found.cameras[0].intrinsics + [0, 0, 0.5, 0.5])
    assert list(model.images) == list(range(1, len(found.identifiers) + 1)), "as COLMAP's database numbers them"
    assert [image.name for image in model.images.values()] == found.names
    assert sum(len(image.points) for image in model.images.values()) == len(found.residuals)
    np.testing.assert_array_equal([point[0] for point in model.points.values()], found.points)
    np.testing.assert_array_equal([point[1] for point in model.points.values()], found.colors)
    np.testing.assert_array_equal([point[2] for point in model.points.values()], found.errors)


def test_tracks_and_observations_name_each_other_and_agree(found, written):
    _, model = written
    count = 0
    for number, (xyz, _, error, track) in model.points.items():
        assert len(track) >= 2
        errors = []
        for name, index in track:
            image = model.images[name]
            x, y, point = image.points[index]
            assert point == number
            errors.append(np.linalg.norm(image.project(xyz, model.cameras[image.camera][3]) - [x, y]))
        assert np.mean(errors) == pytest.approx(error, abs=1e-6) and error < 0.02
        count += len(track)
    assert count == len(found.residuals)


def test_images_and_their_times(found, written):
    folder, model = written
    assert sorted(path.name for path in (folder / "images").iterdir()) == found.names
    for image in model.images.values():
        assert cv2.imread(str(folder / "images" / image.name)).shape == (SIDE, SIDE, 3)
    np.testing.assert_allclose(read_times(folder / "times.txt", len(found.jpegs)), found.timestamps, atol=1e-9)


@given(views(), st.booleans())
@settings(max_examples=30)
def test_a_point_is_seen_half_a_pixel_further_by_colmap(view, binary):
    """Half a pixel, because COLMAP counts from the corner of the first pixel."""
    T_cw, camera, pixel, depth = view
    found, point = one_view(T_cw, camera, pixel, depth)
    with tempfile.TemporaryDirectory() as folder:
        (write_colmap if binary else write_colmap_text)(found, Path(folder))
        model = (read_binary if binary else read_text)(Path(folder) / "sparse" / "0")
    (image,) = model.images.values()
    assert np.linalg.norm(image.qvec) == pytest.approx(1)
    np.testing.assert_allclose(image.project(point, model.cameras[1][3]), pixel + 0.5, atol=1e-6)
    np.testing.assert_allclose(image.points[0, :2], pixel + 0.5, atol=1e-12)


def test_pycolmap_reads_both_forms(found, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pip install pycolmap")
    for name, write in (("binary", write_colmap), ("text", write_colmap_text)):
        (tmp_path / name).mkdir()
        write(found, tmp_path / name)
        model = pycolmap.Reconstruction(tmp_path / name / "sparse" / "0")
        assert (model.num_images(), model.num_points3D()) == (len(found.jpegs), len(found.points))
        model.update_point_3d_errors()
        assert model.compute_mean_reprojection_error() == pytest.approx(found.errors.mean(), abs=1e-6)
        centres = [model.images[i + 1].projection_center() for i in range(len(found.identifiers))]
        np.testing.assert_allclose(centres, np.linalg.inv(found.T_cw)[:, :3, 3], atol=1e-9)


def mean_error(odometry, folder):
    """Mean reprojection error of a tracked sequence by the files alone, pixels of the images; and the model."""
    found = dvo.export_map(odometry, folder)
    model = read_binary(folder / "sparse" / "0")
    errors = []
    for xyz, _, _, track in model.points.values():
        for number, index in track:
            image = model.images[number]
            errors.append(np.linalg.norm(image.project(xyz, model.cameras[1][3]) - image.points[index, :2]))
    assert found.mean_error == pytest.approx(np.mean(errors), rel=1e-6)
    return float(np.mean(errors)), model


def test_a_tracked_wall(tmp_path):
    """A camera that moves along a wall, tracked with the shipped weights: the wall is flat, and the camera's path
    straight."""
    size = width, height = 128, 96
    coarse = np.random.default_rng(0).integers(0, 255, (height // 4, width // 4 + 6, 3), dtype=np.uint8)
    wall = cv2.resize(coarse, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    camera = Camera(100.0, 100.0, 63.5, 47.5, *size)
    settings = {"patches": 12, "initial_updates": 8, "final_updates": 2, "keyframe_motion": 0.0, "restart": False}
    odometry = dvo.load("small", device="cpu", seed=0, estimate_readout=False, **settings)
    for i in range(8):
        odometry.track(Frame(i, 0.1 * i, np.ascontiguousarray(wall[:, 3 * i : 3 * i + width]), camera))
    odometry.finish()
    error, model = mean_error(odometry, tmp_path / "out")
    assert error < 0.5 and len(model.images) >= 6 and len(model.points) > 50
    (_, w, h, parameters) = model.cameras[1]
    assert (w, h) == size
    np.testing.assert_allclose(parameters, [100, 100, 64, 48], rtol=1e-5)
    depths = np.array([point[0][2] for point in model.points.values()])
    assert np.abs(depths / np.median(depths) - 1).max() < 0.2


@pytest.mark.slow
def test_a_rendered_clip_read_by_pycolmap(tmp_path):
    """Acceptance: less than two pixels, by pycolmap's own projection."""
    pycolmap = pytest.importorskip("pycolmap", reason="pip install pycolmap")
    odometry = dvo.load("small", device="cpu", seed=0)
    dvo.run(odometry, make_sequence(0, frames=60, height=240, width=320, family="room", fps=30.0))
    error, model = mean_error(odometry, tmp_path / "out")
    read = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert (read.num_images(), read.num_points3D()) == (len(model.images), len(model.points))
    read.update_point_3d_errors()
    assert read.compute_mean_reprojection_error() == pytest.approx(error, rel=0.2)  # it averages over points
    assert read.compute_mean_reprojection_error() < 2.0
    assert read.num_images() >= 3 and read.num_points3D() > 500
