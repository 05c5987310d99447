"""Descriptors of places: what the grid keeps, how it is fitted, and that the shipped one recognises a view."""

import json

import numpy as np
import pytest
import torch
from safetensors import safe_open

from dvo.core.errors import DvoError
from dvo.map.places import PlaceIndex
from dvo.models.weights import load_model, weights_info
from dvo.odometry.frames.front_end import encode_image
from dvo.odometry.loops.place_descriptors import (
    SHIPPED,
    GridDescriptor,
    describe_cells,
    fit_grid,
    load_descriptor,
    pool_cells,
    save_descriptor,
)
from dvo.synth.sequence import make_sequence

IMAGE = np.zeros((8, 8, 3), np.uint8)


def random_cells(count, channels=10, seed=0):
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(channels, channels))
    return (rng.normal(size=(count, 3, 4, channels)) @ mixing + rng.normal(size=(3, 4, channels))).astype(np.float32)


def test_cells_are_means_of_their_part_of_the_map():
    maps = torch.arange(2 * 6 * 8, dtype=torch.float32).reshape(1, 1, 2, 6, 8)
    cells = pool_cells(maps)
    assert cells.shape == (3, 4, 2)
    assert cells[1, 2, 1] == maps[0, 0, 1, 2:4, 4:6].mean()


def test_fit_centres_and_whitens_in_part():
    cells = random_cells(400)
    fitted = fit_grid(cells, 4)
    projected = ((cells - fitted.mean) @ fitted.projection).reshape(-1, 4)
    covariance = projected.T @ projected / len(projected)
    variances = np.linalg.eigvalsh(np.cov((cells - cells.mean(0)).reshape(-1, 10).T, bias=True))[::-1][:4]
    np.testing.assert_allclose(covariance, np.diag(np.sqrt(variances)), atol=1e-3 * covariance.max())
    assert np.abs(projected.mean(0)).max() < 1e-4
    assert fitted.dimensions == 3 * 4 * 4
    with pytest.raises(DvoError, match="channels"):
        fit_grid(cells, 11)


def test_a_strong_cell_does_not_decide_alone():
    fitted = GridDescriptor(np.zeros((1, 2, 3), np.float32), np.eye(3, dtype=np.float32))
    vector = describe_cells(np.array([[[100.0, 0, 0], [0, 1.0, 0]]], np.float32), fitted)
    np.testing.assert_allclose(vector[[0, 4]], np.array([10, 1]) / np.sqrt(101), rtol=1e-5)
    assert (describe_cells(fitted.mean, fitted) == 0).all()  # the mean picture has nothing to go by


def test_views_move_by_a_column():
    fitted = fit_grid(random_cells(50), 2)
    vector = describe_cells(random_cells(1, seed=3)[0], fitted)
    cells = vector.reshape(3, 4, 2)
    itself, right, left = fitted.views(vector).reshape(3, 3, 4, 2)
    assert (itself == cells).all() and (right[:, 0] == 0).all() and (left[:, 3] == 0).all()
    assert (right[:, 1:] == cells[:, :3]).all() and (left[:, :3] == cells[:, 1:]).all()


def test_a_turned_camera_is_recognised_by_a_shifted_view():
    wide = random_cells(1, seed=5)[0]
    wide = np.concatenate([wide, random_cells(1, seed=6)[0]], 1)  # eight columns, of which the camera sees four
    fitted = fit_grid(random_cells(200), 6)
    there, here, other = wide[:, :4], wide[:, 1:5], random_cells(1, seed=9)[0]
    index = PlaceIndex(fitted.dimensions)
    index.add(0, describe_cells(there, fitted))
    index.add(1, describe_cells(other, fitted))
    found = index.query(fitted.views(describe_cells(here, fitted)))
    assert found.identifiers[0] == 0 and found.scores[0] > 0.6 and found.scores[1] < 0.4


def test_to_a_file_and_back(tmp_path):
    fitted = fit_grid(random_cells(50), 3)
    save_descriptor(tmp_path / "a" / "places.safetensors", fitted, {"weights": "none"})
    again = load_descriptor(tmp_path / "a" / "places.safetensors")
    assert (again.mean == fitted.mean).all() and (again.projection == fitted.projection).all()
    (tmp_path / "text").write_text("no tensors")
    for name in ("text", "missing"):
        with pytest.raises(DvoError, match="train places"):
            load_descriptor(tmp_path / name)
    with pytest.raises(DvoError, match="Fit a descriptor"):
        again(IMAGE, torch.zeros(1, 1, 64, 6, 8))


def test_the_shipped_descriptor_is_fitted_to_the_shipped_weights():
    with safe_open(SHIPPED, framework="np") as content:
        facts = json.loads(content.metadata()["facts"])
    assert facts["sha256"] == weights_info("small").sha256, "run python -m train places"


@pytest.mark.slow
def test_the_shipped_descriptor_recognises_a_view_in_another_light_among_other_scenes():
    model, descriptor = load_model("small"), load_descriptor()
    assert descriptor.dimensions * 2 <= 1024  # bytes of a keyframe

    def describe(image):
        with torch.inference_mode():
            return descriptor(image, encode_image(model, image, torch.device("cpu")).matching)

    index = PlaceIndex(descriptor.dimensions)
    images = []
    for seed in range(6):
        film = make_sequence(seed, frames=2, fps=4.0, height=120, width=160, family="room", apart=True)
        images.append((film.frame(0).image, film.frame(1).image))
        index.add(seed, describe(images[-1][0]))
    for seed, (_, later) in enumerate(images):
        dark = (255 * (later / 255.0) ** 1.3 * 0.8).astype(np.uint8)
        assert index.query(descriptor.views(describe(dark)), 1).identifiers.tolist() == [seed]
