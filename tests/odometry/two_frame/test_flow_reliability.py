"""Weights of the pixels of a flow: texture, likeness along the flow, exposure, invalid flows, other sizes of map."""

import numpy as np
import pytest

from dvo.odometry.two_frame.flow_reliability import flow_weights

SIZE, MAP = (120, 160), (30, 40)


def textured(seed=0, size=SIZE):
    """Grey noise of several scales, RGB."""
    source = np.random.default_rng(seed)
    image = sum(
        np.kron(source.normal(0, 25, (size[0] // n, size[1] // n)), np.ones((n, n))) for n in (2, 4, 8)
    )  # blocks, so that neighbouring pixels are alike
    return np.repeat(np.clip(128 + image, 0, 255).astype(np.uint8)[..., None], 3, -1)


def still(shape=MAP):
    return np.zeros((2, *shape), np.float32)


def test_pixels_without_texture_hardly_count():
    image = textured()
    image[:, :60] = 120
    weights = flow_weights(image, image, still())
    assert weights.shape == MAP
    assert weights[5:-5, :10].max() < 0.01
    assert weights[5:-5, 22:-5].min() > 0.7


def test_an_edge_alone_hardly_counts():
    image = np.full((*SIZE, 3), 40, np.uint8)
    image[:, 80:] = 200  # it tells nothing of motions along it
    assert flow_weights(image, image, still()).max() < 0.1


@pytest.mark.parametrize("shift", [(4, 0), (0, -8), (8, 4)])
def test_a_wrong_flow_counts_less_than_the_true_one(shift):
    x, y = shift
    image = textured(1)
    moved = np.roll(image, (y, x), (0, 1))
    true = np.broadcast_to(np.float32([x / 4, y / 4])[:, None, None], (2, *MAP))
    inner = np.s_[6:-6, 6:-6]
    right, wrong = flow_weights(image, moved, true)[inner], flow_weights(image, moved, still())[inner]
    assert right.min() > 0.7 and np.median(wrong) < 0.5 * np.median(right)


def test_a_change_of_brightness_makes_little_difference():
    image = np.clip(textured(2).astype(int), 40, 200).astype(np.uint8)
    inner = np.s_[3:-3, 3:-3]
    same, brighter = (flow_weights(image, other, still())[inner] for other in (image, image + 30))
    assert np.abs(same - brighter).max() < 0.02


def test_flows_that_are_not_finite_and_pixels_that_leave_the_image_count_least():
    image, flow = textured(3), still()
    flow[0, 10, 12] = np.nan
    flow[1, 20, 30] = np.inf
    weights = flow_weights(image, image, flow)
    assert weights[10, 12] == weights[20, 30] == weights.min() == 1e-3
    assert np.isfinite(weights).all() and weights[3, 3] > 0.5
    flow = still()
    flow[0] = 40  # as wide as the image
    assert flow_weights(image, image, flow).max() < 0.6


@pytest.mark.parametrize("shape", [(30, 40), (15, 20), (31, 41)])
def test_maps_of_any_resolution(shape):
    weights = flow_weights(textured(4), textured(4), still(shape))
    assert weights.shape == shape and weights.dtype == np.float64
    assert weights.min() > 0 and weights.max() <= 1
