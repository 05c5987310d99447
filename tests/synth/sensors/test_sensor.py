"""Sensor effects on clean images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from dvo.synth import (
    Sensor,
    SyntheticSequence,
    make_sequence,
    salts,
)
from dvo.synth.clip import make_clip
from dvo.synth.sensors.sensor import compressed, expose, exposure_changes, low_light, random_degradation, random_sensor

SMALL: dict[str, Any] = {"frames": 12, "height": 60, "width": 80, "fps": 10.0, "family": "room"}
SEED = 4


@pytest.fixture(scope="module")
def plain() -> SyntheticSequence:
    return make_sequence(SEED, **SMALL)


def test_exposure_changes_brightness_over_time() -> None:
    knots = exposure_changes(np.random.default_rng(3), 8.0, 2.0)
    when, level = np.array(knots).T
    assert (np.diff(when) > 0).all() and when[0] == 0
    assert np.abs(np.diff(level)).max() > 1.2, "no sudden change"
    assert np.abs(level[-1]) < 2.0
    grey = torch.full((3, 3, 8, 8), 0.1)
    sensor = Sensor(exposure=None, stops=((0.0, 0.0), (1.0, 1.0), (2.0, -1.0)))
    out = expose(grey, sensor, np.random.default_rng(0), times=np.array([0.0, 1.0, 2.0]))
    assert torch.allclose(out.mean((1, 2, 3)), torch.tensor([0.1, 0.2, 0.05]), rtol=1e-5)


def test_low_light_is_noisy_where_it_should_be() -> None:
    grey = torch.full((1, 3, 200, 200), 0.5)
    sensor = Sensor(exposure=None, shot=0.01, read=0.003)
    good = expose(grey, sensor, np.random.default_rng(0))
    poor = expose(grey, low_light(sensor, 0.05), np.random.default_rng(0))
    gain = 0.05 * 14
    assert float(poor.mean()) == pytest.approx(0.5 * gain, rel=0.02)
    expected = np.sqrt(14 * 0.01**2 * 0.5 * gain + (14 * 0.003) ** 2)
    assert float(poor.std()) == pytest.approx(expected, rel=0.03)
    assert float(poor.std()) > 4 * float(good.std())


def test_jpeg_loses_detail_by_quality(plain: SyntheticSequence) -> None:
    images = torch.from_numpy(plain.frame(0).image).permute(2, 0, 1)[None].float() / 255
    errors = [float((compressed(images, quality) - images).abs().mean()) for quality in (95, 50, 10)]
    assert 0 < errors[0] < errors[1] < errors[2] < 0.1


@pytest.mark.long
def test_sensor_wear_of_clips_is_rare_and_has_its_own_draws() -> None:
    worn = [
        random_degradation(np.random.default_rng([0, salts.CLIP_DEGRADATION, i]), Sensor(), 1.0) for i in range(400)
    ]
    assert 0.05 < np.mean([sensor != Sensor() for sensor in worn]) < 0.15
    assert all(30 <= sensor.jpeg < 95 or sensor.jpeg == 0 for sensor in worn)
    assert random_sensor(np.random.default_rng(0)).stops == ()
    index = next(i for i, sensor in enumerate(worn[:60]) if sensor.jpeg)
    clip, clean = (make_clip(0, index, frames=2, height=60, width=80, flow_range=(1.0, 8.0), sensor=on)
                   for on in (True, False))  # fmt: skip
    assert torch.equal(clip.depth, clean.depth) and not torch.equal(clip.images, clean.images)
