"""Hard conditions of training clips: their draws, and the clock of moving bodies."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.synth.conditions import LONGEST_STEP, MOST_BODIES, Clocked, Conditions, draw_conditions, stage_clip
from dvo.synth.motion.paths import random_path
from dvo.synth.scenes.families import random_scene
from dvo.synth.textures.texture import texture_pool

SEED = 5


def test_probabilities_are_respected() -> None:
    draws = [draw_conditions(SEED, i, 0.3, 0.1) for i in range(2000)]
    assert np.mean([d.bodies > 0 for d in draws]) == pytest.approx(0.3, abs=0.04)
    assert np.mean([d.light < 1 for d in draws]) == pytest.approx(0.1, abs=0.03)
    assert {d.bodies for d in draws} == set(range(MOST_BODIES + 1))
    assert all(0.03 <= d.light <= 0.3 for d in draws if d.light < 1)
    for index, draw in enumerate(draws[:200]):  # neither option changes the draws of the other
        alone = draw_conditions(SEED, index, 0.3, 0.0)
        assert (alone.bodies, alone.seed, alone.pace) == (draw.bodies, draw.seed, draw.pace) and alone.light == 1
        certain = draw_conditions(SEED, index, 1.0, 1.0)
        assert certain.bodies > 0 and certain.light < 1 and draw.bodies in (0, certain.bodies)
        plain = draw_conditions(SEED, index, 0.3, 0.1, bare=1.0, blurred=1.0)
        assert 0.05 <= plain.texture <= 0.5 and 0.3 <= plain.shutter <= 0.8
        assert (plain.bodies, plain.light, plain.surroundings) == (draw.bodies, draw.light, "")


def test_the_clock_of_the_bodies_follows_the_flow_of_the_camera() -> None:
    """Twice the flow, or twice the pace, is twice the time for the bodies; frames stay in proportion."""
    scene = random_scene(2, "room", pool=texture_pool(SEED))
    path = random_path(scene, 1)
    times = np.array([0.0, 0.1, 0.4])

    def seconds(pace: float, flow: float) -> np.ndarray:
        stage, when = stage_clip(scene, path, times, Conditions(1, 7, pace), flow, 100.0)
        assert len(stage.bodies) == 1
        return when

    usual = seconds(1.0, 4.0)
    assert np.allclose(usual / usual[-1], times / times[-1])
    assert np.allclose(seconds(1.0, 8.0), 2 * usual) and np.allclose(seconds(2.0, 4.0), 2 * usual)
    assert seconds(1.0, 1000.0)[-1] == pytest.approx(2 * LONGEST_STEP)
    view = Clocked(path, 0.0, times[-1] / usual[-1])
    assert np.allclose(view.poses_wc(usual), path.poses_wc(times))
