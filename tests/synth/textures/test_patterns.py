"""Procedural patterns keep their looks."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.synth.textures.patterns import PATTERNS, SPECIAL
from dvo.synth.textures.texture import texture_pool

# Mean colour and spread of each pattern at 64 texels from seed 5: drawn before the patterns were sorted by kind.
GOLDEN = {
    "fractal": (0.8258, 0.6220, 0.5073, 0.1689),
    "stains": (0.5277, 0.5389, 0.5071, 0.0645),
    "plain": (0.5665, 0.5924, 0.6029, 0.0219),
    "cells": (0.3272, 0.2361, 0.2815, 0.1315),
    "bricks": (0.5516, 0.4996, 0.5321, 0.0926),
    "tiles": (0.2964, 0.2548, 0.1512, 0.1510),
    "wood": (0.4047, 0.2583, 0.0546, 0.1606),
    "stripes": (0.4099, 0.4122, 0.4116, 0.0468),
    "leaves": (0.4777, 0.4572, 0.4145, 0.2215),
    "foliage": (0.2682, 0.4423, 0.1352, 0.2236),
    "grass": (0.3956, 0.5310, 0.1177, 0.2157),
    "asphalt": (0.3177, 0.3218, 0.3235, 0.0529),
    "facade": (0.4967, 0.4365, 0.4120, 0.1603),
    "text": (0.5081, 0.5553, 0.5029, 0.1919),
    "shelf": (0.3163, 0.3013, 0.2891, 0.2117),
    "panel": (0.4557, 0.4748, 0.4816, 0.1675),
    "clouds": (0.6852, 0.6965, 0.7014, 0.0541),
}


def test_patterns_are_what_they_were() -> None:
    for name, (draw, _) in PATTERNS.items():
        image = draw(np.random.default_rng([0, 5]), 64)
        assert image.shape == (64, 64, 3) and image.dtype == np.float32
        assert np.allclose([*image.mean((0, 1)), image.std()], GOLDEN[name], atol=2e-3), name


@pytest.mark.parametrize("name", list(SPECIAL))
def test_special_patterns(name: str) -> None:
    draw, tag = SPECIAL[name]
    first, again, other = (draw(np.random.default_rng(seed), 128) for seed in (1, 1, 2))
    assert first.shape == (128, 128, 3) and first.dtype == np.float32
    assert np.array_equal(first, again) and np.abs(first - other).mean() > 0.01
    assert first.min() >= 0 and first.max() <= 1 and first.std() > 0.01
    pool = texture_pool(11, count=24, size=64)
    assert all(pool.tags[i] == tag for i in pool.tagged(tag)) and len(pool.tagged(tag)) >= 1
